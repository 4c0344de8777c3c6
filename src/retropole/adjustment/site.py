"""One adjustment of a site: from chosen poses to adjusted ones, their covariance, and all tests.

What links a site: pairs that link all LiDARs, and the poles that both sides see.

Two LiDARs that nothing but each other ties, tested as a site is: every observation of poles.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations

import numpy as np
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree

from ..alignment.adjustment import (
    MAX_ROTATION_SIGMA,
    MAX_TRANSLATION_SIGMA,
    RADIUS_TOLERANCE,
    Aligned,
    BeamAlignment,
    align_all,
)
from ..alignment.certainty import POLES, Part, joint_covariance
from ..alignment.maximum import Sight
from ..alignment.network import OF_SOURCE, Network, factor_of
from ..alignment.posterior import JointState
from ..alignment.survey import NOTHING_SURVEYED
from ..alignment.unknowns import POSE
from ..base import se3
from ..base.datatypes import Array, Test
from ..base.description import Site
from ..base.errors import Refusal
from ..base.systematic import MIN_ERROR_SIGMA, ErrorModel, Sizes, remaining_sway_of_each
from ..extraction.sensor_pattern import error_sizes
from ..hypotheses.placements import PairedPlacement, remaining_sway_in
from ..hypotheses.scans import SiteScans
from ..surfaces.patches import Patches
from .axes import maximise_from_lines
from .datum import Datum, check_dependent, check_poles_left, of_lidar, without_poles
from .descent import End, RefinementProblem, ScenePair, minimise
from .refinement import Refinement
from .shared import SharedPole, extent_of, sights_of
from .snooping import all_tests, find_outlying
from .solved import Solved, parts_of, solve_all

POLES_AND_SURVEY = f"{POLES} and of the survey"
"""What the budget calls their scatter."""

MORE_NOISE, LEAST_BOUND = 1.5, 0.005
"""At most this much further do a LiDAR's returns lie from the common axes than from its separate
axes, beyond a least bound in metres: of few returns separate axes take up much of the noise, ten
lie √(10/6) = 1.3 times nearer. More is not noise, but a pole that moved."""


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
        """What is left of the sway of each LiDAR; empty if none swayed."""
        every = range(len(self.site.lidars))
        return remaining_sway_of_each([[scan.sway for scan in self.scans.used(i)] for i in every])


@dataclass(frozen=True, eq=False)
class Adjusted:
    """An adjusted site.

    Attributes
    ----------
    datum
        What it started from.
    aligned, end
        Where the poles and the survey ended, and where all ended together.
    parts, covariance
        Every source of error, and (6 L, 6 L) of all poses.
    solved, tests
        All unknowns at the answer, and every test of an observation.
    converged
        Whether poles and refinement came to rest.
    """

    datum: Datum
    aligned: Aligned
    end: End
    parts: tuple[Part, ...]
    covariance: Array
    solved: Solved
    tests: tuple[Test, ...]
    converged: bool

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
        Poses to start from, shared poles and the surveyed values.
    few
        Whether to adjust by a part of the surfaces alone, which is faster, and to test nothing.

    Raises
    ------
    Refusal
        ``poor_fit``; ``degenerate_poles`` or ``survey_too_weak`` where a pose is left all but free.
    """
    site = recorded.site
    check_poles_left(site, datum.dependent, datum.poles)
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
    check_determined(site, covariance, is_surveyed=bool(site.poles or site.points))
    check_dependent(site, datum.dependent, end.T, covariance)
    return tested(site, datum, aligned, end, parts, few=few)


def tested(
    site: Site,
    datum: Datum,
    aligned: Aligned,
    end: End,
    parts: tuple[Part, ...],
    *,
    few: bool,
) -> Adjusted:
    """Test every observation at the answer.

    Parameters
    ----------
    site, datum
        For names.
    aligned
        What was seen of the poles, with all bands of elevation that the scenes have.
    end, parts
        Where all ended, and every source of error.
    few
        Whether nothing is tested after all.
    """
    groups = factor_of(aligned.network).unknowns.groups()
    at = solve_all(aligned.network, end, groups, parts)
    next_to_pole = find_outlying(aligned.maximum.point, aligned.network, aligned.sights)
    near_poles = {(i, k): chi2 for i, k, chi2 in next_to_pole}
    tests = () if few else tuple(all_tests(at, site, datum.poles, near_poles))
    converged = aligned.maximum.converged and end.converged
    covariance = joint_covariance(parts)
    return Adjusted(datum, aligned, end, parts, covariance, at, tests, converged)


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


def _most_noise(sights: Sequence[Sight], site: Site) -> Array:
    """(L, 2) most noise of each LiDAR's returns, by how they lie about separate axes, metres."""
    most = np.full((len(site.lidars), 2), np.inf)
    for sight in sights:
        _, own = maximise_from_lines(sight.beams, site.radius)
        most[sight.lidar] = np.maximum(MORE_NOISE * own, LEAST_BOUND)
    return most


