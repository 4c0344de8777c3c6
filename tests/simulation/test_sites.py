"""Sites: their truth is true, and poles link all LiDARs."""

import itertools
import json
import tomllib
from dataclasses import replace
from pathlib import Path

import click.testing
import numpy as np
import pytest

from retropole.base import se3
from retropole.base.errors import UsageError
from retropole.cli import cli
from retropole.simulation import EXACT, SimulatedSite, Survey, simulate_site
from retropole.simulation.site_places import are_linked, closes_otherwise, groups_of
from retropole.simulation.sites import draw_site, record_site
from tests.simulation.sites import everything, largest_distance
from tests.simulation.surfaces import distance_from
from tests.tiers import first_of

pytestmark = pytest.mark.full


def made(kind: str = "truck", seed: int = 1, **given: object) -> SimulatedSite:
    given = {"lidars": 3, "noise": EXACT, "sensors": ("VLP-16",), **given}
    return simulate_site(kind, np.random.default_rng(seed), **given)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("kind", "lidars"), first_of([("posts", 4), ("crane", 4), ("truck", 5), ("ring", 4)])
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
        {"survey": Survey(placements=(2,))},
    ],
)
def test_what_no_site_has_is_refused(given: dict[str, object]) -> None:
    with pytest.raises(UsageError):
        made(**given)  # type: ignore[arg-type]


def test_the_command_writes_recordings_site_file_and_truth(tmp_path: Path) -> None:
    words = [
        "simulate",
        "site",
        "truck",
        "--lidars",
        "3",
        "--sensor",
        "VLP-16",
        "--survey",
        "--seed",
        "1",
    ]
    words += ["--out", str(tmp_path)]
    done = click.testing.CliRunner().invoke(cli, words, standalone_mode=False)
    assert done.exception is None
    truth = json.loads((tmp_path / "truth.json").read_text())
    site = tomllib.loads((tmp_path / "site.toml").read_text())
    assert [own["name"] for own in site["lidar"]] == [own["name"] for own in truth["lidars"]]
    assert all((tmp_path / name).is_file() for own in site["lidar"] for name in own["recordings"])
    assert len(site["control_point"]) == 4
    assert len(site["surveyed_pole"]) == 3


def test_poles_may_stand_elsewhere_for_one_lidar() -> None:
    given = {"lidars": 3, "noise": EXACT, "sensors": ("VLP-16",)}
    drawn = draw_site("truck", np.random.default_rng(1), **given)  # type: ignore[arg-type]
    up = np.array([0.0, 0.0, 0.05])
    raised = [[replace(pole, centre=pole.centre + up) for pole in own] for own in drawn.at.poles]
    site = record_site(drawn, standing=[drawn.at.poles, drawn.at.poles, raised])
    as_drawn = made()
    for lidar, (ours, theirs) in enumerate(zip(site.clouds, as_drawn.clouds, strict=True)):
        same = [
            a is not None and b is not None and np.array_equal(a.xyz, b.xyz)
            for a, b in zip(ours, theirs, strict=True)
        ]
        assert all(same) if lidar < 2 else not any(same)
