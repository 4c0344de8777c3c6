"""A design in a small form: what predicts the error of any set of poles, without their parts.

In units of what is known without any pole, P = F Fᵀ, a pole of root L is a look at some directions,
Z = Fᵀ L, each with noise of 1. The covariance of the poses under a set, F_p (I + Σ Z Zᵀ)⁻¹ F_pᵀ,
needs few of all directions: those of the poses, and those that (I + Σ Z Zᵀ)⁻¹ F_pᵀ has under most
sets (a reduced basis, by proper orthogonal decomposition). What else a pole looks at counts as its
noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from ..adjustment.descent import inverse_of
from ..alignment.unknowns import POSE
from ..base.datatypes import Array
from .choice import Design, unsure

SHARED = (24, 36, 48)
"""So many directions are kept beside those of the poses: the first number that is enough."""

CLOSE = 0.03
"""It is where no error of the sets that are tried is off by more than this part."""

BASIS, TRIED = 120, 24
"""Sets of 1 to 4 poles that the directions are taken from, and that are tried afterwards."""

LEAST = 0.2
"""A look of less than this, in units of its noise, is none: it takes 4 % off a variance at most."""


@dataclass(frozen=True, eq=False)
class Compressed:
    """What predicts the error under any set of poles, in m directions.

    Attributes
    ----------
    rows
        (L - 1, 6, m) what each of these adds to the error of each LiDAR but the first, metres.
    rest
        (L - 1,) squared error that no pole takes away, m².
    roots
        Of each pole (m, r): the directions it looks at, over their noise.
    """

    rows: Array
    rest: Array
    roots: Sequence[Array]

    def squares(self, chosen: Sequence[int]) -> Array:
        """(L - 1,) squared error of each LiDAR but the first under some poles, as `Design` does."""
        total = np.eye(self.rows.shape[2])
        for k in chosen:
            total += self.roots[k] @ self.roots[k].T
        covariance = np.linalg.inv(total)
        return np.asarray(self.rest + np.einsum("lij,jk,lik->l", self.rows, covariance, self.rows))


def compress(design: Design) -> tuple[Compressed, Compressed]:
    """Compress a design, with the surfaces and the poles alone."""
    sets = _sets(len(design.roots), BASIS + TRIED)
    found = []
    # Many small matrices: threads that wait for each other take a hundred times as long.
    with threadpool_limits(1, user_api="blas"):
        for alone, information in zip((False, True), design.informations, strict=True):
            inverses = (design.inverse(each, alone=alone) for each in sets[BASIS:])
            squares = np.array([design.squares(each) for each in inverses])
            found.append(_enough(design, information, sets, squares))
    return found[0], found[1]


def _sets(count: int, number: int) -> list[list[int]]:
    """Name sets of 1 to 4 poles: steps of hardly a common measure reach all over the list."""
    return [sorted({(37 * n + 101 * j) % count for j in range(1 + n % 4)}) for n in range(number)]


def _enough(
    design: Design, information: Array, sets: Sequence[Sequence[int]], squares: Array
) -> Compressed:
    """Keep as many directions as it takes to predict the squares (`TRIED`, L - 1)."""
    unknowns = design.unknowns
    poses, free = np.arange(unknowns.poses), np.arange(POSE, unknowns.kept)
    total = information.copy()
    total[poses, poses] += unsure(unknowns)
    root = _root_of(inverse_of(total[np.ix_(free, free)]))
    looks = []
    for place, own in design.roots:
        # The first LiDAR's pose is the datum.
        is_free = place >= POSE
        looks.append(root[place[is_free] - POSE].T @ own[is_free])
    own_rows = root[: unknowns.poses - POSE]
    rows = own_rows.reshape(-1, POSE, len(root)) * np.sqrt(design.weight)[:, None]
    first = np.linalg.qr(own_rows.T)[0]
    shared = _shared(rows.reshape(-1, len(root)), looks, sets[:BASIS], first)
    for count in SHARED:
        found = _kept(rows, looks, np.c_[first, shared[:, :count]])
        off = np.sqrt([found.squares(each) for each in sets[BASIS:]]) / np.sqrt(squares) - 1.0
        if np.abs(off).max() < CLOSE or count >= shared.shape[1]:
            break
    return found


def _kept(rows: Array, looks: Sequence[Array], basis: Array) -> Compressed:
    """Keep the directions of a basis (K, m)."""
    kept = rows @ basis
    rest = np.sum(rows**2, axis=(1, 2)) - np.sum(kept**2, axis=(1, 2))
    return Compressed(kept, np.maximum(rest, 0.0), [_seen_in(basis, look) for look in looks])


def _root_of(covariance: Array) -> Array:
    """Root (K, K) of a covariance whose unknowns differ much in size."""
    scale = np.sqrt(np.diag(covariance))
    size, way = np.linalg.eigh(covariance / np.outer(scale, scale))
    return np.asarray(scale[:, None] * way * np.sqrt(np.maximum(size, 0.0)))


def _shared(
    rows: Array, looks: Sequence[Array], sets: Sequence[Sequence[int]], basis: Array
) -> Array:
    """Directions (K, M) that the errors of rows (N, K) have under some sets, the largest first.

    They stand beside those of a basis (K, n).
    """
    found = []
    for each in sets:
        seen = np.concatenate([looks[k] for k in each], axis=1)
        left = np.linalg.solve(np.eye(len(basis)) + seen @ seen.T, rows.T)
        # Every set counts alike, however large its errors.
        found.append(left / np.sqrt(np.sum(rows.T * left)))
    together = np.concatenate(found, axis=1)
    together -= basis @ (basis.T @ together)
    way, size, _ = np.linalg.svd(together, full_matrices=False)
    return np.asarray(way[:, size > 1e-9 * max(size[0], 1e-30)])


def _seen_in(basis: Array, look: Array) -> Array:
    """What a pole says of the directions of a basis, (m, r): all else that it sees is noise."""
    inside = basis.T @ look
    outside = look - basis @ inside
    size, way = np.linalg.eigh(np.eye(look.shape[1]) + outside.T @ outside)
    way, size, _ = np.linalg.svd(inside @ (way / np.sqrt(size)), full_matrices=False)
    return np.asarray((way * size)[:, size > LEAST])
