"""Every script that prints figures or draws pictures starts, runs to its end and prints something.

What it prints is compared with the pages in `test_figures`; examples run in `test_examples`.
"""

from __future__ import annotations

import io
import shlex
import subprocess
import sys
from contextlib import redirect_stdout
from pathlib import Path

import numpy as np
import pytest

from benchmarks.figures_run import runnable
from retropole.simulation import simulate_pair, write_pair
from tests.paths import ROOT, SHARED

pytestmark = pytest.mark.full

RECORDED, STREET = "data", "street"
"""Words that stand for folders: of the real recordings, and of a simulated pair."""

SMALLEST = {
    "benchmarks/accuracy.py": ["--seeds 1 --scenes bare"],
    "benchmarks/blunder.py": ["posts pole --lidars 2 --placements 1"],
    "benchmarks/bound.py": ["--setups 1 --trials 1"],
    "benchmarks/carried.py": [
        "--seeds 1 --seconds 8 --scene bare --standing",
        "--seeds 1 --seconds 8 --scene bare --lidars 3",
    ],
    "benchmarks/carried_recorded.py": ["data --draws 1 --seconds 2"],
    "benchmarks/certify.py": ["--runs 1 --only field"],
    "benchmarks/check.py": ["--sites 1 --noise typical"],
    "benchmarks/codes.py": ["--easy 0 --hard 1 --draws 0"],
    "benchmarks/contradictions.py": ["--seeds 3000:3001"],
    "benchmarks/coverage.py": ["--runs 1 --families stating --only bent"],
    "benchmarks/deception.py": ["--draws 1 --rows 'nothing wrong'"],
    "benchmarks/detection.py": ["--seeds 1 --scenes bare"],
    "benchmarks/detection_hard.py": ["--scenes 1"],
    "benchmarks/figures.py": ["", "--share 0.05 --only lamppost"],
    "benchmarks/fit.py": ["--runs 1"],
    "benchmarks/fleet.py": ["speed --pairs 1"],
    "benchmarks/fleet_history.py": ["--sites 1 --laws Gaussian --changes none"],
    "benchmarks/fleet_network.py": ["--nodes 100 --seeds 2000:2001"],
    "benchmarks/fleet_replay.py": ["--sites 2 --checks 60 --workers 1"],
    "benchmarks/fleet_weekly.py": ["--cases 0 --weeks 1"],
    "benchmarks/growth.py": ["--methods poles+scene --points 5000 --frames --poles --lidars 2"],
    "benchmarks/hard_scenes.py": ["--scenes 1"],
    "benchmarks/hypotheses.py": ["--seeds 1 --scenes corridor"],
    "benchmarks/insert.py": [
        "street/lidar0.pcd street/lidar1.pcd --transform street/truth.json --poles 1"
    ],
    "benchmarks/leveling.py": ["--seeds 1000:1001"],
    "benchmarks/leveling_recorded.py": ["data --every 7"],
    "benchmarks/limits.py": ["--scene bare --frames 2 --mib 1 --points 9000 --bags 1"],
    "benchmarks/mapped.py": ["--draws 1"],
    "benchmarks/masts.py": ["--runs 1 --heights 2 --distances 6 --models VLP-16"],
    "benchmarks/merge_live.py": ["--lidars 2 --minutes 0"],
    "benchmarks/merging.py": ["--seeds 100 101 --scenes street --noise typical"],
    "benchmarks/no_poles.py": ["data --every 1000"],
    "benchmarks/odds.py": ["--seeds 1 --kinds VLP-16"],
    "benchmarks/plan.py": ["--seeds 1000:1001 --runs 1 --kinds bare"],
    "benchmarks/real.py": ["data --draws 1 --pairs 201"],
    "benchmarks/real_site.py": ["data --draws 1"],
    "benchmarks/refusals.py": ["data --every 1000"],
    "benchmarks/repeats.py": ["--seeds 1"],
    "benchmarks/rivals.py": ["--seeds 1 --scenes bare --methods poles+scene"],
    "benchmarks/same_answers.py": ["record answers --share 0.01", "compare answers"],
    "benchmarks/semireal.py": ["data --draws 1 --pairs 'pandar_scene1 qt_201'"],
    "benchmarks/site.py": ["rings --seeds 2000:2001"],
    "benchmarks/sites.py": ["--seeds 0"],
    "benchmarks/speed.py": ["--seeds 1 --points 5000 --rounds 1"],
    "benchmarks/sweeps.py": ["--places 1 --frames 1 2"],
    "benchmarks/sway.py": ["--runs 1 --sizes 0.05 --frequencies 0.3 --frames 2"],
    "benchmarks/units.py": ["--seeds 1000:1001 --kinds"],
    "benchmarks/watch.py": ["--runs 1 --only good"],
    "benchmarks/watch_load.py": [
        "--minutes 0",
        "--by udp --minutes 0",
        *(f"--decode 500 --models {name}" for name in ("XT32", "Helios", "M1", "'Mid-360, HAP'")),
    ],
    "benchmarks/wrong_files.py": ["data --wrong 1 --right 0"],
    "docs/make_images.py": ["images --only bias"],
    "docs/make_pages.py": ["--check"],
    "studies.paper": ["--seeds 1 --only table1"],
}
"""The least that each can do, in turn, as it is typed."""

