"""The command ``retropole fleet check``."""

import json
import os
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from retropole.cli.fleet_check import in_words, json_line
from retropole.fleet.batch import calibrate_fleet
from retropole.fleet.history.run import FleetCheck, changes_of
from retropole.fleet.history.store import CheckRow, append, read
from retropole.fleet.sites import find_sites
from tests.cli.commands import retropole_here
from tests.fleet.fleets import here, write_fleet
from tests.fleet.history.checks import MOVED

pytest.importorskip("distributed", reason="needs the extra fleet")

pytestmark = [pytest.mark.usefixtures("in_this_process"), pytest.mark.full]


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_fleet(tmp_path_factory.mktemp("fleet"))


@pytest.fixture(scope="module")
def answers(fleet: Path) -> Path:
    out = fleet.parent / "answers"
    calibrate_fleet(find_sites([str(fleet)]), str(out), here)
    return out


def test_what_it_says(fleet: Path, answers: Path, tmp_path: Path) -> None:
    words = ("fleet", "check", fleet, "--answers", answers, "--history", tmp_path)
    done = retropole_here(*words)
    assert done.returncode == 0
    assert done.stdout.splitlines()[-1] == (
        "8 sites, 8 new checks; changed since their calibration: 0, undecided: 7"
    )
    assert "small/1: cannot tell (too_few_poles)" in done.stdout
    assert "damaged: error (usage: it was not calibrated: unreadable)" in done.stdout
    assert not done.stderr
    again = retropole_here(*words, "--json")
    assert again.returncode == 0
    told = json.loads(again.stdout)
    assert (told["schema"], told["sites"], told["changed"]) == ("retropole/fleet-check/1", 8, [])
    assert {each["id"] for each in told["not_told"]} >= {"yard", "absent", "small/1"}
    assert "good" not in {each["id"] for each in told["not_told"]}
    assert retropole_here(*words, "--quiet").stdout == ""


def test_a_site_that_changed_ends_with_its_own_code(
    fleet: Path, answers: Path, tmp_path: Path
) -> None:
    good = fleet.parent / "good"
    words = ("fleet", "check", good, "--answers", answers, "--history", tmp_path)
    assert retropole_here(*words).returncode == 0
    ((_, (row,)),) = read(str(tmp_path))
    assert row.step is not None
    # As if it had been watched in another year, and moved in it.
    before = [replace(row, time=row.time.replace(year=2020, month=k)) for k in range(1, 8)]
    moved = [
        replace(row, time=row.time.replace(year=2020, month=k), step=(row.step + MOVED).tolist())
        for k in (8, 9)
    ]
    append(str(tmp_path), [*before, *moved])
    done = retropole_here(*words)
    assert done.returncode == 4
    assert "good: step since 2020-08-" in done.stdout
    assert "not confirmed yet: another check decides" in done.stdout
    told = json.loads(retropole_here(*words, "--json").stdout)
    (event,) = told["changed"]
    assert (event["id"], event["kind"], event["new"]) == ("good", "step", False)
    np.testing.assert_allclose(event["size"], MOVED, atol=0.005)
    assert np.shape(event["covariance"]) == (6, 6)


def test_pairs_are_not_called_sites() -> None:
    row = CheckRow("a", datetime(2026, 3, 1, tzinfo=UTC), "cannot_tell")
    found = FleetCheck(0, (changes_of([row]),) * 15)
    assert in_words(found, 10).splitlines()[-1].startswith("15 pairs of 10 sites, 0 new checks; ")
    told = json.loads(json_line(found, 10))
    assert (told["sites"], told["pairs"]) == (10, 15)


def test_two_that_say_moved_and_what_is_damaged_are_reported(
    fleet: Path, answers: Path, tmp_path: Path
) -> None:
    words = ("fleet", "check", fleet.parent / "good", "--answers", answers, "--history", tmp_path)
    retropole_here(*words)
    ((_, (row,)),) = read(str(tmp_path))
    assert row.step is not None
    days = [replace(row, time=row.time.replace(year=2020, month=3, day=k)) for k in (1, 8, 15, 22)]
    # Too far apart for a step, and too near for a trend.
    gone = [(row.step + k * 3 * MOVED).tolist() for k in (0.4, 4.0)]
    moved = [
        replace(one, step=step, status="moved") for one, step in zip(days[2:], gone, strict=True)
    ]
    append(str(tmp_path), [*days[:2], *moved])
    bad = tmp_path / "month=2020-01" / "bad.parquet"
    bad.parent.mkdir()
    bad.write_bytes(b"PAR1")
    done = retropole_here(*words)
    assert done.returncode == 4
    assert "good: moved since 2020-03-15: now rotation" in done.stdout
    assert f"left out of the history: {bad}" in done.stdout
    told = json.loads(retropole_here(*words, "--json").stdout)
    assert "moved" in {each["kind"] for each in told["changed"]}
    assert str(bad) in told["damaged"][0]


def test_nothing_reported_is_not_nothing_found(fleet: Path, answers: Path, tmp_path: Path) -> None:
    words = ("fleet", "check", fleet.parent / "small", "--answers", answers)
    done = retropole_here(*words, "--history", tmp_path)
    assert done.returncode == 3


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("nothing.csv",), "no such file or folder"),
        (("{0}", "--workers", 2, "--scheduler", "tcp://a:1"), "not both"),
        (("{0}", "--answers", "{1}"), "is not a dataset"),
        (("{0}", "--time-limit", 0), "--time-limit"),
    ],
)
def test_slips(fleet: Path, tmp_path: Path, words: tuple[object, ...], said: str) -> None:
    given = [str(word).format(fleet, tmp_path) for word in words]
    done = retropole_here("fleet", "check", *given, "--history", tmp_path / "history")
    assert done.returncode == 2
    assert said in done.stderr
    assert "what to do: " in done.stderr
    assert not os.path.exists(tmp_path / "history")
