"""Does a line stand free? One function for each rule, in the order of asking.

Stripes, edges of signs and rings of a scan are thin and straight like a pole, but they are part of
something. A pole has free air beside it.

What *Sensitivity* means beside a constant: docs/detection.md.
"""

from __future__ import annotations

import numpy as np

from ..base.datatypes import Array, BoolArray, IntArray, PointCloud
from ..base.quantities import counted
from .acceptance_shape import MAX_RING_EXTENT, Failure
from .lines import FIT_ROOM, HALF, LITTLE, MOST, Line, to_nearest
from .neighbours import is_wall_behind, runs_along_sweep
from .surroundings import (
    PIECES,
    SHORT_LENGTH,
    Surroundings,
    cluttered_share,
    surroundings_of,
)

EDGE_QUANTILE = 0.9
"""A dim return is from the edge of a pole where it lies farther to the side than so many of the
bright ones, sorted by that: tape that is dim by its angle begins where the bright one ends. On a
post without tape one in ten does by chance."""

MAX_CLOSE = 0.09
"""Clutter nearer to a line than this, metres, is not a wall behind it. Sensitivity at 0.063: no
effect; at 0.126: 2 fewer false."""

SEVERAL_ON_A_RING = 2.0
"""Where the step and the width of the beams are known, and a ring can leave fewer returns than this
on a pole, single file says nothing: a PandarQT does from 3 m on."""


def surroundings_failure(
    cloud: PointCloud, near: IntArray, is_retro: BoolArray, line: Line
) -> Failure | None:
    """Say what a line is part of; None where it stands free.

    The line is cut into pieces, and in each the returns beside it are weighed against its own. A
    stripe on a wall has the wall beside it all along. A pole that is held or touched somewhere does
    not; the stray returns about a bright edge are few; and the wall that a pole leans on passes
    behind it.

    Parameters
    ----------
    cloud, near
        The cloud, with intensity, and the index (M,) of its points about the line: all within
        `SHORT_LENGTH`, or more.
    is_retro
        (N,) which points of the cloud are retro-reflective and on no other pole.
    line
        One that `shape_failure` finds nothing wrong with.
    """
    around = surroundings_of(cloud, near, is_retro, line)
    return (
        retro_clutter(around)
        or untaped_between(around)
        or _clutter_of_any_kind(around)
        or along_the_sweeps(around)
        or in_single_file(around)
        or _goes_on_without_tape(around)
    )


def retro_clutter(around: Surroundings) -> Failure | None:
    """A pole has no retro-reflective returns all along it, except those of a pole that crosses."""
    line, beside = around.line, around.retro_beside
    share = cluttered_share(line, around.along[beside], LITTLE)
    if around.has_few_points:
        share = max(share, min(1.0, np.count_nonzero(beside) / len(line.index)))
    if share <= (LITTLE if around.is_suspect else HALF):
        return None
    return Failure(
        "part_of_a_surface",
        f"along {share:.0%} of it other retro-reflective returns lie {_where(around)}: a plate, "
        "a stripe or bright ground, not a free-standing pole",
    )


def untaped_between(around: Surroundings) -> Failure | None:
    """A pole is taped all along: few returns without tape lie between its points.

    A dim one at the height of a bright one, or farther to the side, is from the edge of the pole,
    where tape is met at a grazing angle.
    """
    between = (around.along > around.line.low) & (around.along < around.line.high)
    dim = around.untaped & around.on_line & between
    apart = to_nearest(around.line.along, around.along[dim])
    alone = apart > max(LITTLE * around.line.step, FIT_ROOM)
    own = len(around.line.index)
    if np.count_nonzero(alone) <= HALF * own:
        return None
    count = int(np.count_nonzero(alone & ~_at_the_edges(around, dim)))
    if count <= HALF * own:
        return None
    lie = counted(count, "return without tape lies", "returns without tape lie")
    reason = f"{lie} between its {counted(own, 'point')}"
    return Failure("part_of_a_surface", reason)