AS_PROCESSES = ("benchmarks/growth.py",)
"""What starts processes of its own, which have to find it."""


def scripts() -> set[str]:
    """Every file that is run, and the package after ``-m``; others are imported by these."""
    found = [*(ROOT / "benchmarks").glob("*.py"), *(ROOT / "docs").glob("*.py")]
    run = [p for p in found if '\nif __name__ == "__main__":' in p.read_text(encoding="utf-8")]
    packages = [p.parent for p in (ROOT / "studies").rglob("__main__.py")]
    named = {path.relative_to(ROOT).as_posix() for path in run}
    return named | {".".join(path.relative_to(ROOT).parts) for path in packages}


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("street")
    write_pair(simulate_pair("bare", np.random.default_rng(1)), folder)
    return folder


def test_every_script_has_its_smallest_run() -> None:
    assert scripts() == set(SMALLEST)


@pytest.mark.parametrize("script", SMALLEST)
def test_a_script_runs_to_its_end_and_prints(
    script: str, street: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / STREET).symlink_to(street, target_is_directory=True)
    for line in SMALLEST[script]:
        words = shlex.split(line)
        if RECORDED in words:
            if not SHARED.is_dir():
                pytest.skip("the real recordings of ../shared/data are absent")
            words = [str(SHARED) if word == RECORDED else word for word in words]
        printed = as_process if script in AS_PROCESSES else here
        assert printed(script, words, monkeypatch).strip(), line


def here(script: str, words: list[str], monkeypatch: pytest.MonkeyPatch) -> str:
    """What a script prints in this process, without pools of its own."""
    monkeypatch.setattr(sys, "argv", [script, *words])
    run, out = runnable(script), io.StringIO()
    with redirect_stdout(out):
        try:
            run()
        except SystemExit as ended:
            if ended.code:
                pytest.fail(f"exit {ended.code}")
    return out.getvalue()


def as_process(script: str, words: list[str], _: pytest.MonkeyPatch) -> str:
    command = [sys.executable, str(ROOT / script), *words]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


ONCE = """
import pytest

@pytest.fixture
def benchmark():
    return lambda step, *given, **named: step(*given, **named)
"""
"""What stands for pytest-benchmark, which times each step many times."""


def test_the_steps_that_are_timed_run(tmp_path: Path) -> None:
    (tmp_path / "once.py").write_text(ONCE)
    command = (
        "import sys, pytest; sys.path.insert(0, sys.argv[1]); sys.exit(pytest.main(sys.argv[2:]))"
    )
    steps = ROOT / "benchmarks" / "test_steps.py"
    words = ["-p", "no:benchmark", "-p", "once", "-p", "no:cacheprovider", "-m", "", str(steps)]
    done = subprocess.run(
        [sys.executable, "-c", command, str(tmp_path), *words], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout
