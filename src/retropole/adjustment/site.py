"""One adjustment of a site: from chosen poses to adjusted ones, their covariance, and all tests."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..alignment.adjustment import (
    MAX_ROTATION_SIGMA,
    MAX_TRANSLATION_SIGMA,
    RADIUS_TOLERANCE,
    Aligned,
    BeamAlignment,
    align_all,
    pose_of_pair,
)
from ..alignment.certainty import POLES, Part, joint_covariance
from ..alignment.factor import OF_SOURCE
from ..alignment.joint import Sight
from ..alignment.network import Network, factor_of
from ..alignment.state import JointState
from ..alignment.unknowns import POSE
from ..base import se3
from ..base.datatypes import Array
from ..base.description import Site
from ..base.errors import Refusal
from ..base.systematic import MIN_ERROR_SIGMA, ErrorModel, Sizes, left_of_each
from ..extraction.sensor_pattern import error_sizes
from ..hypotheses.scans import SiteScans
from ..surfaces.patches import Patches
from .answer import Test
from .axes import maximise_from_lines
from .datum import Datum, without_poles
from .descent import End, RefinementProblem, minimise
from .hanging import check_hanging, check_poles_left
from .outliers import find_outlying
from .places import parts_of
from .refinement import Refinement, refine_pair
from .shared import sights_of
from .snooping import all_tests
from .solved import Solved, solve_all
from .terms import ScenePair

POLES_AND_SURVEY = f"{POLES} and of the survey"
"""What the budget calls their scatter."""

MORE_NOISE, LEAST_BOUND = 1.5, 0.005
"""A LiDAR's returns lie so much further from the common axes than from its own at most, beyond a
least bound in metres: of few returns axes of their own take up much of the noise, ten lie
√(10/6) = 1.3 times nearer. More is no noise, but a pole that moved."""


@dataclass(frozen=True, eq=False)
class Recorded:
    """What an adjustment starts from: the site, what was recorded, and its surfaces.

    Attributes
    ----------
    site, scans
        What was recorded.
    patches, scenes
        Surfaces of each LiDAR, and the pairs that may be compared.
    """

    site: Site
    scans: SiteScans
    patches: Sequence[Patches | None]
    scenes: Sequence[ScenePair]

    @cached_property
    def sizes(self) -> tuple[Sizes, ...]:
        """Of the systematic errors of each LiDAR."""
        return tuple(
            error_sizes(next(cloud for cloud in lidar.clouds if cloud is not None), lidar.sensor)
            for lidar in self.site.lidars
        )

    @cached_property
    def left(self) -> tuple[Array, ...]:
        """What is left of the sway of each LiDAR; none where all stood."""
        every = range(len(self.site.lidars))
        return left_of_each([[scan.sway for scan in self.scans.used(i)] for i in every])


@dataclass(frozen=True, eq=False)
class Adjusted:
    """An adjusted site.

    Attributes
    ----------
    datum
        What it started from.
    aligned, problem, end
        Where the poles and the survey ended, what the scenes add, and where all ended together.
    parts, covariance
        Every source of error, and (6 L, 6 L) of all poses.
    solved, tests
        All unknowns at the answer, and every test of an observation.
    converged
        Whether poles and refinement came to rest.
    poles, refined
        From `search_as_pair`.
    """

    datum: Datum
    aligned: Aligned
    problem: RefinementProblem
    end: End
    parts: tuple[Part, ...]
    covariance: Array
    solved: Solved
    tests: tuple[Test, ...]
    converged: bool
    poles: BeamAlignment | None = None
    refined: Refinement | None = None

    @property
    def network(self) -> Network:
        """The observations but those of the scene."""
        return self.aligned.network


def adjust(recorded: Recorded, datum: Datum, *, few: bool = False) -> Adjusted:
    """Adjust all poses by poles, survey and scenes together.

    Parameters
    ----------
    recorded
        What was recorded.
    datum
        Poses to start from, shared poles and what is known of them.
    few
        Whether to adjust by a part of the surfaces alone, which is faster.

    Raises
    ------
    Refusal
        ``poor_fit``; ``degenerate_poles`` or ``survey_too_weak`` where a pose is left all but free.
    """
    site = recorded.site
    check_poles_left(site, datum.hanging, datum.poles)
    sights = sights_of(recorded.scans, datum.poles)
    radius_sigma = max(site.radius_sigma, RADIUS_TOLERANCE * site.radius, MIN_ERROR_SIGMA)
    none = np.zeros(0, dtype=np.int64)
    aligned = align_all(
        _start(site, datum),
        sights,
        ErrorModel(recorded.sizes, radius_sigma),
        np.array([pole.placement for pole in datum.poles], dtype=np.int64),
        datum.free,
        surveyed=datum.surveyed,
        scene_bands=[none if one is None else np.unique(one.bands) for one in recorded.patches],
        most_noise=_most_noise(sights, site),
    )
    factor = factor_of(aligned.network, left=recorded.left)
    groups = aligned.network.unknowns.groups()
    known = ErrorModel(recorded.sizes, aligned.radius_sigma).sigmas(groups)
    problem = RefinementProblem(factor, tuple(recorded.scenes), groups, known)
    end = minimise(problem, few=few)
    parts = parts_of(problem, end, POLES_AND_SURVEY)
    covariance = joint_covariance(parts)
    check_held(site, covariance, is_surveyed=bool(site.poles or site.points))
    check_hanging(site, datum.hanging, end.T, covariance)
    return _tested(recorded, datum, aligned, problem, end, parts)


def search_as_pair(recorded: Recorded, adjusted: Adjusted) -> Adjusted:
    """Search the pose of two LiDARs from several starts, and state it as that of a pair.

    Where there are more, or the first one's frame is not that of the site, others and the survey
    hold what a pair alone may not; the adjustment then stays as it is.

    Parameters
    ----------
    recorded
        As for `adjust`.
    adjusted
        The site, without what did not fit.
    """
    aligned, problem = adjusted.aligned, adjusted.problem
    model = ErrorModel(recorded.sizes, aligned.radius_sigma, recorded.left)
    poles = _poles_of_pair(aligned, model)
    if poles is None or not problem.scenes:
        return adjusted
    own, far = recorded.patches[0], recorded.patches[1]
    assert own is not None
    assert far is not None
    ranges = [se3.lengths(scan.cloud.xyz - scan.cloud.origin) for scan in recorded.scans.used(1)]
    lever = float(np.median(np.concatenate(ranges)))
    refined = refine_pair(problem, poles.pose, (own, far), lever)
    if refined is None:
        return adjusted
    end, parts = refined.end, refined.parts
    found = _tested(recorded, adjusted.datum, aligned, problem, end, parts)
    return replace(found, poles=poles, refined=refined)


def _tested(
    recorded: Recorded,
    datum: Datum,
    aligned: Aligned,
    problem: RefinementProblem,
    end: End,
    parts: tuple[Part, ...],
) -> Adjusted:
    """Test every observation at the answer."""
    at = solve_all(aligned.network, end, problem.groups, parts)
    sights = sights_of(recorded.scans, datum.poles)
    astray_at = find_outlying(aligned.maximum.point, aligned.network, sights)
    beside = {(i, k): chi2 for i, k, chi2 in astray_at}
    tests = tuple(all_tests(at, recorded.site, datum.poles, beside))
    converged = aligned.maximum.converged and end.converged
    covariance = joint_covariance(parts)
    return Adjusted(datum, aligned, problem, end, parts, covariance, at, tests, converged)


def _start(site: Site, datum: Datum) -> JointState:
    count = len(site.lidars)
    return JointState(
        np.stack([datum.poses.get(i, np.eye(4)) for i in range(count)]),
        np.zeros(count),
        site.radius,
        np.array([pole.point for pole in datum.poles]).reshape(-1, 3),
        np.array([pole.direction for pole in datum.poles]).reshape(-1, 3),
        np.array([point.at for point in datum.surveyed.known]).reshape(-1, 3),
    )


def _poles_of_pair(aligned: Aligned, model: ErrorModel) -> BeamAlignment | None:
    """What the poles say of two LiDARs in the frame of the first; None where they leave it open."""
    if not np.array_equal(aligned.network.free, OF_SOURCE):
        return None
    try:
        return pose_of_pair(aligned, model)
    except Refusal:
        # Without a pole that moved one may be left, and the scene holds the rest.
        return None


def _most_noise(sights: Sequence[Sight], site: Site) -> Array:
    """(L, 2) most noise of each LiDAR's returns, by how they lie about axes of its own, metres."""
    most = np.full((len(site.lidars), 2), np.inf)
    for sight in sights:
        _, own = maximise_from_lines(sight.beams, site.radius)
        most[sight.lidar] = np.maximum(MORE_NOISE * own, LEAST_BOUND)
    return most


