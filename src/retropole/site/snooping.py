"""Every observation tested against all others: which one does not fit, and what would go unseen.

Data snooping (Baarda 1968): an observation gets an error of its own beside all unknowns. How much
the fit would improve is its test (score test, Rao 1948), a χ² with as many degrees of freedom as
the error has; how well the others determine that error is its redundancy, and tells the least
error that the test finds.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc, erfcinv

from .. import se3
from ..alignment.certainty import considered
from ..datatypes import Array, IntArray
from ..systematic import Groups
from .answer import Test
from .description import Site
from .network import Network, Observation
from .refinement import SiteEnd
from .shared import SharedPole
from .state import POSE

NONCENTRALITY = 17.07
"""Of a test at 0.1 % with a power of 80 %: (3.29 + 0.84)² (Baarda 1968)."""

EXTERNAL_RANGE = 30.0
"""How far away a point is that an unseen error moves, metres."""

LEAST_CHECKED = 1e-9
"""Part of an error's own information below which the others do not determine it at all."""


@dataclass(frozen=True, eq=False)
class Solved:
    """All unknowns of a site at the answer.

    Attributes
    ----------
    network
        The observations.
    values
        (Z,) the unknowns.
    inverse
        (Z, Z) of all information; zero where the datum holds a pose.
    wide
        (Z, R) errors that are considered and not estimated, each of 1 σ.
    sigma
        (B,) 1 σ of each error.
    """

    network: Network
    values: Array
    inverse: Array
    wide: Array
    sigma: Array

    def slope(self, one: Observation) -> Array:
        """(P,) slope of an observation's log-likelihood at the answer."""
        away = (self.values - self.network.start)[one.place]
        return np.asarray(one.gradient - one.information @ away)


def solved(network: Network, end: SiteEnd, groups: Groups) -> Solved:
    """Solve for all unknowns, axes and control points too, at the answer.

    Parameters
    ----------
    network, end
        What was adjusted, and where it ended.
    groups
        The errors.
    """
    unknowns, poses = network.unknowns, network.unknowns.poses
    information, gradient = network.total()
    steps = [se3.local(a, b) for a, b in zip(network.state.T, end.T, strict=True)]
    kept = np.r_[np.concatenate(steps), end.errors]
    gone = slice(unknowns.kept, None)
    start = network.start
    pull = gradient[gone] - information[gone, : unknowns.kept] @ (kept - start[: unknowns.kept])
    values = np.r_[kept, start[gone] + np.linalg.solve(information[gone, gone], pull)]
    index = np.arange(poses, unknowns.kept)
    information[index, index] += end.precision
    for term in end.scene:
        information[np.ix_(term.place, term.place)] += term.information
    free = np.flatnonzero(np.r_[network.free, np.ones(unknowns.size - poses, dtype=bool)])
    inverse = np.zeros_like(information)
    inverse[np.ix_(free, free)] = np.linalg.inv(information[np.ix_(free, free)])
    sigma = considered(groups, end.sigma)
    which = np.flatnonzero(sigma)
    wide = np.zeros((unknowns.size, len(which)))
    wide[poses + which, np.arange(len(which))] = sigma[which]
    return Solved(network, values, inverse, wide, end.sigma[groups.label])


@dataclass(frozen=True, eq=False)
class OwnError:
    """An error of its own that some observations get.

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
        (M', ) which of its parameters are lengths: what is told of it is told for these.
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


def pole_moved(at: Solved, pole: int) -> OwnError | None:
    """A pole that stands elsewhere for each LiDAR; None where fewer than two see it."""
    parts = [
        (one, _axis_columns(one, pole))
        for one in at.network.observations
        if one.poles is not None and pole in one.poles
    ]
    if len(parts) < 2:
        return None
    metres = np.concatenate([4 * k + np.arange(2) for k in range(len(parts))])
    return OwnError(*of_columns(at, parts), metres, 4 * (len(parts) - 1))


def pole_seen_elsewhere(at: Solved, one: Observation, pole: int) -> OwnError:
    """A pole that stands elsewhere for one LiDAR than for all others."""
    parts = [(one, _axis_columns(one, pole))]
    return OwnError(*of_columns(at, parts), np.arange(2), 4)


def placement_moved(at: Solved, one: Observation) -> OwnError:
    """A LiDAR that stood elsewhere in one placement."""
    return OwnError(*of_columns(at, [(one, np.arange(POSE))]), np.arange(3, 6), POSE)


def lidar_apart(at: Solved, lidar: int) -> OwnError | None:
    """A LiDAR for which all poles stand elsewhere, but for its pose."""
    parts = [
        (one, np.concatenate([_axis_columns(one, int(pole)) for pole in one.poles]))
        for one in at.network.observations
        if one.poles is not None and one.lidar == lidar
    ]
    count = sum(len(columns) for _, columns in parts)
    if count <= POSE:
        return None
    metres = np.flatnonzero(np.arange(count) % 4 < 2)
    return OwnError(*of_columns(at, parts), metres, count - POSE)


def value_wrong(at: Solved, one: Observation) -> OwnError:
    """A single measurement with an error of its own, metres or rad."""
    assert one.by_value is not None
    J, residual, _ = one.by_value
    size = at.network.unknowns.size
    cross = np.zeros((size, len(residual)))
    cross[one.place] = -J.T
    away = (at.values - at.network.start)[one.place]
    count = len(residual)
    own = np.eye(count)
    return OwnError(cross, own, residual + J @ away, cross.T @ at.wide, np.arange(count), count)


def _axis_columns(one: Observation, pole: int) -> IntArray:
    """Where a pole's four parameters stand in an observation."""
    assert one.poles is not None
    first = len(one.place) - 4 * len(one.poles)
    return np.asarray(first + 4 * int(np.flatnonzero(one.poles == pole)[0]) + np.arange(4))


