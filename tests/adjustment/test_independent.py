"""The same observations, adjusted by GTSAM, give the same poses and the same covariance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from retropole.adjustment.datum import find_datum
from retropole.adjustment.descent import scene_pairs
from retropole.adjustment.shared import shared_poles
from retropole.adjustment.site import Adjusted, Recorded, adjust
from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.base.description import Site, Up
from retropole.base.errors import Refusal
from retropole.hypotheses.scans import find_scans, patches_of
from retropole.simulation import SimulationError
from retropole.simulation.sites import Survey, simulate_site
from tests.tiers import first_of

pytestmark = pytest.mark.full

pytest.importorskip("gtsam", reason="GTSAM has no wheel here")
gtsam_adjustment = pytest.importorskip("tests.adjustment.gtsam_adjustment")

AGREE = 1e-6
"""Of 1 σ: far below anything that an adjustment is used for, far above rounding."""

FINE = 1e-5
"""Part of 1 σ that the last step may have here. Forces of poles, survey and scenes that balance
each other turn by half of it, to first order; GTSAM solves with them as they are there."""

SURVEYS = (None, Survey((0,)), Survey(points=4), Survey((1,), points=2))
UP_SIGMA = np.radians(0.2)


@pytest.fixture(autouse=True)
def fine_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("retropole.adjustment.descent.STEP", FINE)


def simulated(seed: int) -> Adjusted:
    """Adjust the site of a seed: three to five LiDARs, two placements, each with another datum."""
    rng = np.random.default_rng(seed)
    simulation = simulate_site(
        ("posts", "truck")[seed % 2],
        rng,
        lidars=3 + seed % 3,
        sensors=["VLP-16"],
        survey=SURVEYS[seed % 4],
    )
    poses = simulation.T_world_lidar
    site = simulation.as_site()
    if seed % 5 == 0:
        site = with_up(site, poses, rng)
    scans = find_scans(site)
    about = [
        T @ se3.from_rt(np.eye(3), origin) for T, origin in zip(poses, scans.origins, strict=True)
    ]
    # Matching is not what is tested: poses are those that it would find.
    found = {i: se3.inverse(about[0]) @ T for i, T in enumerate(about)}
    poles = shared_poles(scans, found, site.radius)
    datum = find_datum(site, scans.origins, found, poles)
    patches = patches_of(scans)
    scenes = scene_pairs(patches, range(len(poses)))
    return adjust(Recorded(site, scans, patches, scenes), datum)


def with_up(site: Site, poses: tuple[Array, ...], rng: np.random.Generator) -> Site:
    """Give the first two LiDARs an inertial sensor."""
    lidars = list(site.lidars)
    for i in (0, 1):
        leaning = rng.normal(0.0, UP_SIGMA, 3)
        way = poses[i][:3, :3].T @ se3.exp_so3(leaning)[:, 2]
        lidars[i] = replace(lidars[i], up=Up(way, float(UP_SIGMA)))
    return replace(site, lidars=tuple(lidars))


def disagreement(adjusted: Adjusted, seed: int) -> tuple[float, float]:
    """Largest difference of an unknown, in σ, and of a covariance, in σ σ."""
    end = adjusted.end
    found = gtsam_adjustment.adjust_with_gtsam(adjusted, np.random.default_rng(seed))
    sigma = np.sqrt(np.diag(end.inverse))
    poses = adjusted.network.unknowns.poses
    moved = np.concatenate([se3.local(a, b) for a, b in zip(end.T, found.T, strict=True)])
    free = np.flatnonzero(sigma[:poses])
    assert np.abs(moved[sigma[:poses] == 0]).max(initial=0.0) < 1e-10
    rest = np.flatnonzero(np.arange(adjusted.network.unknowns.size) >= len(sigma))
    values = adjusted.solved.values[rest]
    all_sigma = np.sqrt(np.diag(adjusted.solved.inverse))
    means = np.r_[
        moved[free] / sigma[free],
        (found.errors - end.errors) / sigma[poses:],
        (np.r_[found.axes, found.points] - values) / all_sigma[rest],
    ]
    block = np.ix_(free, free)
    apart = (found.covariance - end.inverse[:poses, :poses])[block]
    covariances = np.r_[
        (apart / np.outer(sigma[free], sigma[free])).reshape(-1),
        found.of_errors / sigma[poses:] ** 2 - 1.0,
    ]
    return float(np.abs(means).max()), float(np.abs(covariances).max())


@pytest.mark.parametrize("seed", first_of([0, 3]))
def test_another_adjustment_agrees(seed: int) -> None:
    assert max(disagreement(simulated(seed), seed)) < AGREE


@pytest.mark.parametrize(
    "sites", [pytest.param(2, marks=pytest.mark.full), pytest.param(100, marks=pytest.mark.nightly)]
)
def test_another_adjustment_agrees_on_many_sites(
    sites: int, capsys: pytest.CaptureFixture[str]
) -> None:
    found: list[tuple[float, float]] = []
    refused, seed = [], 0
    while len(found) < sites:
        try:
            adjusted = simulated(seed)
        except (Refusal, SimulationError):
            refused.append(seed)
        else:
            assert adjusted.end.converged, seed
            found.append(disagreement(adjusted, seed))
        seed += 1
    means, covariances = np.max(found, axis=0)
    with capsys.disabled():
        print(
            f"\n{sites} sites, seeds {refused} not simulated or refused; largest difference: "
            f"means {means:.1e} σ, covariances {covariances:.1e} σσ"
        )
    assert max(means, covariances) < AGREE
