"""Does a line have the shape of a pole? The rules are in the order in which they are tested.

A pole is thin, straight, and long for its width, and runs across the rings.

What *Sensitivity* means at a constant: docs/evidence/detection.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..base.datatypes import PointCloud
from ..base.quantities import counted
from ..base.reasons import Code
from ..io.beams import elevations
from .lines import MIN_LINE_POINTS, MIN_POLE_POINTS, WIDTH_IN_RMS, Line

MIN_POLE_RINGS = MIN_LINE_POINTS
"""Fewest rings that hit a pole: one for each point that a line needs."""

MIN_LENGTH = 0.25
"""Smallest extent along the line, metres: three rings of a 16-beam sensor, 2° between them, at 3.6
m (2 · 3.6 m · tan 2° = 0.25 m). Sensitivity at 0.175: 2 more found, 1 fewer false; at 0.35: 6 poles
lost, 3 of them recorded posts, 10 fewer false."""

MAX_LENGTH = 4.0
"""Largest extent along the line, metres: twice a pole of 2 m. What is longer is a fence or a kerb.
Sensitivity at 2.8: 7 fewer false; at 5.6: no effect."""

MIN_SLENDERNESS = 1.5
"""Smallest ratio of the extent along the line to that across it. Sensitivity at 1.05: 1 more found,
8 more false; at 2.1: 10 recorded posts lost, 2 fewer false."""

THICK_RMS = 0.045
"""Root mean square distance from the line above which a pole is a thick post, metres. Beams evenly
spaced across a cylinder of radius r scatter by 0.62 r about their line: 37 mm for r = 60 mm, and 42
mm with 20 mm of noise. Sensitivity at 0.0315: 37 poles lost, 21 fewer false; at 0.063: 4 recorded
posts lost, 3 more found, 21 more false."""

MAX_RMS = 0.06
"""Largest scatter of the returns of a thick post about their line, metres: 0.62 r of r = 97 mm.
Sensitivity at 0.042: 26 poles lost, 17 of them recorded posts, 2 more found, 16 fewer false; at
0.084: no effect."""

MAX_THICK_LENGTH = 1.5
"""Greatest length of a thick post, metres: thick things that are longer are trunks, masts and
columns. Sensitivity at 1.05: no effect; at 2.1: 2 more found, 1 more false."""

FEW_POLE_POINTS = 10
"""With fewer points a line is a pole only if it is slim and has hardly anything around it: a few
returns of a far sign look the same. Sensitivity at 7: 1 more false; at 14: 6 recorded posts lost, 2
more found, 1 fewer false."""

MAX_CONFIRMED_RMS = 0.03
"""Largest scatter of the returns of a confirmed pole about their line, metres, and of a
line with few points: 12 mm of a cylinder
of 2 cm radius and 27 mm of noise, nearly the ±3 cm that the manuals of VLP-16 and C16 state."""

ONE_BEAM_ELEVATION = float(np.radians(0.1))
"""Returns whose elevations span less than this, rad, come from one beam: less than the finest ring
spacing of the table of sensors, Pandar64 with 1/6°, while a pole has three rings. Where all of a
line would be seen within it, elevations give no information. Sensitivity from 0.07° to 0.14°: no
effect."""


@dataclass(frozen=True)
class Failure:
    """Why a line is not a pole: a stable code, and the reason in words and numbers."""

    code: Code
    reason: str


def shape_failure(
    cloud: PointCloud, line: Line, fewest: int = MIN_POLE_POINTS, shortest: float = MIN_LENGTH
) -> Failure | None:
    """State why a line does not have the shape of a pole; None if it has.

    Parameters
    ----------
    cloud
        Where the line was found.
    line
        As `fit_line` gives it.
    fewest
        Returns that it needs.
    shortest
        Extent along it that it needs, metres.
    """
    count = len(line.index)
    size = f"{line.length:.2f} m long and {line.width:.2f} m wide"
    is_long_and_thick = line.rms > line.with_beams(THICK_RMS) and line.length > MAX_THICK_LENGTH
    if count < fewest:
        reason = f"{counted(count, 'point')} in line, a pole needs {fewest}"
        return Failure("too_few_points", reason)
    if line.length < shortest:
        return Failure("too_short", f"{line.length:.2f} m long, a pole needs {shortest:g} m")
    if line.length > MAX_LENGTH:
        return Failure("too_long", f"{line.length:.2f} m long, a pole has {MAX_LENGTH:g} m at most")
    if line.rings < MIN_POLE_RINGS:
        reason = f"hit by {line.rings} of the rings, a pole needs {MIN_POLE_RINGS}"
        return Failure("too_few_rows", reason)
    # A short piece of a thick tube is as wide as its radius makes it.
    slim = line.width - WIDTH_IN_RMS * line.thicker
    if line.length < max(MIN_SLENDERNESS * slim, line.width):
        reason = f"{size}, a pole is {MIN_SLENDERNESS:g} times longer than wide"
        return Failure("too_wide", reason)
    if line.rms > MAX_RMS + line.thicker or is_long_and_thick:
        return Failure("too_wide", f"{size}, more than any post")
    if line.rms > line.with_beams(MAX_CONFIRMED_RMS) and count < FEW_POLE_POINTS:
        reason = f"{size} with {count} points, a post as thick as that needs {FEW_POLE_POINTS}"
        return Failure("too_wide", reason)
    along_sweep = _on_one_elevation if cloud.ring is None else _runs_along_rings
    if along_sweep(cloud, line):
        reason = f"{count} consecutive points along the sweep of one beam"
        return Failure("along_a_beam", reason)
    return None


def _runs_along_rings(cloud: PointCloud, line: Line) -> bool:
    """Whether each ring leaves its points along the line, farther than the line's tube is wide to
    either side, rather than across it."""
    assert cloud.ring is not None
    _, member, counts = np.unique(cloud.ring[line.index], return_inverse=True, return_counts=True)
    along = line.along[np.lexsort((line.along, member))]
    last = np.cumsum(counts) - 1
    return float(np.median(along[last] - along[last + 1 - counts])) > line.tube


def _on_one_elevation(cloud: PointCloud, line: Line) -> bool:
    """Whether one beam, seen from the cloud's origin, hit all points of the line."""
    rays = cloud.xyz[line.index] - cloud.origin
    in_sight = line.length > ONE_BEAM_ELEVATION * np.linalg.norm(rays[0])
    return bool(in_sight and np.ptp(elevations(rays, cloud.axis)) < ONE_BEAM_ELEVATION)
