"""How sure all poses of a site are together, and what each is unsure of.

As `alignment.certainty` for one pair, with the joint covariance (6 L, 6 L) in the place of (6, 6):
what the scatter of returns and surfaces leaves open, what the errors of every LiDAR let pass, and
what no model names, which each LiDAR has for itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..alignment.certainty import BUDGET_RANGE, FLOOR, few_freedom
from ..base import se3
from ..base.datatypes import Array, IntArray
from ..base.systematic import Groups
from ..base.uncertainty import BudgetEntry, floor, predicted_error
from ..scene.patch_pairs import CLUSTER_SIDE, labels_of
from ..scene.refinement import PLACE_BIAS
from .network import Network, about, marginal
from .refinement import SceneTerm, SiteEnd
from .state import POSE

SCATTER, FLAT = "scatter of the surfaces", "surfaces that are not flat"
"""What the budget calls the two parts of the scene."""


@dataclass(frozen=True, eq=False)
class Part:
    """One source of error: its name, whose it is, its 1 σ and unit, its part of the covariance.

    `root` (6 L, R): the part is ``root rootᵀ``.
    """

    name: str
    lidar: int | None
    sigma: float | None
    unit: str
    estimated: float | None
    root: Array


def parts_of(network: Network, end: SiteEnd, groups: Groups) -> list[Part]:
    """Say what each source of error does to all poses.

    Parameters
    ----------
    network
        Poles and survey.
    end
        The adjusted poses.
    groups
        The errors, as `Unknowns.groups` has them.
    """
    poses = network.unknowns.poses
    inverse = end.inverse
    passed = inverse[:poses, poses:] * end.precision * end.sigma[groups.label]
    found = []
    for g, (kind, lidar) in enumerate(zip(groups.kinds, groups.sensors, strict=True)):
        member = np.flatnonzero(groups.label == g)
        alone = float(end.errors[member[0]]) if len(member) == 1 else None
        found.append(
            Part(kind.name, lidar, float(end.sigma[g]), kind.unit, alone, passed[:, member])
        )
    information, _ = marginal(about(network, end.T))
    wide = np.sqrt(few_freedom(network.redundancy))
    returns = inverse[:poses] @ _root(information)
    found.append(_scatter("scatter of the poles' returns and of the survey", wide * returns))
    if end.scene:
        surfaces, flat = _of_surfaces(end, poses)
        found.append(_scatter(SCATTER, surfaces))
        found.append(_scatter(FLAT, flat))
    found += [_scatter(FLOOR, each) for each in _own_floors(network, end)]
    return found


def scene_root(parts: Sequence[Part]) -> Array:
    """(6 L, R) what surfaces do to all poses: a root of that part of the covariance."""
    return np.hstack(
        [np.zeros((len(parts[0].root), 0)), *(p.root for p in parts if p.name in (SCATTER, FLAT))]
    )


def joint_covariance(parts: Sequence[Part]) -> Array:
    """(6 L, 6 L) of all poses, all errors together."""
    return np.asarray(sum(part.root @ part.root.T for part in parts))


def budget_of(parts: Sequence[Part], lidar: int, names: Sequence[str]) -> tuple[BudgetEntry, ...]:
    """Say what the error of one pose is made of; equal names are put together.

    Parameters
    ----------
    parts
        From `parts_of`.
    lidar
        Whose pose.
    names
        Of all LiDARs.
    """
    own = slice(POSE * lidar, POSE * (lidar + 1))
    rows: dict[tuple[str, int | None], list[Part]] = {}
    for part in parts:
        rows.setdefault((part.name, part.lidar), []).append(part)
    squares = {
        key: sum(_at(part.root[own]) ** 2 for part in members) for key, members in rows.items()
    }
    whole = sum(squares.values())
    if not whole:
        return ()
    found = []
    for (name, whose), members in rows.items():
        first = members[0]
        told = name if whose is None else f"{name} of {names[whose]}"
        size = first.sigma if first.sigma is not None else float(np.sqrt(squares[name, whose]))
        estimated = first.estimated if len(members) == 1 else None
        share = squares[name, whose] / whole
        found.append(BudgetEntry(told, None, size, first.unit, estimated, share))  # type: ignore[arg-type]
    return tuple(sorted(found, key=lambda entry: -entry.share_at_30m))


def _scatter(name: str, root: Array) -> Part:
    return Part(name, None, None, "m", None, root)


def _at(root: Array) -> float:
    """1 σ at `BUDGET_RANGE` of a part of one pose's covariance, metres."""
    return predicted_error(root @ root.T, (BUDGET_RANGE,))[0][1]


def _root(information: Array) -> Array:
    """(K, K) whose square is an information, which may leave directions free."""
    size, way = np.linalg.eigh(information)
    return np.asarray(way * np.sqrt(np.maximum(size, 0.0)))


