"""Every observation tested against all others: which one does not fit, and what would go unseen.

Data snooping (Baarda 1968): an observation gets a separate bias in addition to all unknowns. How
much the fit would improve is its test (score test, Rao 1948), a χ² with as many degrees of freedom
as the error has; how well the others determine that error is its redundancy, and gives the least
error that the test finds.

Several observations may also have one bias in common. Last come returns next to their pole, of a
LiDAR that sees it clearly at another position. A return far from the axis is treated as an outlier,
and pulls no more: the quadratic form of such returns shows no error. What a separate
axis would gain them is found in full.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np

from ..alignment.certainty import excess, normalised
from ..alignment.maximum import MIN_INLIER_SHARE, Sight
from ..alignment.network import Network, Observation
from ..alignment.posterior import JointState, Posterior, State, evaluate_lidar
from ..alignment.solver import ROUNDING
from ..alignment.unknowns import POSE
from ..base import se3
from ..base.datatypes import Array, IntArray, Kind, Test
from ..base.description import Site
from ..base.uncertainty.purpose import DEFAULT_AT
from .agreement import MAX_AXES_CHI2
from .axes import maximise_from_lines
from .shared import SharedPole
from .solved import Solved


@dataclass(frozen=True, eq=False)
class Bias:
    """A separate bias of some observations.

    Attributes
    ----------
    cross
        (Z, M) how its information goes with that of the unknowns.
    own
        (M, M) its information.
    slope
        (M,) of the log-likelihood by it.
    wide
        (M, R) what errors that are considered do to that slope.
    metres
        (M', ) which of its parameters are lengths: errors are reported for these.
    freedom
        How many of its parameters no unknown can take up.
    """

    cross: Array
    own: Array
    slope: Array
    wide: Array
    metres: IntArray
    freedom: int


def of_columns(
    at: Solved, parts: Sequence[tuple[Observation, IntArray]]
) -> tuple[Array, Array, Array, Array]:
    """Errors in place of some unknowns (positions in each observation's place)."""
    size = at.network.unknowns.size
    cross, own, slopes, wide = [], [], [], []
    for one, columns in parts:
        block = np.zeros((size, len(columns)))
        block[one.place] = one.information[:, columns]
        cross.append(block)
        own.append(one.information[np.ix_(columns, columns)])
        slopes.append(at.slope(one)[columns])
        wide.append(block.T @ at.wide)
    total = sum(len(each) for each in own)
    joint = np.zeros((total, total))
    first = 0
    for each in own:
        joint[first : first + len(each), first : first + len(each)] = each
        first += len(each)
    return np.concatenate(cross, axis=1), joint, np.concatenate(slopes), np.concatenate(wide)


def pole_moved(at: Solved, pole: int) -> Bias | None:
    """A pole that is at a different position for each LiDAR; None if fewer than two see it."""
    parts = [
        (one, _axis_columns(one, pole))
        for one in at.network.observations
        if one.poles is not None and pole in one.poles
    ]
    if len(parts) < 2:
        return None
    metres = np.concatenate([4 * k + np.arange(2) for k in range(len(parts))])
    return Bias(*of_columns(at, parts), metres, 4 * (len(parts) - 1))


def pole_displaced_for(at: Solved, some: Sequence[Observation], pole: int) -> Bias:
    """A pole that is at one position for some LiDARs, and at another for all others."""
    each = [of_columns(at, [(one, _axis_columns(one, pole))]) for one in some]
    cross, own, slope, wide = (np.sum(parts, axis=0) for parts in zip(*each, strict=True))
    return Bias(cross, own, slope, wide, np.arange(2), 4)


def splits(count: int) -> Iterator[tuple[int, ...]]:
    """Give all ways to split `count` LiDARs in two, each of two or more: the fewer of both."""
    for size in range(2, count // 2 + 1):
        for part in combinations(range(count), size):
            if 2 * size < count or 0 in part:
                yield part


def likeliest_part(at: Solved, moved: Bias, parts: Sequence[tuple[int, ...]]) -> tuple[int, ...]:
    """Find the LiDARs that most likely see a pole at another position than the others do.

    Of many LiDARs there are thousands of parts: the information of each about the other is computed
    once.

    Parameters
    ----------
    at, moved
        The answer, and the bias of a pole that is at a different position for each of V LiDARs.
    parts
        Of which one is taken: each some of the V.
    """
    of_part = np.zeros((len(parts), len(moved.slope) // 4))
    for row, part in zip(of_part, parts, strict=True):
        row[list(part)] = 1.0
    joint = np.kron(of_part, np.eye(4)).reshape(len(parts), 4, -1)

    def of_parts(square: Array) -> Array:
        return np.asarray(joint @ square @ joint.transpose(0, 2, 1))

    taken_up = at.inverse @ moved.cross
    scene, wide = moved.cross.T @ at.scene, moved.wide - taken_up.T @ at.by_wide
    left = moved.own - moved.cross.T @ taken_up
    by_scene = taken_up.T @ at.scene_information @ taken_up
    scatter = excess(of_parts(scene @ scene.T), of_parts(by_scene))
    size, way = np.linalg.eigh(of_parts(left + wide @ wide.T) + scatter)
    least = ROUNDING * np.einsum("pii->pi", of_parts(moved.own)).max(axis=1)
    slope = joint @ (moved.slope - taken_up.T @ at.remainder)
    along = np.einsum("pij,pi->pj", way, slope)
    chi2 = np.sum(along**2 / np.where(size > least[:, None], size, np.inf), axis=1)
    return parts[int(np.argmax(chi2))]


def placement_moved(at: Solved, one: Observation) -> Bias:
    """A LiDAR that was at another position in one placement."""
    return Bias(*of_columns(at, [(one, np.arange(POSE))]), np.arange(3, 6), POSE)


def lidar_displaced(at: Solved, lidar: int) -> Bias | None:
    """A LiDAR for which all poles are displaced, but for its pose."""
    parts = [
        (one, np.concatenate([_axis_columns(one, int(pole)) for pole in one.poles]))
        for one in at.network.observations
        if one.poles is not None and one.lidar == lidar
    ]
    count = sum(len(columns) for _, columns in parts)
    if count <= POSE:
        return None
    metres = np.flatnonzero(np.arange(count) % 4 < 2)
    return Bias(*of_columns(at, parts), metres, count - POSE)


def value_wrong(at: Solved, one: Observation) -> Bias:
    """A single measurement with a separate bias, metres or rad."""
    assert one.by_value is not None
    J, residual, _ = one.by_value
    size = at.network.unknowns.size
    cross = np.zeros((size, len(residual)))
    cross[one.place] = -J.T
    away = (at.values - at.network.start)[one.place]
    count = len(residual)
    own = np.eye(count)
    return Bias(cross, own, residual + J @ away, cross.T @ at.wide, np.arange(count), count)


def _axis_columns(one: Observation, pole: int) -> IntArray:
    """Where a pole's four parameters are in an observation."""
    assert one.poles is not None
    first = len(one.place) - 4 * len(one.poles)
    return np.asarray(first + 4 * int(np.flatnonzero(one.poles == pole)[0]) + np.arange(4))


def find_outlying(
    end: Posterior[JointState], network: Network, sights: Sequence[Sight]
) -> Iterator[tuple[int, int, float]]:
    """Find the poles next to which most of a LiDAR's returns on them lie.

    Parameters
    ----------
    end
        The maximum of the posterior of poles and survey.
    network
        The observations about it.
    sights
        What each LiDAR saw.

    Yields
    ------
    lidar, pole, chi2
        Indices, and twice the logarithm of the likelihood that a separate axis would gain: χ²
        with four degrees of freedom where the pole is at one place.
    """
    by_lidar = {sight.lidar: sight for sight in sights}
    for one in network.observations:
        if one.poles is None or one.share is None:
            continue
        assert one.lidar is not None
        for pole in one.poles[one.share < MIN_INLIER_SHARE]:
            yield one.lidar, int(pole), _gain(end, by_lidar[one.lidar], int(pole))


def _gain(end: Posterior[JointState], sight: Sight, pole: int) -> float:
    """Twice the log likelihood that a separate axis would gain for a LiDAR's returns."""
    beams = sight.beams.of_poles(np.flatnonzero(sight.own == pole))
    state, log_noise = end.state, end.log_noise[sight.lidar]
    to_lidar = se3.inverse(state.T[sight.lidar])
    common = State(
        np.eye(4),
        np.array([state.offsets[sight.lidar], 0.0]),
        state.radius,
        se3.apply(to_lidar, state.points[[pole]]),
        state.directions[[pole]] @ to_lidar[:3, :3].T,
    )
    own, _ = maximise_from_lines(beams, state.radius, log_noise)

    def log_at(points: Array, directions: Array) -> float:
        at = State(common.T, common.offsets, common.radius, points, directions)
        return float(evaluate_lidar(at, 0, beams, np.exp(log_noise))[0].log)

    found = log_at(own.points, own.directions) - log_at(common.points, common.directions)
    return max(2.0 * found, 0.0)


NONCENTRALITY = 17.07
"""Of a test at 0.1 % with a power of 80 %: (3.29 + 0.84)² (Baarda 1968)."""

POOR = 5.0
"""Normalised residual (w) above which an observation fits poorly, if its χ² is above
`MAX_AXES_CHI2` for each degree of freedom, the limit of a pair's poles: if there are many, small
errors that are not modelled add up. `blunders.BLUNDER` cites what set it."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """How the bias of an observation was tested; see `answer.Test`."""

    chi2: float
    redundancy: float
    minimal_detectable: float | None
    external: float | None


def outcomes(at: Solved, errors: Sequence[tuple[Bias, float]]) -> Iterator[Outcome]:
    """Test biases, each by itself, against all other observations.

    Parameters
    ----------
    at
        The answer.
    errors
        Each that is tested, with metres for each of its lengths, if its unit is σ.
    """
    if not errors:
        return
    cuts = np.cumsum([error.cross.shape[1] for error, _ in errors])[:-1]
    # All at once: what is multiplied here are the largest matrices of a site.
    cross = np.concatenate([error.cross for error, _ in errors], axis=1)
    taken_up = at.inverse @ cross
    by_scene, carried = cross.T @ at.scene, at.scene_information @ taken_up
    by_wide = taken_up.T @ at.by_wide
    for (error, unit), taken, scene, carry, wide in zip(
        errors,
        np.split(taken_up, cuts, axis=1),
        np.split(by_scene, cuts),
        np.split(carried, cuts, axis=1),
        np.split(by_wide, cuts),
        strict=True,
    ):
        # Considered parameters move the slope by this amount.
        by = error.wide - wide
        # And the scene's patches, correlated as they are, by more than their information says.
        scatter = excess(scene @ scene.T, taken.T @ carry)
        yield _outcome(at, error, unit, taken, by @ by.T + scatter)


def _outcome(at: Solved, error: Bias, unit: float, taken_up: Array, more: Array) -> Outcome:
    """Test a bias that the unknowns take up (Z, M), of a slope beyond the spread of the bias."""
    left = error.own - error.cross.T @ taken_up
    spread = left + more
    # Of what no observation checks only rounding is left: none of it is a test.
    least_checked = ROUNDING * max(float(np.diag(error.own).max()), 1e-300)
    size, way = np.linalg.eigh(spread)
    is_reported = size > least_checked
    # All else follows: what the iterations left of its slope counts where little is tested.
    along = way.T @ (error.slope - taken_up.T @ at.remainder)
    chi2 = float(np.sum(along[is_reported] ** 2 / size[is_reported]))
    # An error ∇ moves the slope by S ∇.
    seen = (way[:, is_reported].T @ left) / np.sqrt(size[is_reported])[:, None]
    size, way = np.linalg.eigh(error.own)
    whole = size > ROUNDING * size[-1]
    inverse = (way[:, whole] / size[whole]) @ way[:, whole].T
    redundancy = float(
        np.clip(np.trace(inverse @ left) / max(np.count_nonzero(whole), 1), 0.0, 1.0)
    )
    of_lengths = seen[:, error.metres]
    size, way = np.linalg.eigh(of_lengths.T @ of_lengths)
    # Moved together, all LiDARs' poles are the pole itself: only differences count.
    found = np.flatnonzero(size > least_checked)
    if not len(found):
        return Outcome(chi2, redundancy, None, None)
    least, direction = float(size[found[0]]), way[:, found[0]]
    detectable = float(np.sqrt(NONCENTRALITY / least))
    moved = -taken_up[:, error.metres] @ (detectable * direction)
    return Outcome(chi2, redundancy, unit * detectable, _at_range(moved, at))


def _at_range(step: Array, at: Solved) -> float:
    """Farthest that a step of the unknowns moves a point at `DEFAULT_AT` of a LiDAR, metres."""
    poses = step[: at.network.unknowns.poses].reshape(-1, POSE)
    turned = DEFAULT_AT * np.linalg.norm(poses[:, :3], axis=1)
    return float((turned + np.linalg.norm(poses[:, 3:], axis=1)).max())


def all_tests(
    at: Solved, site: Site, poles: Sequence[SharedPole], astray: Mapping[tuple[int, int], float]
) -> Iterator[Test]:
    """Test every observation: poles, each LiDAR's view of a pole, placements, LiDARs, the survey.

    Parameters
    ----------
    at
        The answer.
    site, poles
        For names, and who sees which pole.
    astray
        By LiDAR and pole the χ² of returns that lie next to it (`snooping.find_outlying`).
    """
    tests = list(_tested(at, site, poles, astray))
    found = outcomes(at, [(each.error, each.unit) for each in tests])
    for each, one in zip(tests, found, strict=True):
        chi2, freedom = max(one.chi2, each.beside or 0.0), each.error.freedom
        yield Test(
            each.kind,
            each.name,
            each.lidar,
            each.placement,
            each.pole,
            chi2,
            freedom,
            normalised(chi2, freedom, each.among),
            one.redundancy,
            one.minimal_detectable,
            one.external,
            max(POOR, normalised(MAX_AXES_CHI2 * freedom, freedom, each.among)),
        )


class _Tested(NamedTuple):
    """A test: the bias that an observation may have, the likeliest `among` this many.

    `unit` is metres for each of its lengths; `beside` the χ² of returns that lie next to a pole.
    """

    kind: Kind
    lidar: int | None
    placement: int | None
    pole: int | None
    name: str
    error: Bias
    unit: float = 1.0
    beside: float | None = None
    among: int = 1


def _tested(
    at: Solved, site: Site, poles: Sequence[SharedPole], astray: Mapping[tuple[int, int], float]
) -> Iterator[_Tested]:
    names = [lidar.name for lidar in site.lidars]
    for k, pole in enumerate(poles):
        yield from _of_pole(at, pole.name(site), k, pole.placement, names, astray)
    for one in at.network.observations:
        # The prior of a dependent LiDAR was not observed: it is only as wide as the poles need it.
        # Nor was it on which side of poles they were surveyed.
        if one.kind == "pose" or one.kind == "side":
            continue
        if one.poles is None:
            assert one.by_value is not None
            assert one.kind != "returns"
            wrong, unit = value_wrong(at, one), one.by_value[2]
            yield _Tested(one.kind, one.lidar, None, None, one.name, wrong, unit)
            continue
        assert one.lidar is not None
        assert one.placement is not None
        name = f"{names[one.lidar]} in placement {site.placements[one.placement]}"
        moved = placement_moved(at, one)
        yield _Tested("placement", one.lidar, one.placement, None, name, moved)
    for lidar, name in enumerate(names):
        displaced = lidar_displaced(at, lidar)
        if displaced is not None:
            yield _Tested("lidar", lidar, None, None, name, displaced)


def _of_pole(
    at: Solved,
    name: str,
    pole: int,
    placement: int,
    names: Sequence[str],
    astray: Mapping[tuple[int, int], float],
) -> Iterator[_Tested]:
    """Test a pole: as a whole, as each LiDAR sees it, and split in the likeliest way."""
    moved = pole_moved(at, pole)
    views = [one for one in at.network.observations if one.poles is not None and pole in one.poles]
    if moved is not None:
        yield _Tested("pole", None, placement, pole, name, moved)
    for one in views:
        assert one.lidar is not None
        shift = astray.get((one.lidar, pole))
        # That one LiDAR alone sees, its survey checks.
        if len(views) != 2 or shift is not None:
            of_one = f"{name} as {names[one.lidar]} sees it"
            displaced = pole_displaced_for(at, [one], pole)
            yield _Tested("pole", one.lidar, placement, pole, of_one, displaced, beside=shift)
    parts = list(splits(len(views)))
    if moved is not None and parts:
        some = [views[i] for i in likeliest_part(at, moved, parts)]
        seen_by = ", ".join(names[one.lidar] for one in some if one.lidar is not None)
        separated, observation = pole_displaced_for(at, some, pole), f"{name} as {seen_by} see it"
        yield _Tested("pole", None, placement, pole, observation, separated, among=len(parts))
