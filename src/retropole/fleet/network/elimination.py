"""Sparse symmetric matrices of blocks: order of elimination, Cholesky factor, parts of the inverse.

Nodes that are eliminated one after the other and touch the same later ones are taken together as
one dense *front* (multifrontal method, Duff and Reid 1983), so that loops run over fronts and
LAPACK does the rest. The order is found once for a graph and serves every matrix with its pattern.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg.blas import dtrsm
from scipy.linalg.lapack import dpotrf
from scipy.sparse import csc_array, csr_array, diags_array
from scipy.sparse.csgraph import depth_first_order
from scipy.sparse.linalg import splu

from ...api import Array, IntArray
from ...base.errors import RetropoleError
from .graph import grouped

SMALL_FRONT, MOST_ZEROS = 8, 0.2
"""Nodes of a front that may be filled up with zeros to half, and the part of zeros in a larger one.
Fewer fronts have more zeros. Not tuned: a grid of 10,000 nodes makes 1,700 fronts."""


@dataclass(frozen=True, eq=False)
class Front:
    """Nodes that are eliminated together.

    Attributes
    ----------
    nodes
        (M,) the nodes in the order of elimination: its own, then later ones that they touch.
    own
        How many are its own.
    parent
        The front that takes over what is left of the others; -1 where none are.
    into
        (M - own,) their positions in it.
    pairs, rows, columns
        (P,) pairs of nodes whose earlier one is its own, and where their block stands: the first
        of the pair is at `rows`, the second at `columns`.
    """

    nodes: IntArray
    own: int
    parent: int
    into: IntArray
    pairs: IntArray
    rows: IntArray
    columns: IntArray


@dataclass(frozen=True, eq=False)
class Pattern:
    """Where a symmetric matrix of blocks has any, and the order of its elimination.

    Attributes
    ----------
    size
        N, its nodes.
    pairs
        (P, 2) pairs of nodes with a block, the lower number first, each pair once.
    fronts
        Each before its parent.
    """

    size: int
    pairs: IntArray
    fronts: tuple[Front, ...]


@dataclass(frozen=True, eq=False)
class Blocks:
    """A symmetric matrix of (B, B) blocks: `diagonal` (N, B, B), and `pairs` (P, B, B) above it."""

    diagonal: Array
    pairs: Array


@dataclass(frozen=True, eq=False)
class Factor:
    """Cholesky factor: of each front its lower triangle (C, C), and the rows below it (R, C)."""

    pattern: Pattern
    block: int
    triangles: tuple[Array, ...]
    below: tuple[Array, ...]


def find_pattern(size: int, pairs: IntArray) -> Pattern:
    """Order the elimination: minimum degree (SuperLU), then nodes taken together as fronts.

    Parameters
    ----------
    size
        How many nodes.
    pairs
        (P, 2) pairs of nodes, the lower number first, each pair once.
    """
    order = _minimum_degree(size, pairs)
    groups, parents = _merged(_columns(pairs, order))
    sequence = _postorder(parents)
    own = [len(groups[g][0]) for g in sequence]
    ordered = order[np.concatenate([groups[g][0] for g in sequence])]
    place, number = np.argsort(ordered), [*np.argsort(sequence).tolist(), -1]
    places = place[pairs]
    front_of = np.repeat(np.arange(len(sequence)), own)
    pairs_of = grouped(front_of[places.min(axis=1)], len(sequence))
    # Its own come before all later ones, and one after the other.
    members = [
        np.concatenate([np.sort(place[order[part]]) for part in groups[g]]) for g in sequence
    ]
    fronts = []
    for f, g in enumerate(sequence):
        parent, later = number[parents[g]], members[f][own[f] :]
        into = np.searchsorted(members[parent], later) if parent >= 0 else later
        rows, columns = np.searchsorted(members[f], places[pairs_of[f]]).T
        fronts.append(Front(ordered[members[f]], own[f], parent, into, pairs_of[f], rows, columns))
    return Pattern(size, pairs, tuple(fronts))


def _minimum_degree(size: int, pairs: IntArray) -> IntArray:
    """(N,) nodes in the order of minimum degree."""
    one_way = csc_array((np.ones(len(pairs)), tuple(pairs.T)), shape=(size, size))
    joined = one_way + one_way.T
    # Diagonally dominant: any values do, only the pattern counts.
    matrix = csc_array(diags_array(joined.sum(axis=1) + 1.0) - joined)
    options = {"SymmetricMode": True}
    found = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    return np.argsort(found.perm_c).astype(np.int64)


def _columns(pairs: IntArray, order: IntArray) -> list[set[int]]:
    """Later places that each place touches when it is eliminated."""
    touched = [set[int]() for _ in order]
    for first, later in np.sort(np.argsort(order)[pairs], axis=1).tolist():
        touched[first].add(later)
    for later in filter(None, touched):
        # The first of them then touches the others.
        touched[min(later)] |= later - {min(later)}
    return touched


def _merged(touched: list[set[int]]) -> tuple[list[tuple[list[int], list[int]]], list[int]]:
    """Take places together as fronts: own and later places of each, and the parent of each."""
    size = len(touched)
    own: list[list[int]] = [[k] for k in range(size)]
    filled = [1 + len(each) for each in touched]
    children: list[list[int]] = [[] for _ in range(size)]
    for k, later in enumerate(touched):
        kept = []
        for child in sorted(children[k], key=lambda c: -len(touched[c])):
            count = len(own[k]) + len(own[child])
            whole = count * (count + 1) // 2 + count * len(later)
            zeros = whole - filled[k] - filled[child]
            if zeros <= MOST_ZEROS * whole or (count <= SMALL_FRONT and zeros <= 0.5 * whole):
                own[k], own[child] = own[child] + own[k], []
                filled[k] += filled[child]
                kept += children[child]
            else:
                kept.append(child)
        children[k] = kept
        if later:
            children[min(later)].append(k)
    left = [k for k in range(size) if own[k]]
    above = {child: g for g, k in enumerate(left) for child in children[k]}
    return [(own[k], list(touched[k])) for k in left], [above.get(k, -1) for k in left]


def _postorder(parents: list[int]) -> list[int]:
    """Give the fronts in an order in which each stands right after all that lead to it."""
    children, size = np.arange(1, len(parents) + 1), len(parents) + 1
    tree = csr_array((children, (np.array(parents) + 1, children)), shape=(size, size))
    found: list[int] = (depth_first_order(tree, 0)[0][:0:-1] - 1).tolist()
    return found


def scalars(nodes: IntArray, block: int) -> IntArray:
    """Give the numbers (M B,) of the unknowns of some nodes (M,)."""
    return np.asarray((nodes[:, None] * block + np.arange(block)).ravel())


def factorise(pattern: Pattern, matrix: Blocks) -> Factor:
    """Find the Cholesky factor.

    Raises
    ------
    RetropoleError
        Where the matrix is not positive definite.
    """
    block = matrix.diagonal.shape[-1]
    left: list[list[tuple[IntArray, Array]]] = [[] for _ in pattern.fronts]
    triangles, below = [], []
    for f, front in enumerate(pattern.fronts):
        count, c = len(front.nodes), front.own * block
        dense = np.zeros((count * block, count * block))
        by_node = dense.reshape(count, block, count, block)
        own = np.arange(front.own)
        by_node[own, :, own, :] = matrix.diagonal[front.nodes[: front.own]]
        entries = matrix.pairs[front.pairs]
        by_node[front.rows, :, front.columns, :] = entries
        by_node[front.columns, :, front.rows, :] = np.swapaxes(entries, 1, 2)
        for index, rest in left[f]:
            dense[index[:, None], index] += rest
        left[f] = []
        triangle, failed = dpotrf(dense[:c, :c], lower=1, clean=1)
        if failed:
            raise RetropoleError("the normal equations of the network are not positive definite")
        triangles.append(triangle)
        if count > front.own:
            # Symmetric: rows below the triangle are the columns beside it, as LAPACK stores them.
            rows = dtrsm(1.0, triangle, dense[:c, c:].T, side=1, lower=1, trans_a=1)
            left[front.parent].append((scalars(front.into, block), dense[c:, c:] - rows @ rows.T))
        else:
            rows = np.zeros((0, c))
        below.append(rows)
    return Factor(pattern, block, tuple(triangles), tuple(below))


def solve(factor: Factor, right: Array) -> Array:
    """Solve for right-hand sides (N, B, K)."""
    size, block, sides = right.shape
    x = right.reshape(size * block, sides).copy()
    places = (
        np.split(scalars(front.nodes, block), [front.own * block])
        for front in factor.pattern.fronts
    )
    steps = [*zip(places, factor.triangles, factor.below, strict=True)]
    for (own, later), L, below in steps:
        x[own] = dtrsm(1.0, L, x[own], lower=1)
        x[later] -= below @ x[own]
    for (own, later), L, below in reversed(steps):
        x[own] = dtrsm(1.0, L, x[own] - below.T @ x[later], lower=1, trans_a=1)
    return x.reshape(size, block, sides)


def selected_inverse(factor: Factor) -> Blocks:
    """Find the blocks of the inverse at each node, and at each pair of the pattern.

    Selected inversion (Takahashi, Fagan and Chin 1973): with ``N = L Lᵀ`` and a front whose own
    nodes J touch the later ones S, the inverse Z follows from that of its parent, which holds all
    of S:

        K = L_SJ L_JJ⁻¹,   Z_SJ = −Z_SS K,   Z_JJ = L_JJ⁻ᵀ L_JJ⁻¹ − Kᵀ Z_SJ.

    Nothing else of the inverse is ever made.

    Parameters
    ----------
    factor
        Of a symmetric positive definite matrix.

    Returns
    -------
    Blocks
        ``diagonal`` (N, B, B), and ``pairs`` (P, B, B) with rows of the pair's first node.
    """
    pattern, b = factor.pattern, factor.block
    diagonal = np.empty((pattern.size, b, b))
    pairs = np.empty((len(pattern.pairs), b, b))
    waiting = np.zeros(len(pattern.fronts), dtype=np.int64)
    np.add.at(waiting, [front.parent for front in pattern.fronts if front.parent >= 0], 1)
    inverses: dict[int, Array] = {}
    for f in range(len(pattern.fronts) - 1, -1, -1):
        front, L, below = pattern.fronts[f], factor.triangles[f], factor.below[f]
        count, c = len(front.nodes), front.own * b
        inverse = np.empty((count * b, count * b))
        root = dtrsm(1.0, L, np.eye(c), lower=1)
        own = root.T @ root
        if count > front.own:
            index = scalars(front.into, b)
            later = inverses[front.parent][index[:, None], index]
            waiting[front.parent] -= 1
            if not waiting[front.parent]:
                del inverses[front.parent]
            K = below @ root
            cross = -later @ K
            own = own - K.T @ cross
            inverse[c:, c:], inverse[c:, :c], inverse[:c, c:] = later, cross, cross.T
        inverse[:c, :c] = own
        by_node = inverse.reshape(count, b, count, b)
        k = np.arange(front.own)
        blocks = by_node[k, :, k, :]
        diagonal[front.nodes[: front.own]] = (blocks + np.swapaxes(blocks, 1, 2)) / 2
        pairs[front.pairs] = by_node[front.rows, :, front.columns, :]
        if waiting[f]:
            inverses[f] = inverse
    return Blocks(diagonal, pairs)