def check_determined(site: Site, covariance: Array, *, is_surveyed: bool) -> None:
    """Refuse poses that poles, survey and scenes leave all but free.

    Raises
    ------
    Refusal
        ``survey_too_weak`` if all are free together, ``degenerate_poles`` if one is.
    """
    variance = np.diag(covariance).reshape(-1, POSE)
    turned = np.sqrt(variance[:, :3].max(axis=1))
    moved = np.sqrt(variance[:, 3:].max(axis=1))
    free = np.flatnonzero((turned > MAX_ROTATION_SIGMA) | (moved > MAX_TRANSLATION_SIGMA))
    if not len(free):
        return
    worst = int(free[np.argmax(moved[free])])
    freedom = f"{np.degrees(turned[worst]):.1f}° and {moved[worst]:.2f} m (1 σ)"
    values = {
        "rotation_sigma_rad": float(turned[worst]),
        "translation_sigma_m": float(moved[worst]),
    }
    if is_surveyed and len(free) == len(site.lidars):
        raise Refusal(
            "survey_too_weak",
            f"the survey leaves the site free by {freedom}: survey both ends of a second pole, or "
            "more control points",
            values,
        )
    name = site.lidars[worst].name
    raise Refusal(
        "degenerate_poles",
        f"the poles leave {name} free by {freedom}; add a pole or a placement that it sees with "
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


@dataclass(frozen=True)
class Link:
    """A pair of LiDARs without which some would be linked by fewer poles and patches.

    Attributes
    ----------
    lidars
        The pair.
    near
        LiDARs on the side of the first; all others are on the other side.
    poles
        Indices of the poles that both sides see: one LiDAR or many on each.
    """

    lidars: tuple[int, int]
    near: frozenset[int]
    poles: tuple[int, ...]

    @property
    def is_checked(self) -> bool:
        """Whether its poles check each other: two fit by themselves."""
        return len(self.poles) > 2


def find_links(adjusted: Adjusted) -> Iterator[Link]:
    """Find the pairs that link all LiDARs by most poles, and of those by most patches of the scene.

    They are a spanning tree, so that each parts the LiDARs into two sides.
    """
    count = len(adjusted.end.T)
    seen = [pole.seen.keys() for pole in adjusted.datum.poles]
    patches = {term.lidars: len(term.weighed.weights) for term in adjusted.end.scene}
    weights = {
        pair: (sum(set(pair) <= own for own in seen), patches.get(pair, 0))
        for pair in combinations(range(count), 2)
    }
    linked = [pair for pair in weights if weights[pair][0]]
    linked.sort(key=lambda pair: weights[pair], reverse=True)
    ranks = np.zeros((count, count))
    for rank, pair in enumerate(linked, start=1):
        ranks[pair] = rank
    tree = minimum_spanning_tree(ranks).toarray()
    for pair in linked:
        if not tree[pair]:
            continue
        rest = tree.copy()
        rest[pair] = 0.0
        _, label = connected_components(rest, directed=False)
        near = frozenset(np.flatnonzero(label == label[pair[0]]).tolist())
        across = [k for k, own in enumerate(seen) if own & near and own - near]
        yield Link(pair, near, tuple(across))


def adjusted_of_two(
    site: Site,
    paired: Sequence[PairedPlacement],
    numbers: Sequence[int],
    aligned: BeamAlignment,
    refined: Refinement | None,
) -> Adjusted:
    """Test the poles of two LiDARs at their answer.

    Parameters
    ----------
    site
        For names.
    paired
        The poles of all placements that were used, paired.
    numbers
        Index of each of them in `Site.placements`.
    aligned, refined
        The poles' pose, and with the scene; None if there is none.
    """
    joint = aligned.joint
    assert joint is not None
    observations = tuple(
        one if one.placement is None else replace(one, placement=numbers[one.placement])
        for one in joint.network.observations
    )
    joint = replace(joint, network=replace(joint.network, observations=observations))
    T = (aligned.pose if refined is None else refined.pose).T_target_source
    poles = _poles(paired, numbers, aligned, T)
    if refined is None:
        scans = paired[0].placement.scans
        left = remaining_sway_in([each.placement for each in paired])
        sizes = tuple(error_sizes(scan.cloud, scan.sensor) for scan in scans)
        factor = factor_of(joint.network, left=left)
        groups = factor.unknowns.groups()
        model = ErrorModel(sizes, joint.radius_sigma)
        problem = RefinementProblem(factor, (), groups, model.sigmas(groups))
        end = minimise(problem)
        parts = parts_of(problem, end)
    else:
        end, parts = refined.end, refined.parts
        bands = [np.unique(each.bands) for each in refined.surfaces]
        joint = replace(joint, network=joint.network.with_bands(bands))
    text = of_lidar(site.lidars[0].name)
    datum = Datum({0: np.eye(4), 1: T}, poles, NOTHING_SURVEYED, OF_SOURCE, text)
    return tested(site, datum, joint, end, parts, few=False)


def _poles(
    paired: Sequence[PairedPlacement], numbers: Sequence[int], aligned: BeamAlignment, T: Array
) -> list[SharedPole]:
    found: list[SharedPole] = []
    for each, placement in zip(paired, numbers, strict=True):
        both = zip(each.target_poles, each.source_poles, strict=True)
        for number, (target, source) in enumerate(both, 1):
            point, direction = aligned.axis_points[len(found)], aligned.axis_directions[len(found)]
            xyz = np.concatenate([target.xyz, se3.apply(T, source.xyz)])
            extent = extent_of(point, direction, xyz)
            seen = {0: target, 1: source}
            found.append(SharedPole(placement, number, seen, point, direction, extent))
    return found
