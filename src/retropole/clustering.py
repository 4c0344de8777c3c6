"""Group bright points, and propose the lines that some of them may lie on.

Only distances between points count here: a cloud gives the same groups and lines after any rigid
motion, and in whatever order its points come.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from .datatypes import Array, BoolArray, IntArray

LINK = 0.8
"""Points nearer than this are one cluster, metres. The beams of a 16-beam sensor are 2° apart:
0.35 m at 10 m, twice that where one is lost."""

MANY = 600
"""Of more points than this, one for each `CELL` stands for all: surfaces have millions of pairs."""

CELL = 0.04
"""Side of a cell that is smaller than anything told apart here, metres."""

PATCH = 0.3
"""Radius of the neighbourhood that tells a surface from a line, metres."""

PATCH_WIDTH = 0.09
"""Standard deviation across a neighbourhood from which it is a surface, metres: a patch of ground
has 0.15, the half of one at the edge of a sign 0.08 to 0.15, a pole 0.06 at most."""

PATCH_POINTS = 8
"""A neighbourhood with fewer points tells nothing: beams can be farther apart than it is wide."""

MAX_PAIRS, MAX_POINTS = 2000, 400
"""Pairs of points that propose a line, and points that these are tried on."""

PROPOSALS = 8
"""Distinct lines that one search proposes."""

SAME_LINE = 0.7
"""A line that shares so much of its points with a better one is that line again."""


def clusters(xyz: Array, link: float = LINK) -> list[IntArray]:
    """Group points (N, 3) that chains of steps no longer than ``link`` connect, largest first."""
    if len(xyz) == 0:
        return []
    centre, member = _cells(xyz)
    pairs = cKDTree(centre).query_pairs(link, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(centre),) * 2)
    count, label = connected_components(graph, directed=False)
    label = label[member]
    order = np.argsort(label, kind="stable")
    groups = np.split(order, np.cumsum(np.bincount(label, minlength=count))[:-1])
    return sorted(groups, key=len, reverse=True)


def _cells(xyz: Array) -> tuple[Array, IntArray]:
    """Middle (C, 3) of each occupied cell and the cell (N,) of each point; few points stay."""
    if len(xyz) <= MANY:
        return xyz, np.arange(len(xyz))
    # One number a cell: np.unique over rows would sort them as text, ten times slower.
    key = np.floor((xyz - xyz.min(axis=0)) / CELL).astype(np.int64)
    _, member = np.unique((key[:, 0] << 42) + (key[:, 1] << 21) + key[:, 2], return_inverse=True)
    member = member.reshape(-1)
    sums = np.stack([np.bincount(member, weights=column) for column in xyz.T], axis=1)
    return sums / np.bincount(member)[:, None], member


def on_surface(xyz: Array) -> BoolArray:
    """Tell which points (N, 3) lie inside a bright surface: wide both ways about each of them.

    Saturated ground and large signs are thousands of points, in which chance lines abound; what is
    left without them is where lines are worth looking for.
    """
    centre, member = _cells(xyz)
    tree = cKDTree(centre)
    pairs = tree.query_pairs(PATCH, output_type="ndarray")
    near = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(centre),) * 2)
    near = (near + near.T).tocsr()
    local = centre - centre.mean(axis=0)
    second = np.einsum("ni,nj->nij", local, local).reshape(-1, 9)
    sums = near @ np.hstack([np.ones((len(local), 1)), local, second])
    sums += np.hstack([np.ones((len(local), 1)), local, second])
    count = sums[:, :1]
    mean = sums[:, 1:4] / count
    scatter = (sums[:, 4:] / count).reshape(-1, 3, 3) - np.einsum("ni,nj->nij", mean, mean)
    across = np.sqrt(np.maximum(np.linalg.eigvalsh(scatter)[:, 1], 0.0))
    return ((across > PATCH_WIDTH) & (count[:, 0] >= PATCH_POINTS))[member]


def in_canonical_order(xyz: Array, index: IntArray) -> IntArray:
    """Sort points by their distance from their middle: the same after any motion or shuffle."""
    distance = np.linalg.norm(xyz[index] - xyz[index].mean(axis=0), axis=1)
    return index[np.argsort(distance, kind="stable")]


def propose_lines(
    xyz: Array, shortest: float, longest: float, tube: float, shell: tuple[float, float]
) -> list[tuple[Array, Array]]:
    """Propose lines through pairs of points, the best first and each only once.

    A line's score is the number of points within ``tube`` of it less the number in the ``shell``
    about it, so that a line across a plate or over bright ground scores nothing.

    Parameters
    ----------
    xyz
        (N, 3) points, metres, in canonical order.
    shortest, longest
        How far apart the two points of a pair may be, metres.
    tube
        Radius about a line, metres.
    shell
        Inner and outer radius about a line, metres.

    Returns
    -------
    list
        A point (3,) and a unit direction (3,) for each line; none where all points are near each
        other.
    """
    points = xyz[:: 1 + (len(xyz) - 1) // MAX_POINTS]
    i, j = np.triu_indices(len(points), 1)
    apart = np.linalg.norm(points[i] - points[j], axis=1)
    usable = np.flatnonzero((apart >= shortest) & (apart <= longest))
    if len(usable) == 0:
        return []
    usable = usable[:: 1 + (len(usable) - 1) // MAX_PAIRS]
    start = points[i[usable]]
    direction = (points[j[usable]] - start) / apart[usable, None]
    # Squared distance of every point from every line: |v|² − (v·n)², expanded to matrix products.
    along = direction @ points.T - np.einsum("pi,pi->p", direction, start)[:, None]
    square = (
        np.einsum("ni,ni->n", points, points)[None]
        - 2 * start @ points.T
        + np.einsum("pi,pi->p", start, start)[:, None]
    )
    across = square - along**2
    inside = across <= tube**2
    beside = (across > shell[0] ** 2) & (across < shell[1] ** 2)
    size = np.count_nonzero(inside, axis=1)
    score = (size - np.count_nonzero(beside, axis=1)).astype(float)
    inside = inside.astype(np.float32)
    lines = []
    for _ in range(PROPOSALS):
        best = int(np.argmax(score))
        if score[best] == -np.inf:
            break
        lines.append((start[best], direction[best]))
        score[inside @ inside[best] >= SAME_LINE * size] = -np.inf
    return lines
