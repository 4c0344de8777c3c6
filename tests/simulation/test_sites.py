"""Sites: their truth is true, poles link all LiDARs, and a blunder is what it says."""

import itertools
import json
import tomllib
from dataclasses import replace
from pathlib import Path

import click.testing
import numpy as np
import pytest

from retropole import se3
from retropole.cli.simulate import simulate
from retropole.errors import UsageError
from retropole.simulation import EXACT, SimulatedSite, Survey, simulate_site
from retropole.simulation.raycast import Cylinder
from retropole.simulation.site_arrangement import closes_otherwise
from retropole.simulation.site_blunders import disturbed
from retropole.simulation.site_graph import are_linked, groups_of
from tests.simulation.surfaces import distance_from


def made(kind: str = "truck", seed: int = 1, **given: object) -> SimulatedSite:
    given = {"lidars": 3, "noise": EXACT, "sensors": ("VLP-16",), **given}
    return simulate_site(kind, np.random.default_rng(seed), **given)  # type: ignore[arg-type]


def largest_distance(site: SimulatedSite, lidar: int, placement: int, pole: int) -> float:
    """How far the returns labelled as of a pole lie from where it stood first."""
    cloud, labels = site.clouds[lidar][placement], site.labels[lidar][placement]
    assert cloud is not None
    assert labels is not None
    own = cloud.xyz[labels == len(site.surroundings) + pole]
    world = se3.apply(site.T_world_lidar[lidar], own)
    return float(distance_from(site.poles[placement][pole], world).max(initial=0.0))


def everything(site: SimulatedSite) -> set[tuple[int, int, int]]:
    """LiDAR, placement and pole of what is seen."""
    return {
        (lidar, p, k)
        for p, views in enumerate(site.seen)
        for lidar, view in enumerate(views)
        for k, own in enumerate(view)
        if own
    }


@pytest.mark.parametrize(
    ("kind", "lidars"), [("posts", 4), ("crane", 4), ("truck", 5), ("ring", 4)]
)
def test_exact_returns_lie_on_poles_that_link_all_lidars(kind: str, lidars: int) -> None:
    site = made(kind, lidars=lidars)
    seen = everything(site)
    assert max(largest_distance(site, *at) for at in seen) < 1e-8
    assert are_linked(site.seen, lidars)


def test_equal_generators_give_equal_sites() -> None:
    one, two = made(), made()
    for ours, theirs in zip(one.clouds, two.clouds, strict=True):
        for a, b in zip(ours, theirs, strict=True):
            assert a is not None
            assert b is not None
            np.testing.assert_array_equal(a.xyz, b.xyz)
    other = made(seed=2)
    assert not np.array_equal(other.T_world_lidar[0], one.T_world_lidar[0])


def test_a_lidar_keeps_its_range_error_in_all_placements() -> None:
    site = made(noise=replace(EXACT, zero_offset=0.5))
    for lidar, device in enumerate(site.devices):
        for p, pole in itertools.product(range(2), range(3)):
            if not site.seen[p][lidar][pole]:
                continue
            cloud, labels = site.clouds[lidar][p], site.labels[lidar][p]
            assert cloud is not None
            own = cloud.xyz[labels == len(site.surroundings) + pole]
            ranges = np.linalg.norm(own, axis=1, keepdims=True)
            true = own * (1 - device.zero_offset / ranges)
            world = se3.apply(site.T_world_lidar[lidar], true)
            assert distance_from(site.poles[p][pole], world).max() < 1e-8


def test_neighbours_in_a_ring_share_their_own_placement_only() -> None:
    site = made("ring", lidars=5)
    for p, view in enumerate(site.seen):
        pair = {p, (p + 1) % 5}
        assert {lidar for lidar, own in enumerate(view) if all(own)} == pair
        assert {lidar for lidar in range(5) if site.clouds[lidar][p] is not None} == pair
        one, two = site.poles[p]
        middle = (one.centre + two.centre) / 2
        turn = np.diag([-1.0, -1.0, 1.0])
        np.testing.assert_allclose(turn @ (one.centre - middle) + middle, two.centre, atol=1e-12)
        np.testing.assert_allclose(turn @ one.axis, two.axis, atol=1e-12)


def test_a_ring_closes_otherwise_where_half_turns_cancel() -> None:
    square = np.array([[0.0, 0.0], [5.0, 0.0], [5.0, 5.0], [0.0, 5.0]])
    assert closes_otherwise(square)
    assert not closes_otherwise(square[:3])


def test_groups_are_linked_by_two_poles_of_one_placement() -> None:
    both, one = (True, True), (True, False)
    assert groups_of([[both, both, one]], 3) == [(0, 1), (2,)]
    assert groups_of([[both, both, one], [one, both, both]], 3) == [(0, 1, 2)]
    assert groups_of([[one, one]] * 2, 2) == [(0,), (1,)]


def test_a_bumped_pole_is_elsewhere_for_those_that_record_later() -> None:
    for seed in range(3):
        site = made(seed=seed, blunder="pole")
        blunder = site.blunder
        assert blunder is not None
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
        site = made(seed=seed, blunder="files")
        blunder = site.blunder
        assert blunder is not None
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
        site = made("posts", seed, lidars=2, placements=1, poles=2, blunder="slide")
        blunder = site.blunder
        assert blunder is not None
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
    site = made(blunder="control", survey=survey)
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


def test_lidars_see_control_points_where_they_are() -> None:
    site = made(survey=Survey(points=4))
    for point in site.true_points:
        assert len(point.seen) >= 2
        for own in point.seen:
            np.testing.assert_allclose(
                se3.apply(site.T_world_lidar[own.lidar], own.at[None])[0], point.at, atol=1e-9
            )


@pytest.mark.parametrize(
    "given",
    [
        {"kind": "square"},
        {"lidars": 1},
        {"kind": "ring", "lidars": 2},
        {"kind": "ring", "placements": 2},
        {"placements": 9},
        {"poles": 1},
        {"blunder": "wind"},
        {"blunder": "control"},
        {"blunder": "files", "placements": 1},
        {"survey": Survey(placements=(2,))},
    ],
)
def test_what_no_site_has_is_refused(given: dict[str, object]) -> None:
    with pytest.raises(UsageError):
        made(**given)  # type: ignore[arg-type]


def test_the_command_writes_recordings_site_file_and_truth(tmp_path: Path) -> None:
    words = ["site", "truck", "--lidars", "3", "--sensor", "VLP-16", "--survey", "--seed", "1"]
    words += ["--blunder", "pole", "--out", str(tmp_path)]
    done = click.testing.CliRunner().invoke(simulate, words, standalone_mode=False)
    assert done.exception is None
    truth = json.loads((tmp_path / "truth.json").read_text())
    site = tomllib.loads((tmp_path / "site.toml").read_text())
    assert [own["name"] for own in site["lidar"]] == [own["name"] for own in truth["lidars"]]
    assert all((tmp_path / name).is_file() for own in site["lidar"] for name in own["recordings"])
    assert len(site["control_point"]) == 4
    assert len(site["surveyed_pole"]) == 3
    assert truth["blunder"]["kind"] == "pole"
