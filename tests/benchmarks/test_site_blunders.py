"""Sites with a blunder: it is what it says, and all else is as without."""

import itertools
import json
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

from benchmarks.site_blunders import Blunder, disturbed, simulate_blunder
from retropole.base import se3
from retropole.base.errors import UsageError
from retropole.simulation import EXACT, SimulatedSite, Survey, simulate_site
from retropole.simulation.raycast import Cylinder
from tests.paths import ROOT
from tests.simulation.sites import everything, largest_distance
from tests.simulation.surfaces import distance_from

pytestmark = pytest.mark.full

FEW = {"lidars": 3, "noise": EXACT, "sensors": ("VLP-16",)}


def wrong(
    blunder: str, kind: str = "truck", seed: int = 1, **given: object
) -> tuple[SimulatedSite, Blunder]:
    given = {**FEW, **given}
    return simulate_blunder(kind, np.random.default_rng(seed), blunder, **given)  # type: ignore[arg-type]


def test_all_that_no_bumped_pole_is_in_is_as_without() -> None:
    site, blunder = wrong("pole")
    sound = simulate_site("truck", np.random.default_rng(1), **FEW)  # type: ignore[arg-type]
    np.testing.assert_array_equal(site.T_world_lidar, sound.T_world_lidar)
    changed = set(itertools.product(blunder.lidars, blunder.placements))
    for lidar, p in itertools.product(range(3), range(2)):
        ours, theirs = site.clouds[lidar][p], sound.clouds[lidar][p]
        assert ours is not None
        assert theirs is not None
        assert np.array_equal(ours.xyz, theirs.xyz) == ((lidar, p) not in changed)


def test_a_bumped_pole_is_elsewhere_for_those_that_record_later() -> None:
    for seed in range(3):
        site, blunder = wrong("pole", seed=seed)
        moved = set()
        for lidar, p, pole in everything(site):
            if largest_distance(site, lidar, p, pole) > 1e-3:
                moved.add(lidar)
                assert (p, pole) == (blunder.placements[0], blunder.pole)
        seeing = {
            lidar
            for lidar, p, pole in everything(site)
            if (p, pole) == (blunder.placements[0], blunder.pole)
        }
        assert moved == seeing & set(blunder.lidars)
        assert moved
        assert seeing - moved


def test_exchanged_files_are_those_of_the_other_recording() -> None:
    for seed in range(3):
        site, blunder = wrong("files", seed=seed)
        ats = list(itertools.product(blunder.lidars, blunder.placements))
        assert len(ats) == 2
        for (lidar, p), (true_lidar, true_p) in (ats, ats[::-1]):
            cloud, labels = site.clouds[lidar][p], site.labels[lidar][p]
            assert cloud is not None
            assert labels is not None
            world = se3.apply(site.T_world_lidar[true_lidar], cloud.xyz)
            surfaces = (*site.surroundings, *site.poles[true_p])
            for k, surface in enumerate(surfaces):
                assert distance_from(surface, world[labels == k]).max(initial=0.0) < 1e-8


def between(a: Cylinder, b: Cylinder) -> tuple[float, float]:
    """Angle and distance of two axes."""
    across = np.cross(a.axis, b.axis)
    size = float(np.linalg.norm(across))
    return float(np.arcsin(size)), abs(float((a.centre - b.centre) @ across)) / size


def test_another_pole_does_not_show_one_that_slides() -> None:
    for seed in range(4):
        site, blunder = wrong("slide", "posts", seed, lidars=2, placements=1, poles=2)
        assert blunder.moved is not None
        assert blunder.kind == "pole"
        pushed = blunder.moved[:3, 3]
        assert 0.03 <= np.linalg.norm(pushed) <= 0.15
        assert pushed[2] == 0.0
        before = site.poles[0]
        after = disturbed(before, blunder, blunder.lidars[0], 0)
        assert between(*after) == pytest.approx(between(*before), abs=1e-9)


def test_one_surveyed_point_is_off() -> None:
    survey = Survey(placements=(0,), points=4, sigma=1e-6)
    site, _ = wrong("control", survey=survey)
    off = [
        float(np.linalg.norm(stated - true))
        for stated, true in (
            *((a.at, b.at) for a, b in zip(site.points, site.true_points, strict=True)),
            *(
                (getattr(a, end), getattr(b, end))
                for a, b in zip(site.surveyed, site.true_surveyed, strict=True)
                for end in ("foot", "top")
            ),
        )
    ]
    assert sorted(off)[-1] == pytest.approx(0.1, abs=1e-4)
    assert sorted(off)[-2] < 1e-4


@pytest.mark.parametrize(
    ("blunder", "given"),
    [
        ("wind", {}),
        ("control", {}),
        ("control", {"survey": Survey()}),
        ("files", {"placements": 1}),
    ],
)
def test_what_cannot_go_wrong_is_refused(blunder: str, given: dict[str, object]) -> None:
    with pytest.raises(UsageError):
        wrong(blunder, **given)  # type: ignore[arg-type]


def test_the_script_writes_a_site_and_what_is_wrong(tmp_path: Path) -> None:
    words = ["truck", "control", "--survey", "--lidars", "3", "--sensor", "VLP-16"]
    command = [sys.executable, str(ROOT / "benchmarks" / "blunder.py"), *words]
    command += ["--seed", "1", "--out", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    truth = json.loads((tmp_path / "truth.json").read_text())
    site = tomllib.loads((tmp_path / "site.toml").read_text())
    assert all((tmp_path / name).is_file() for own in site["lidar"] for name in own["recordings"])
    assert truth["blunder"]["kind"] == "control"
    assert f"wrong: {truth['blunder']['name']}\n" in done.stdout
