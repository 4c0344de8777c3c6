"""A city of LiDARs on posts along streets: relative poses, wrong ones among them, and a survey."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from retropole.base import se3
from retropole.base.datatypes import Array, BoolArray, IntArray

SPACING, BLOCK = 30.0, 4
"""Metres from post to post along a street, and posts from crossing to crossing."""

ACROSS = 0.65
"""Part of neighbours whose first and second LiDAR are joined too: two edges for each LiDAR in
all."""

ROTATION, TRANSLATION = (0.02, 0.2), (0.003, 0.02)
"""1 σ of relative poses: from and to, degrees and metres."""

SURVEY = 0.01
"""1 σ of each coordinate of a control point, metres."""


@dataclass(frozen=True, eq=False)
class City:
    """A network whose true poses are known.

    Attributes
    ----------
    T_world_node
        (N, 4, 4) true poses.
    i, j
        (E,) the poses of each edge.
    T_i_j
        (E, 4, 4) measured: map points of j into the frame of i.
    covariance
        (E, 6, 6) of the noise, over ``[φ, δ]``, axes of i.
    wrong
        (E,) which have a gross error.
    error
        (E, 6) that error, over ``[φ, δ]``, axes of i; zero for all others.
    control
        (C,) nodes whose position was surveyed.
    surveyed
        (C, 3) where, metres, with `SURVEY` as 1 σ of each coordinate.
    """

    T_world_node: Array
    i: IntArray
    j: IntArray
    T_i_j: Array
    covariance: Array
    wrong: BoolArray
    error: Array
    control: IntArray
    surveyed: Array


def simulate_city(
    nodes: int, rng: np.random.Generator, wrong: float = 0.01, controls: int = 100
) -> City:
    """Draw a city: streets of posts in a grid, two LiDARs on each, two edges for each LiDAR.

    The LiDARs of a post are joined, and those of two posts that stand next to each other by up to
    three of four possible pairs. Gross errors are drawn on a scale from one to a thousand times the
    noise, a third each in rotation, in translation and in both, and one in ten is a relative pose
    that has nothing to do with the true one.

    Parameters
    ----------
    nodes
        How many LiDARs, about: streets are whole.
    rng
        All that is drawn.
    wrong
        Part of the edges with a gross error.
    controls
        How many LiDARs have a surveyed position.
    """
    posts, streets = _streets(max(nodes // 2, 2))
    T = _poses(posts, rng)
    i, j = _edges(len(posts), streets, rng)
    count = len(i)
    covariance = _covariances(count, rng)
    noise = np.einsum("kab,kb->ka", np.linalg.cholesky(covariance), rng.normal(size=(count, 6)))
    true = np.linalg.inv(T[i]) @ T[j]
    bad = np.zeros(count, dtype=bool)
    bad[rng.permutation(count)[: round(wrong * count)]] = True
    error = np.zeros((count, 6))
    error[bad] = _gross(np.flatnonzero(bad), covariance, true, rng)
    measured = true.copy()
    # The truth is Exp(φ) R of what is measured.
    for step in (noise, error):
        measured[:, :3, :3] = np.swapaxes(se3.exp_so3(step[:, :3]), 1, 2) @ measured[:, :3, :3]
        measured[:, :3, 3] -= step[:, 3:]
    control = np.sort(rng.permutation(len(T))[:controls])
    surveyed = T[control, :3, 3] + SURVEY * rng.normal(size=(len(control), 3))
    return City(T, i, j, measured, covariance, bad, error, control, surveyed)


def _streets(posts: int) -> tuple[Array, IntArray]:
    """Positions (P, 2) of posts, and pairs of neighbours along streets (S, 2)."""
    # Of each BLOCK² places of the grid 2 BLOCK − 1 lie on a street.
    side = max(round(np.sqrt(posts * BLOCK**2 / (2 * BLOCK - 1))), 2)
    x, y = np.meshgrid(np.arange(side), np.arange(side), indexing="ij")
    street = (x % BLOCK == 0) | (y % BLOCK == 0)
    number = np.where(street, np.cumsum(street).reshape(street.shape) - 1, -1)
    pairs = [
        np.stack([a[(a >= 0) & (b >= 0)], b[(a >= 0) & (b >= 0)]], axis=1)
        for a, b in ((number[:-1], number[1:]), (number[:, :-1], number[:, 1:]))
    ]
    return np.stack([x[street], y[street]], axis=1) * SPACING, np.concatenate(pairs)


def _poses(posts: Array, rng: np.random.Generator) -> Array:
    """Two LiDARs on each post: any yaw, leaning by up to some 10°."""
    count = 2 * len(posts)
    place = np.repeat(posts, 2, axis=0) + rng.uniform(-3, 3, (count, 2))
    lean, yaw = rng.normal(size=(count, 3)) * np.radians(10), rng.uniform(-np.pi, np.pi, count)
    turned = np.zeros((count, 3))
    turned[:, 2] = yaw
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = se3.exp_so3(lean * [1, 1, 0]) @ se3.exp_so3(turned)
    T[:, :2, 3], T[:, 2, 3] = place, rng.uniform(4, 8, count)
    return T


def _edges(posts: int, streets: IntArray, rng: np.random.Generator) -> tuple[IntArray, IntArray]:
    """Ends of the edges: of the LiDARs of a post, and of some of those of neighbours."""
    a, b = streets.T
    along = [np.stack([2 * a + p, 2 * b + q], axis=1) for p in (0, 1) for q in (0, 1)]
    # Both on the same side see each other's poles; across, some of one kind do.
    kept = [along[0], along[3], along[1][rng.random(len(a)) < ACROSS]]
    mates = np.stack([2 * np.arange(posts), 2 * np.arange(posts) + 1], axis=1)
    ends = np.concatenate([mates, *kept])
    swapped = rng.random(len(ends)) < 0.5
    ends[swapped] = ends[swapped][:, ::-1]
    return ends[:, 0].copy(), ends[:, 1].copy()


def _covariances(count: int, rng: np.random.Generator) -> Array:
    """(E, 6, 6) of unequal size along unequal axes, rotation and translation correlated."""
    turned, moved = (
        np.exp(rng.uniform(np.log(low), np.log(high), (count, 3)))
        for low, high in (np.radians(ROTATION), TRANSLATION)
    )
    sigma = np.concatenate([turned, moved], axis=1)
    mixed = np.eye(6) + 0.3 * rng.normal(size=(count, 6, 6))
    mixed /= np.linalg.norm(mixed, axis=2, keepdims=True)
    root = sigma[:, :, None] * mixed
    return np.asarray(root @ np.swapaxes(root, 1, 2))


def _gross(which: IntArray, covariance: Array, true: Array, rng: np.random.Generator) -> Array:
    """Draw gross errors (K, 6) of some edges."""
    count = len(which)
    sigma = np.sqrt(np.diagonal(covariance[which], axis1=1, axis2=2))
    way = rng.normal(size=(count, 6))
    kind = rng.integers(3, size=count)
    way[kind == 0, 3:] = 0.0
    way[kind == 1, :3] = 0.0
    size = 10 ** rng.uniform(0, 3, (count, 1))
    error = size * sigma * way / np.linalg.norm(way, axis=1, keepdims=True)
    angle = np.linalg.norm(error[:, :3], axis=1, keepdims=True)
    error[:, :3] *= np.minimum(1.0, np.pi / np.maximum(angle, 1e-12))
    for k in np.flatnonzero(rng.random(count) < 0.1):
        other = se3.random(rng, SPACING)
        error[k] = se3.local(other, true[which[k]])
    return np.asarray(error)
