"""Small simulated sites, and all that their calibration goes through, step by step."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks.site_blunders import Blunder, simulate_blunder
from retropole.adjustment.answer import SiteCalibration
from retropole.adjustment.datum import Datum, find_datum
from retropole.adjustment.descent import ScenePair, scene_pairs
from retropole.adjustment.shared import SharedPole, shared_poles, sights_of
from retropole.adjustment.site import Adjusted, Recorded, adjust
from retropole.alignment.maximum import Sight
from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.base.description import Site
from retropole.base.se3 import RelativePose, joint_of, relative
from retropole.hypotheses.joint_choice import Choices, choose_poses
from retropole.hypotheses.pairs import Pair, find_pairs, poles_of
from retropole.hypotheses.scans import SiteScans, Views, find_scans, patches_of, views_of
from retropole.simulation.sites import SimulatedSite, Survey, simulate_site
from retropole.surfaces.patches import Patches


@cache
def made(
    seed: int = 1,
    kind: str = "posts",
    lidars: int = 3,
    placements: int | None = 2,
    survey: Survey | None = None,
) -> SimulatedSite:
    """Three VLP-16 on posts that see three poles in two placements, if not otherwise said."""
    return simulate_site(
        kind,
        np.random.default_rng(seed),
        lidars=lidars,
        placements=placements,
        sensors=("VLP-16",),
        survey=survey,
    )


@cache
def made_wrong(blunder: str, seed: int = 1) -> tuple[SimulatedSite, Blunder]:
    """As `made`, with one thing wrong."""
    return simulate_blunder(
        "posts",
        np.random.default_rng(seed),
        blunder,
        lidars=3,
        placements=2,
        sensors=("VLP-16",),
    )


def one_thread() -> threadpool_limits:
    """Keep the threads of BLAS out of the way, as `calibrate_site` does."""
    return threadpool_limits(1, user_api="blas")


@dataclass(frozen=True, eq=False)
class Steps:
    """What the steps of `calibrate_site` hand to each other."""

    site: Site
    scans: SiteScans
    views: Views
    pairs: tuple[Pair, ...]
    at: list[Array]
    choices: Choices
    poles: list[SharedPole]
    datum: Datum
    patches: list[Patches | None]
    scenes: list[ScenePair]
    adjusted: Adjusted

    @property
    def sights(self) -> list[Sight]:
        return sights_of(self.scans, self.datum.poles)

    def again(self, datum: Datum, *, few: bool = False) -> Adjusted:
        """Adjust anew from another datum."""
        with one_thread():
            return adjust(self.recorded, datum, few=few)

    @property
    def recorded(self) -> Recorded:
        return Recorded(self.site, self.scans, self.patches, self.scenes)


def steps_of(site: Site) -> Steps:
    """Run what `calibrate_site` does on a site that nothing is wrong with."""
    scans = find_scans(site)
    views = views_of(scans)
    pairs = find_pairs(scans, views)
    count = len(site.lidars)
    at = [poles_of(scans, lidar) for lidar in range(count)]
    choices = choose_poses(range(count), pairs, at, 0)
    poles = shared_poles(scans, choices.best.poses, site.radius)
    datum = find_datum(site, scans.origins, choices.best.poses, poles)
    patches = patches_of(scans)
    scenes = scene_pairs(patches, range(count))
    with one_thread():
        adjusted = adjust(Recorded(site, scans, patches, scenes), datum)
    return Steps(site, scans, views, pairs, at, choices, poles, datum, patches, scenes, adjusted)


def reordered(site: Site, lidars: Sequence[int], placements: Sequence[int]) -> Site:
    """Give the same site with its LiDARs and placements in another order; nothing surveyed."""
    assert not site.poles
    assert not site.points
    return replace(
        site,
        lidars=tuple(
            replace(site.lidars[i], clouds=tuple(site.lidars[i].clouds[p] for p in placements))
            for i in lidars
        ),
        placements=tuple(site.placements[p] for p in placements),
        reference=list(lidars).index(site.reference),
    )


def with_lidar(site: Site, lidar: int, **changed: object) -> Site:
    """Give the same site with something of one LiDAR changed."""
    rows = list(site.lidars)
    rows[lidar] = replace(rows[lidar], **changed)  # type: ignore[arg-type]
    return replace(site, lidars=tuple(rows))


def poses_of(found: SiteCalibration) -> list[Array]:
    assert found.lidars, found.reasons
    return [one.T_site_lidar for one in found.lidars]


def between(found: SiteCalibration, i: int, j: int) -> RelativePose:
    """The pose of one LiDAR in the frame of another."""
    assert found.covariance is not None
    T = poses_of(found)
    return relative(T[i], T[j], joint_of(found.covariance, i, j))


def off(found: RelativePose, T: Array) -> float:
    """Squared Mahalanobis distance of a pose from one that was found."""
    step = se3.local(found.T_i_j, T)
    return float(step @ np.linalg.solve(found.covariance, step))
