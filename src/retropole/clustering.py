"""Grouping points that chains of short steps connect."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from .datatypes import Array, IntArray

LINK = 0.8
"""Retro-reflective points nearer than this are one cluster, metres. The beams of a 16-beam sensor
are 2° apart: 0.35 m at 10 m, twice that where one is lost."""


def clusters_of(xyz: Array, link: float = LINK) -> list[IntArray]:
    """Group points that chains of steps shorter than ``link`` connect."""
    if len(xyz) == 0:
        return []
    # One point per small cube stands for all in it: a saturated surface has millions of pairs.
    cell, member = np.unique(
        np.floor(xyz / (link / 8)).astype(np.int64), axis=0, return_inverse=True
    )
    member = member.reshape(-1)
    sums = np.stack([np.bincount(member, weights=column) for column in xyz.T], axis=1)
    centre = sums / np.bincount(member)[:, None]
    pairs = cKDTree(centre).query_pairs(link, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(cell),) * 2)
    count, label = connected_components(graph, directed=False)
    label = label[member]
    order = np.argsort(label, kind="stable")
    return np.split(order, np.cumsum(np.bincount(label, minlength=count))[:-1])
