"""The command ``retropole fleet calibrate``."""

import json
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest

from retropole.fleet.batch import calibrate_fleet
from retropole.fleet.sites import find_sites
from tests.cli.commands import retropole_here
from tests.fleet.fleets import bytes_of, here, write_fleet

pytestmark = pytest.mark.full

pytest.importorskip("distributed", reason="needs the extra fleet")


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_fleet(tmp_path_factory.mktemp("fleet"))


@pytest.mark.usefixtures("in_this_process")
def test_what_it_says(fleet: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = retropole_here("fleet", "calibrate", fleet, "--out", out)
    assert done.returncode == 0
    assert done.stdout.splitlines()[:2] == [
        "8 sites: 1 ok, 4 refused, 3 error",
        "calibrated now: 7, as before: 1",
    ]
    assert "       2  unreadable" in done.stdout
    assert done.stdout.endswith(f"written: {out}\n")
    assert not done.stderr
    again = retropole_here("fleet", "calibrate", fleet, "--out", out, "--json", "--strict")
    assert again.returncode == 1
    told = json.loads(again.stdout)
    assert (told["schema"], told["calibrated"]) == ("retropole/fleet-run/1", 1)
    assert told["statuses"] == {"error": 3, "ok": 1, "refused": 4}
    other = retropole_here("fleet", "calibrate", fleet.parent / "good", "--out", out, "--strict")
    assert other.returncode == 0
    assert "in the dataset, and its report, besides: 7 sites not in SITES" in other.stdout


@pytest.mark.usefixtures("in_this_process")
@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("nothing.csv",), "no such file or folder"),
        (("{0}", "--workers", 2, "--scheduler", "tcp://a:1"), "not both"),
        (("{0}", "{0}"), "appears twice"),
        (("{0}", "--time-limit", 0), "--time-limit"),
    ],
)
def test_slips(fleet: Path, tmp_path: Path, words: tuple[object, ...], said: str) -> None:
    given = [str(word).format(fleet) for word in words]
    done = retropole_here("fleet", "calibrate", *given, "--out", tmp_path / "out")
    assert done.returncode == 2
    assert said in done.stderr
    assert "what to do: " in done.stderr


@pytest.mark.usefixtures("in_this_process")
def test_the_report_is_made_with_it_and_again(fleet: Path, tmp_path: Path) -> None:
    out, page, again = tmp_path / "out", tmp_path / "fleet.html", tmp_path / "again.html"
    words = ("fleet", "calibrate", fleet.parent / "small", "--out", out, "--report", page)
    done = retropole_here(*words)
    assert done.returncode == 0
    assert done.stdout.endswith(f"written: {out}\nwritten: {page}\n")
    made = retropole_here("fleet", "report", out, "--out", again)
    assert made.stdout == f"written: {again}\n"
    assert again.read_bytes() == page.read_bytes()
    none = retropole_here("fleet", "report", tmp_path, "--out", again)
    assert none.returncode == 2
    assert "is not a dataset of a fleet" in none.stderr
    assert "fleet calibrate --out" in none.stderr
    none = retropole_here("fleet", "report", out, "--history", tmp_path / "no", "--out", again)
    assert none.returncode == 2
    assert "no: is not a history of 'retropole fleet check'" in none.stderr


@pytest.mark.skipif(os.name == "nt", reason="the system has no SIGINT for one process")
def test_an_interrupt_leaves_whole_partitions_and_the_next_run_goes_on(
    fleet: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    words = ["fleet", "calibrate", str(fleet), "--workers", "1", "--out", str(out)]
    process = subprocess.Popen(
        [sys.executable, "-m", "retropole", *words],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # What a shell starts in the background ignores it, and so would this.
        preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),
    )
    while not any((out / "answers").glob("part-??.parquet")) and process.poll() is None:
        time.sleep(0.01)
    # As a terminal does: to every process that the command has started.
    os.killpg(process.pid, signal.SIGINT)
    assert process.wait() == 130
    assert process.stderr is not None
    assert process.stderr.read() == "retropole: interrupted\n"
    some = bytes_of(out)
    assert 0 < len(some) < 8
    whole = tmp_path / "whole"
    for each in (out, whole):
        calibrate_fleet(find_sites([str(fleet)]), str(each), here)
    assert bytes_of(out) == bytes_of(whole)
    assert some.items() <= bytes_of(whole).items()
