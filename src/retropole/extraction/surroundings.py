"""What is about a line, computed once for all rules of `acceptance_surroundings`.

What *Sensitivity* means beside a constant: docs/detection.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..base.datatypes import Array, BoolArray, IntArray, PointCloud
from .acceptance_shape import FEW_POLE_POINTS, THICK_RMS
from .lines import FIT_ROOM, HALF, LITTLE, SEARCH_ROOM, Line, distance_and_place
from .neighbours import on_crossing_line

SHORT_LENGTH = 0.8
"""A line that may be shorter than this, metres, is short and has strict limits: edges of signs and
of lamps are. It is the least length of tape that the advice in `reasons` asks for. Sensitivity at
0.56: 2 more found, 13 more false; at 1.12: 3 poles lost, 4 fewer false."""

MAX_BESIDE = 0.35
"""A return from the edge of the tube to this distance of the line is beside it, metres: the spacing
of rings 2° apart at 10 m. Sensitivity at 0.245: 4 more found, 7 more false; at 0.49: 17 poles lost,
5 of them recorded posts, 16 fewer false."""

PIECES = 8
"""Pieces that a line is cut into, to see along how much of it other returns are beside it.
Sensitivity at 6: 3 recorded posts lost, 1 more found, 3 fewer false; at 11: 1 pole lost, 4 fewer
false."""


@dataclass(frozen=True, eq=False)
class Surroundings:
    """A line, and the points of its cloud about it, as the rules see them.

    Attributes
    ----------
    cloud, line
        The cloud, and the line found in it.
    near
        (M,) index of the points about the line.
    distance, along
        (M,) their distances from the line, and their places along it, metres.
    beside_limit
        Up to which distance from the line points are beside it, metres.
    is_retro
        (M,) which of them are retro-reflective and on no other pole.
    on_line
        (M,) which lie on the line, taped or not.
    untaped
        (M,) which are too dim for tape.
    beside
        (M,) which lie beside the line, outside its tube and between its ends.
    is_thick, is_short, has_few_points
        What makes a line suspect: a post may be thick, a sign's edge short, a far sign few returns.
    """

    cloud: PointCloud
    line: Line
    near: IntArray
    distance: Array
    along: Array
    beside_limit: float
    is_retro: BoolArray
    on_line: BoolArray
    untaped: BoolArray
    beside: BoolArray
    is_thick: bool
    is_short: bool
    has_few_points: bool

    @property
    def is_suspect(self) -> bool:
        """Whether the line must pass the strict limits."""
        return self.is_thick or self.is_short or self.has_few_points

    @cached_property
    def retro_beside(self) -> BoolArray:
        """The retro-reflective ones of those beside (M,), without a pole that crosses: one other
        line, where that leaves next to nothing beside this one.
        """
        found = self.beside & self.is_retro
        if self.is_suspect or cluttered_share(self.line, self.along[found], LITTLE) <= HALF:
            return found
        rest = found.copy()
        rest[found] = ~on_crossing_line(self.cloud.xyz[self.near[found]], self.line)
        is_pole = cluttered_share(self.line, self.along[rest], LITTLE) < LITTLE
        return rest if is_pole else found


def surroundings_of(
    cloud: PointCloud, near: IntArray, is_retro: BoolArray, line: Line
) -> Surroundings:
    """Compute what the rules share; parameters as for `surroundings_failure`."""
    assert cloud.intensity is not None
    distance, along = distance_and_place(cloud.xyz[near], line.point, line.direction)
    # Where rings are farther apart, so may be the columns of a sign.
    limit = max(MAX_BESIDE, line.step)
    beside = (distance > line.tube) & (distance < limit)
    beside &= (along >= line.low) & (along <= line.high)
    retro = is_retro[near]
    dimmest = cloud.intensity[line.index].min()
    return Surroundings(
        cloud=cloud,
        line=line,
        near=near,
        distance=distance,
        along=along,
        beside_limit=limit,
        is_retro=retro,
        on_line=distance <= line.width / 2 + FIT_ROOM,
        untaped=~retro & (cloud.intensity[near] < HALF * dimmest),
        beside=beside,
        is_thick=line.rms > line.with_beams(THICK_RMS),
        # Rings half a step beyond either end may just have missed it.
        is_short=line.length + line.step < SHORT_LENGTH,
        has_few_points=len(line.index) < FEW_POLE_POINTS,
    )


def stands_behind(around: Surroundings, close: BoolArray) -> BoolArray:
    """Which of the points close to a line (M,) lie behind it rather than beside it, as seen.

    The surface of a stripe goes on to its sides, and where it falls back on one side it comes
    forward on the other. What is farther behind than to the side, with next to nothing in front,
    is a wall behind a pole, or a return from the edge of the pole that has a share of each.
    """
    line, cloud = around.line, around.cloud
    sight = line.point - cloud.origin
    sight = sight - (sight @ line.direction) * line.direction
    sight /= np.linalg.norm(sight) or 1.0
    depth = (cloud.xyz[around.near] - line.point) @ sight
    aside = np.sqrt(np.maximum(around.distance**2 - depth**2, 0.0))
    behind = close & (depth > np.maximum(aside, SEARCH_ROOM))
    in_front = close & (-depth > SEARCH_ROOM)
    if np.count_nonzero(in_front) > LITTLE * np.count_nonzero(behind):
        return np.zeros_like(close)
    return behind


def cluttered_share(line: Line, places: Array, density: float) -> float:
    """Share of the line's pieces with ``density`` or more neighbours for each point of its own.

    Pieces without points of the line do not count; ``places`` (K,) are the neighbours' along it.
    """
    edges = np.linspace(line.low, line.high, PIECES + 1)
    own = np.histogram(line.along, edges)[0]
    neighbours = np.histogram(places, edges)[0]
    return float(np.mean(neighbours[own > 0] >= density * own[own > 0]))