def _of_surfaces(end: SiteEnd, poses: int) -> tuple[Array, Array]:
    """What the scatter of the surfaces does to all poses, and that they are not flat."""
    inverse = end.inverse
    free = np.flatnonzero(np.diag(inverse)[:poses] > 0)
    gains = [inverse[np.ix_(free, term.place)] for term in end.scene]
    moved = moved_by_places(end, end.scene, gains, inverse[np.ix_(free, free)], places_of(end))
    scatter, flat = (np.zeros((poses, each.shape[1])) for each in moved)
    scatter[free], flat[free] = moved
    return scatter, flat


def moved_by_places(
    end: SiteEnd,
    terms: Sequence[SceneTerm],
    gains: Sequence[Array],
    covariance: Array,
    places: Sequence[IntArray],
) -> tuple[Array, Array]:
    """What the scatter of the surfaces does to some parameters, and that they are not flat.

    The jackknife over places (`scene.refinement`): residuals of all pairs at one place may be
    correlated in any way, since they are of the same wall, and of the same LiDAR's returns.

    Parameters
    ----------
    end
        The answer.
    terms
        The scenes that the parameters were estimated with.
    gains
        (F, 12 + B) of each term: from slopes of the unknowns at its place to the parameters.
    covariance
        (F, F) of the parameters, as all information there is has it.
    places
        (P,) of each term, as `places_of` has them.

    Returns
    -------
    scatter, flat
        (F, R) with a column for each place; covariances are their squares.
    """
    size = len(covariance)
    information = np.linalg.inv(covariance)
    count = 1 + max(int(own.max()) for own in places)
    gradients = np.zeros((count, size))
    without = np.zeros((count, size**2))
    flat = np.zeros((count, size))
    for term, gain, own in zip(terms, gains, places, strict=True):
        by_step = term.rows @ gain.T @ information
        residuals = residuals_of(term, end)
        weighted = by_step * term.weights[:, None]
        order = np.argsort(own, kind="stable")
        starts = np.flatnonzero(np.r_[True, np.diff(own[order]) > 0])
        at = own[order][starts]
        gradients[at] += np.add.reduceat((weighted * residuals[:, None])[order], starts)
        flat[at] += np.add.reduceat(weighted[order], starts)
        ends = np.r_[starts[1:], len(own)]
        for p, a, b in zip(at, starts, ends, strict=True):
            rows = order[a:b]
            without[p] += (weighted[rows].T @ by_step[rows]).reshape(-1)
    left = information - without.reshape(-1, size, size)
    moves = np.linalg.solve(left, gradients[:, :, None])[:, :, 0]
    share = np.sum(moves * (moves @ information), axis=1)
    freedom = float(share.sum() ** 2 / max(float(np.sum(share**2)), 1e-300))
    # A LiDAR has six parameters of its own, whatever the number of all.
    return moves.T * np.sqrt(few_freedom(freedom)), covariance @ flat.T * PLACE_BIAS


def residuals_of(term: SceneTerm, end: SiteEnd) -> Array:
    """(P,) of a pair's patches, freed of the errors as they were estimated."""
    poses = len(end.search)
    errors = term.place >= poses
    return np.asarray(
        term.residuals + term.rows[:, errors] @ end.errors[term.place[errors] - poses]
    )


def places_of(end: SiteEnd) -> list[IntArray]:
    """Number the places (in the frame of the site) of all pairs' patches: (P,) of each pair."""
    at = [se3.apply(end.T[term.lidars[0]], term.pairs.at) for term in end.scene]
    labels = labels_of(np.floor(np.concatenate(at) / CLUSTER_SIDE))
    return np.split(labels, np.cumsum([len(each) for each in at])[:-1])


def _own_floors(network: Network, end: SiteEnd) -> list[Array]:
    """What no model names, half of its variance for each LiDAR of a pair: (6 L, 6) each.

    It turns and shifts a LiDAR's own frame. That of a LiDAR whose frame is the site's moves all
    others against it.
    """
    unknowns = network.unknowns
    half = np.linalg.cholesky(floor() / 2)
    datum = [i for i in range(unknowns.lidars) if not network.free[unknowns.pose(i)].any()]
    found = []
    for lidar in range(unknowns.lidars):
        root = np.zeros((unknowns.poses, POSE))
        if lidar in datum:
            for other in range(unknowns.lidars):
                if other != lidar:
                    arm = end.T[other][:3, 3] - end.T[lidar][:3, 3]
                    move = np.eye(POSE)
                    move[3:, :3] = -se3.hat(arm)
                    root[unknowns.pose(other)] = -move @ half
        else:
            root[unknowns.pose(lidar)] = half
        found.append(root)
    return found
