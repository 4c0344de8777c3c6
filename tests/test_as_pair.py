"""A pair is a site of two: the same recordings have one answer, however they are given."""

from dataclasses import replace

import numpy as np
import pytest

from retropole.base.datatypes import PointCloud
from retropole.base.description import Site, SiteLidar
from retropole.base.sensors import Sensor
from retropole.pipeline import Options, calibrate, calibrate_site
from retropole.result import encode
from retropole.result.site import found_document
from retropole.simulation import SimulatedPair, place_again, simulate_pair

RECORDINGS = (
    "street",
    "corridor",
    "harbor",
    "square",
    "three poles",
    "two placements",
    "sensors not named",
    "symmetric place",
    "parallel poles",
    "diameter for radius",
    "no intensity",
    "dim tape",
)


def recorded(kind: str) -> tuple[list[PointCloud], list[PointCloud], tuple[Sensor | None, ...]]:
    """What both LiDARs recorded in each placement, and what they are said to be."""
    rng = np.random.default_rng(RECORDINGS.index(kind))
    scene = kind if kind in RECORDINGS[:4] else "street"
    pair = simulate_pair(
        scene,
        rng,
        poles=3 if kind == "three poles" else 2,
        symmetric=kind == "symmetric place",
        min_pole_angle=0.0 if kind == "parallel poles" else np.radians(15.0),
        max_pole_angle=np.radians(3.0 if kind == "parallel poles" else 60.0),
    )
    pairs: list[SimulatedPair] = [pair]
    if kind == "two placements":
        pairs.append(place_again(pair, rng))
    targets, sources = [each.target for each in pairs], [each.source for each in pairs]
    if kind == "no intensity":
        sources = [replace(cloud, intensity=None) for cloud in sources]
    if kind == "dim tape":
        targets = [
            replace(cloud, intensity=np.minimum(cloud.intensity, 50.0))
            for cloud in targets
            if cloud.intensity is not None
        ]
    return targets, sources, (None, None) if kind == "sensors not named" else pair.sensors


DEFAULT = ("corridor",)
"""A sixtieth of the CPU time of all."""

NIGHTLY = ("dim tape", "harbor", "square")
"""A sixth of it, and what differs from a street in its surroundings alone."""


def tier_of(kind: str) -> list[pytest.MarkDecorator]:
    """Marks of the tier that a kind of recordings is compared in."""
    if kind in DEFAULT:
        return []
    return [pytest.mark.nightly if kind in NIGHTLY else pytest.mark.full]


@pytest.mark.parametrize(
    "kind",
    [pytest.param(kind, marks=tier_of(kind)) for kind in RECORDINGS],
)
def test_a_pair_and_a_site_of_two_have_one_answer(kind: str) -> None:
    targets, sources, sensors = recorded(kind)
    radius = 0.04 if kind == "diameter for radius" else 0.02
    pair = calibrate(
        targets, sources, options=Options(sensors=(sensors[0], sensors[1]), radius=radius)
    )
    lidars = (
        SiteLidar("target", tuple(targets), sensor=sensors[0]),
        SiteLidar("source", tuple(sources), sensor=sensors[1]),
    )
    names = tuple(str(1 + k) for k in range(len(targets)))
    site = calibrate_site(Site("two", lidars, names, radius=radius))
    codes = [sorted(reason.code for reason in each.reasons) for each in (pair, site)]
    assert (site.status, codes[1]) == (pair.status, codes[0])
    assert bool(site.lidars) == (pair.T_target_source is not None)
    if pair.T_target_source is None:
        return
    assert pair.covariance is not None
    for lidar, searched in enumerate(zip(*(each.scans for each in pair.placements), strict=True)):
        for scans in zip(searched, site.scans[lidar], strict=True):
            one, other = (found_document(scan) for scan in scans)
            assert one is not None
            assert other is not None
            # Of candidates a pair lists all, since other hypotheses pair them.
            assert {encode(pole) for pole in other.poles} <= {encode(pole) for pole in one.poles}
            assert [encode(each) for each in other.rejected] == [
                encode(each) for each in one.rejected
            ]
    np.testing.assert_array_equal(site.lidars[0].T_site_lidar, np.eye(4))
    found = site.lidars[1]
    np.testing.assert_allclose(found.T_site_lidar, pair.T_target_source, atol=1e-12)
    np.testing.assert_allclose(found.covariance, pair.covariance, rtol=1e-9)
    if pair.fitness is not None:
        assert pair.fitness == found.fitness
    assert [each.sigma_m for each in found.predicted_error] == [
        each.sigma_m for each in pair.predicted_error
    ]
    shares = [
        {entry.name: entry.share_at_30m for entry in budget}
        for budget in (pair.uncertainty.budget if pair.uncertainty else (), site.lidars[1].budget)
    ]
    named = {f"{name} of {who}": name for name in shares[0] for who in ("target", "source")}
    total: dict[str, float] = {}
    for name, share in shares[1].items():
        total[named.get(name, name)] = total.get(named.get(name, name), 0.0) + share
    assert total.keys() == shares[0].keys()