@dataclass(frozen=True, eq=False)
class Outcome:
    """How an error of its own was tested; see `answer.Test`."""

    chi2: float
    w: float
    redundancy: float
    minimal_detectable: float | None
    external: float | None


def outcome(at: Solved, error: OwnError, unit: float) -> Outcome:
    """Test an error of its own against all other observations.

    Parameters
    ----------
    at
        The answer.
    error
        That is tested.
    unit
        Metres for each of its lengths, where it is counted in σ.
    """
    taken_up = at.inverse @ error.cross
    left = error.own - error.cross.T @ taken_up
    # What is considered moves the slope by so much.
    by = error.wide - taken_up.T @ _information_of(at)
    # Of what nothing checks only rounding is left: none of it is a test.
    least_checked = LEAST_CHECKED * max(float(np.diag(error.own).max()), 1e-300)
    size, way = np.linalg.eigh(left + by @ by.T)
    along = way.T @ error.slope
    chi2 = float(np.sum(along[size > least_checked] ** 2 / size[size > least_checked]))
    p = float(chdtrc(error.freedom, chi2))
    w = float(np.sqrt(2.0) * erfcinv(p)) if p > 0 else float(np.sqrt(chi2))
    size, way = np.linalg.eigh(error.own)
    whole = size > LEAST_CHECKED * size[-1]
    inverse = (way[:, whole] / size[whole]) @ way[:, whole].T
    redundancy = float(
        np.clip(np.trace(inverse @ left) / max(np.count_nonzero(whole), 1), 0.0, 1.0)
    )
    of_lengths = left[np.ix_(error.metres, error.metres)]
    size, way = np.linalg.eigh(of_lengths)
    # Moved together, all LiDARs' poles are the pole itself: only differences count.
    found = np.flatnonzero(size > least_checked)
    if not len(found):
        return Outcome(chi2, w, redundancy, None, None)
    least, direction = float(size[found[0]]), way[:, found[0]]
    detectable = float(np.sqrt(NONCENTRALITY / least))
    moved = -taken_up[:, error.metres] @ (detectable * direction)
    return Outcome(chi2, w, redundancy, unit * detectable, _at_range(moved, at))


def _information_of(at: Solved) -> Array:
    """(Z, R) information of all unknowns times the errors that are considered."""
    total, _ = at.network.total()
    return np.asarray(total @ at.wide)


def _at_range(step: Array, at: Solved) -> float:
    """Farthest that a step of the unknowns moves a point at `EXTERNAL_RANGE` of a LiDAR, metres."""
    poses = step[: at.network.unknowns.poses].reshape(-1, POSE)
    turned = EXTERNAL_RANGE * np.linalg.norm(poses[:, :3], axis=1)
    return float((turned + np.linalg.norm(poses[:, 3:], axis=1)).max())


def all_tests(at: Solved, site: Site, poles: Sequence[SharedPole]) -> Iterator[Test]:
    """Test every observation: poles, each LiDAR's view of them, placements, LiDARs, the survey."""
    names = [lidar.name for lidar in site.lidars]
    for k, pole in enumerate(poles):
        moved = pole_moved(at, k)
        if moved is not None:
            found = outcome(at, moved, 1.0)
            yield _test("pole", pole.name(site), None, pole.placement, k, moved, found)
    for one in at.network.observations:
        if one.poles is None:
            error = value_wrong(at, one)
            assert one.by_value is not None
            unit = one.by_value[2]
            assert one.kind != "returns"
            yield _test(one.kind, one.name, one.lidar, None, None, error, outcome(at, error, unit))
            continue
        assert one.lidar is not None
        for k in one.poles:
            if len(poles[k].seen) > 2:
                seen = pole_seen_elsewhere(at, one, int(k))
                name = f"{poles[k].name(site)} as {names[one.lidar]} sees it"
                found = outcome(at, seen, 1.0)
                yield _test("pole", name, one.lidar, one.placement, int(k), seen, found)
        stood = placement_moved(at, one)
        yield _test(
            "placement", one.name, one.lidar, one.placement, None, stood, outcome(at, stood, 1.0)
        )
    for lidar in range(len(names)):
        apart = lidar_apart(at, lidar)
        if apart is not None:
            yield _test("lidar", names[lidar], lidar, None, None, apart, outcome(at, apart, 1.0))


def _test(
    kind: str,
    name: str,
    lidar: int | None,
    placement: int | None,
    pole: int | None,
    error: OwnError,
    found: Outcome,
) -> Test:
    return Test(
        kind,  # type: ignore[arg-type]
        name,
        lidar,
        placement,
        pole,
        found.chi2,
        error.freedom,
        found.w,
        found.redundancy,
        found.minimal_detectable,
        found.external,
    )
