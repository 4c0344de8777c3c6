"""Those blocks of the inverse that are needed: of each node, and of each two that an edge joins.

Selected inversion (Takahashi, Fagan and Chin 1973): with ``N = L Lᵀ`` and a front whose own nodes J
touch the later ones S, the inverse Z follows from that of its parent, which holds all of S:

    K = L_SJ L_JJ⁻¹,   Z_SJ = −Z_SS K,   Z_JJ = L_JJ⁻ᵀ L_JJ⁻¹ − Kᵀ Z_SJ.

Nothing else of the inverse is ever made.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg.blas import dtrsm

from ...api import Array
from .elimination import Blocks, Factor, scalars


def selected_inverse(factor: Factor) -> Blocks:
    """Find the blocks of the inverse at each node, and at each pair of the pattern.

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
