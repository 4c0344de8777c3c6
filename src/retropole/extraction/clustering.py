"""Group bright points, and tell those inside a bright surface from those along a line.

Only distances between points count here: a cloud gives the same groups after any rigid motion, and
in whatever order its points come. What *Sensitivity* means beside a constant: docs/detection.md.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ..base.datatypes import Array, BoolArray, IntArray

LINK = 1.2
"""Points with no longer step between them are one cluster, metres. Longer than two ring spacings of
a 16-beam sensor, 2° apart, up to 17 m (2 · 17 m · tan 2° = 1.19 m): a lost ring divides no pole.
Sensitivity at 0.84: 6 poles lost, 3 fewer false; at 1.68: 1 fewer false."""

MANY = 400
"""Of more points than this, some stand for all: here one for each occupied `CLUSTER_CELL`, in a
search for lines every second, third … It bounds their pairs: 400 points have 80,000, a bright
ground of 5,000 points 12 million. Larger clusters are searched without the bright surfaces in them.
Sensitivity at 280: 1 more found, 2 fewer false; at 560: 3 poles lost, 5 fewer false."""

CLUSTER_CELL = 0.04
"""Side of such a cell, metres: a third of the narrowest width told apart here, the 0.12 m radius of
a tube about a pole of 2 cm. Sensitivity at 0.028: 5 fewer false; at 0.056: 5 fewer false."""

PATCH_RADIUS = 0.3
"""Radius of the neighbourhood that tells a surface from a line, metres: wider than the 0.12 m
radius of a pole's tube, so that a line is narrow in it. Sensitivity at 0.21: 4 fewer false; at
0.42: 1 more found, 8 fewer false."""

PATCH_WIDTH = 0.09
"""Standard deviation across a neighbourhood, in its second direction, from which it is a surface,
metres. Points spread over a disc of 0.3 m have 0.15, over the half of one at an edge 0.079, and on
a pole no more than `MAX_RMS`, 0.06. Sensitivity at 0.063: 1 more found, 5 fewer false; at 0.126: 4
fewer false."""

PATCH_POINTS = 8
"""A neighbourhood with fewer points says nothing: rings can be farther apart than it is wide.
Sensitivity from 6 to 11: no effect; without it, 1 more false in a recording."""


def clusters(xyz: Array, link: float) -> list[IntArray]:
    """Group points that chains of steps no longer than ``link`` connect.

    Parameters
    ----------
    xyz
        (N, 3) points, metres.
    link
        Longest step, metres; between cells of `CLUSTER_CELL` where the points are many.

    Returns
    -------
    list
        Index (M,) of the points of each group, the largest first.
    """
    if len(xyz) == 0:
        return []
    centre, member = _cells(xyz)
    count, label = connected_components(_neighbours(centre, link), directed=False)
    label = label[member]
    order = np.argsort(label, kind="stable")
    groups = np.split(order, np.cumsum(np.bincount(label, minlength=count))[:-1])
    return sorted(groups, key=len, reverse=True)


def on_surface(xyz: Array) -> BoolArray:
    """Tell which points lie inside a bright surface: wide in two directions about each of them.

    Saturated ground and large signs are thousands of points, in which chance lines abound. Lines
    are worth looking for in what is left without them.

    Parameters
    ----------
    xyz
        (N, 3) points, metres.

    Returns
    -------
    BoolArray
        (N,) true inside a surface.
    """
    centre, member = _cells(xyz)
    near = _neighbours(centre, PATCH_RADIUS)
    near = (near + near.T).tocsr()
    local = centre - centre.mean(axis=0)
    second = np.einsum("ni,nj->nij", local, local).reshape(-1, 9)
    moments = np.hstack([np.ones((len(local), 1)), local, second])
    sums = near @ moments
    sums += moments
    count = sums[:, :1]
    mean = sums[:, 1:4] / count
    scatter = (sums[:, 4:] / count).reshape(-1, 3, 3) - np.einsum("ni,nj->nij", mean, mean)
    across = np.sqrt(np.maximum(np.linalg.eigvalsh(scatter)[:, 1], 0.0))
    return np.asarray(((across > PATCH_WIDTH) & (count[:, 0] >= PATCH_POINTS))[member])


def _cells(xyz: Array) -> tuple[Array, IntArray]:
    """Middle (C, 3) of each occupied cell and the cell (N,) of each point; few points stay."""
    if len(xyz) <= MANY:
        return xyz, np.arange(len(xyz))
    member: IntArray = np.zeros(len(xyz), dtype=np.int64)
    for column in ((xyz - xyz.min(axis=0)) // CLUSTER_CELL).T:
        # Axis by axis: np.unique over rows would sort them as text, ten times slower.
        _, places = np.unique(column, return_inverse=True)
        _, member = np.unique(member * len(xyz) + places, return_inverse=True)
    sums = np.stack([np.bincount(member, weights=column) for column in xyz.T], axis=1)
    return sums / np.bincount(member)[:, None], member


def _neighbours(centre: Array, radius: float) -> coo_array:
    """Graph (C, C) of the pairs of points no farther apart than ``radius``, each pair once."""
    pairs = cKDTree(centre).query_pairs(radius, output_type="ndarray")
    return coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(centre),) * 2)