def check_held(site: Site, covariance: Array, *, is_surveyed: bool) -> None:
    """Refuse poses that poles, survey and scenes leave all but free.

    Raises
    ------
    Refusal
        ``survey_too_weak`` where all are free together, ``degenerate_poles`` where one is.
    """
    variance = np.diag(covariance).reshape(-1, POSE)
    turned = np.sqrt(variance[:, :3].max(axis=1))
    moved = np.sqrt(variance[:, 3:].max(axis=1))
    free = np.flatnonzero((turned > MAX_ROTATION_SIGMA) | (moved > MAX_TRANSLATION_SIGMA))
    if not len(free):
        return
    worst = int(free[np.argmax(moved[free])])
    words = f"{np.degrees(turned[worst]):.1f}° and {moved[worst]:.2f} m (1 σ)"
    values = {
        "rotation_sigma_rad": float(turned[worst]),
        "translation_sigma_m": float(moved[worst]),
    }
    if is_surveyed and len(free) == len(site.lidars):
        raise Refusal(
            "survey_too_weak",
            f"the survey leaves the site free by {words}: survey both ends of a second pole, or "
            "more control points",
            values,
        )
    name = site.lidars[worst].name
    raise Refusal(
        "degenerate_poles",
        f"the poles leave {name} free by {words}; add a pole or a placement that it sees with "
        "others",
        {"lidar": name, **values},
    )


def without_observations(datum: Datum, lidar: int, placement: int) -> Datum:
    """Leave out what one LiDAR saw of the poles of one placement."""
    poles = []
    gone = set()
    for k, pole in enumerate(datum.poles):
        seen = dict(pole.seen)
        if pole.placement == placement:
            seen.pop(lidar, None)
        poles.append(replace(pole, seen=seen))
        if not seen or (len(seen) == 1 and pole.surveyed is None):
            gone.add(k)
    return without_poles(replace(datum, poles=poles), gone)