def _at_the_edges(around: Surroundings, dim: BoolArray) -> BoolArray:
    """Which of the dim returns (K of M) lie farther to the side than the line's own.

    The side is the direction across the line in which the dim returns spread most beyond the
    others: noise along the beam is in both. So the sensor's place need not be known.
    """
    line, xyz = around.line, around.cloud.xyz
    offsets = [xyz[index] - line.point for index in (line.index, around.near[dim])]
    own, others = (each - np.outer(each @ line.direction, line.direction) for each in offsets)
    spread = others.T @ others / max(len(others), 1) - own.T @ own / len(own)
    side = np.linalg.eigh(spread)[1][:, 2]
    places, dim_places = own @ side, others @ side
    middle = np.median(places)
    reach = np.quantile(np.abs(places - middle), EDGE_QUANTILE)
    return np.asarray(np.abs(dim_places - middle) > reach)


def close_beside(around: Surroundings) -> BoolArray:
    """Which returns (M,) lie close beside the line, too near for a wall behind it."""
    return ~around.is_retro & ~around.on_line & (around.distance < MAX_CLOSE)


def _clutter_of_any_kind(around: Surroundings) -> Failure | None:
    """A pole has no returns of any kind all along it, except those of a wall behind it."""
    line, xyz = around.line, around.cloud.xyz
    beside = around.beside & (~around.is_retro | around.retro_beside)
    share = cluttered_share(line, around.along[beside], MOST)
    is_strict = around.is_suspect and not around.is_thick
    if share <= (LITTLE if is_strict else HALF):
        return None
    is_close = cluttered_share(line, around.along[close_beside(around)], MOST) > HALF
    if not (around.is_short or is_close) and is_wall_behind(
        xyz[around.near[beside]], xyz[line.index]
    ):
        return None
    return Failure(
        "part_of_a_surface",
        f"along {share:.0%} of it other returns lie {_where(around)}: a plate, a stripe or an "
        "edge, not a free-standing pole",
    )


def along_the_sweeps(around: Surroundings) -> Failure | None:
    """A pole runs across the rings; rings themselves say so better, where the cloud has them."""
    cloud, line = around.cloud, around.line
    if cloud.ring is not None or not runs_along_sweep(cloud.xyz, around.near, line):
        return None
    reason = f"{len(line.index)} points in the direction in which the beams sweep"
    return Failure("along_a_beam", reason)


def in_single_file(around: Surroundings) -> Failure | None:
    """A short pole seen by rings this close together has several points on each."""
    line, count = around.line, len(around.line.index)
    if not around.is_short or around.cloud.ring is not None:
        return None
    if line.returns_per_ring < SEVERAL_ON_A_RING:
        return None
    if line.step >= MAX_RING_EXTENT or line.rings <= MOST * count:
        return None
    return Failure(
        "along_a_beam",
        f"{count} points in single file, {100 * line.step:.0f} cm apart along {line.length:.2f} m: "
        "as one beam leaves them on a plate",
    )


def _goes_on_without_tape(around: Surroundings) -> Failure | None:
    """A short pole ends where its tape ends; a sign goes on as its post."""
    if not around.is_short or around.is_thick:
        return None
    line = around.line
    untaped = around.untaped & (around.distance < around.beside_limit)
    above, below = around.along - line.high, line.low - around.along
    needed = MOST * min(PIECES, SHORT_LENGTH / line.step)
    if max(_pieces_hit(beyond[untaped & (beyond > 0)]) for beyond in (above, below)) < needed:
        return None
    reason = f"{line.length:.2f} m long, and goes on without tape: a sign on its post"
    return Failure("goes_on_without_tape", reason)


def _pieces_hit(places: Array) -> int:
    """In how many of `PIECES` equal pieces of the length `SHORT_LENGTH` there is some place."""
    return int(np.count_nonzero(np.histogram(places, PIECES, (0.0, SHORT_LENGTH))[0]))


def _where(around: Surroundings) -> str:
    return f"{around.line.tube:.2f} to {around.beside_limit:.2f} m beside it"
