"""A plan of poles from above: what was recorded, the LiDARs, and the poles as they lean."""

from __future__ import annotations

import base64
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ..base.datatypes import Array, BoolArray
from ..base.quantities import large, round_below
from ..result.pole_plan import PolePlanDoc, SightDoc
from .page import Html, fill, join
from .subject import colour_class
from .svg import Labels, short

WIDTH = 520.0
"""Of the picture, in its own units."""

HEIGHTS = 300.0, 620.0
"""Least and greatest height of the picture."""

MARGIN = 46.0
"""Around all that stands there: room for names."""

LEAST_SPAN = 4.0
"""A place is drawn as at least so wide, metres."""

FINE = 2
"""Dots of what was recorded in a unit of the picture, across and down."""

ABOVE = 0.3
"""What was recorded so high above the ground stands there, metres."""

ARROW = 30.0
"""Length of a LiDAR's x axis in the picture."""

LEAST_STROKE = 25.0
"""A leaning pole is drawn as at least so long in the picture: its foot covers less."""


class Compressed(Protocol):
    """What predicts the error under any set of poles; see `planning.compressed`.

    The root mean square error at the range of each LiDAR but the first is
    ``√(rest + Σ_j rows_j (I + Σ_k roots_k roots_kᵀ)⁻¹ rows_jᵀ)``.
    """

    @property
    def rows(self) -> Array:
        """(L - 1, 6, m) metres."""

    @property
    def rest(self) -> Array:
        """(L - 1,) m²."""

    @property
    def roots(self) -> Sequence[Array]:
        """Of each pole (m, r)."""


@dataclass(frozen=True, eq=False)
class PlanPicture:
    """What the page of a plan is drawn from, and predicts with; in the frame of the place.

    Attributes
    ----------
    lidars
        (L, 4, 4) where the beams of each LiDAR start, and its axes.
    points
        Of each LiDAR (N, 3) what it recorded, metres; empty where the place was drawn.
    foot, axis
        (C, 3) of each pole that could stand, metres, and unit vector upwards.
    seen
        (C, L) which LiDAR sees which.
    sights
        Of each, what the LiDARs that see it will have of it.
    words, towards
        Of each, where it is and how it leans: ``4.2 m from front, 30° left of the line to rear;
        upright``; and where to it leans alone, empty if upright.
    pairs
        (C, C) which two may stand in one placement, whatever their leans.
    chosen
        For each placement the numbers of the plan's own.
    together, alone
        What predicts the error with the surfaces, and by the poles alone.
    spacing, angle, lean
        Least distance of the feet of two poles, metres; least angle between their axes, and least
        difference of the leans of two or three that stand together, rad.
    """

    lidars: Array
    points: Sequence[Array]
    foot: Array
    axis: Array
    seen: BoolArray
    sights: Sequence[Sequence[SightDoc]]
    words: Sequence[str]
    towards: Sequence[str]
    pairs: BoolArray
    chosen: Sequence[Sequence[int]]
    together: Compressed
    alone: Compressed
    spacing: float
    angle: float
    lean: float


@dataclass(frozen=True, eq=False)
class View:
    """From the place, metres, to the picture: ahead of the first LiDAR is up, its left is left.

    Attributes
    ----------
    middle
        (2,) what is in the middle of the picture.
    scale, height
        Units of the picture per metre, and its height.
    """

    middle: Array
    scale: float
    height: float

    def of(self, points: Array) -> Array:
        """(N, 2) of the picture, of points (N, 2 or 3)."""
        return np.array([WIDTH / 2, self.height / 2]) + self.way(points[:, :2] - self.middle)

    def way(self, steps: Array) -> Array:
        """(N, 2) of the picture, of steps (N, 2 or 3)."""
        return np.asarray(-self.scale * steps[:, 1::-1])


def view_of(picture: PlanPicture, length: float) -> View:
    """Choose units per metre and height so that all LiDARs, and poles of a length, are in it."""
    tops = picture.foot + length * picture.axis
    points = np.concatenate([picture.lidars[:, :2, 3], picture.foot[:, :2], tops[:, :2]])
    low, high = points.min(axis=0), points.max(axis=0)
    down, across = np.maximum(high - low, LEAST_SPAN)
    scale = float(min((WIDTH - 2 * MARGIN) / across, (HEIGHTS[1] - 2 * MARGIN) / down))
    height = float(np.clip(scale * down + 2 * MARGIN, *HEIGHTS))
    return View((low + high) / 2, scale, height)


def recorded(picture: PlanPicture, view: View) -> Html:
    """Write what was recorded, once for all pictures of the page: two layers, as masks."""
    points = np.concatenate([np.zeros((0, 3)), *picture.points])
    at = np.floor(FINE * view.of(points)).astype(np.int64)
    shape = int(FINE * view.height), int(FINE * WIDTH)
    inside = np.all((at >= 0) & (at < shape[::-1]), axis=1)
    points, at = points[inside], at[inside]
    # The feet stand on the ground: the plane through them follows a slope.
    level = np.c_[picture.foot[:, :2], np.ones(len(picture.foot))]
    plane = np.linalg.lstsq(level, picture.foot[:, 2], rcond=None)[0]
    stands = points[:, 2] > points[:, :2] @ plane[:2] + plane[2] + ABOVE
    layers = []
    for name, chosen in (("ground", ~stands), ("standing", stands)):
        dots = np.zeros(shape, dtype=bool)
        dots[at[chosen, 1], at[chosen, 0]] = True
        sizes = {"width": f"{WIDTH:g}", "height": f"{view.height:.1f}"}
        layers.append(fill("plan-layer", name=name, image=_png(dots), **sizes))
    return fill("plan-recorded", layers=join(layers))


def _png(dots: BoolArray) -> str:
    """Write white dots on black, (rows, columns), as an address of a picture of one bit each."""
    rows = np.packbits(dots, axis=1)
    data = np.c_[np.zeros(len(rows), dtype=np.uint8), rows].tobytes()
    parts = [
        (b"IHDR", struct.pack(">IIBBBBB", dots.shape[1], dots.shape[0], 1, 0, 0, 0, 0)),
        (b"IDAT", zlib.compress(data, 9)),
        (b"IEND", b""),
    ]
    chunks = (
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        for kind, body in parts
    )
    file = b"\x89PNG\r\n\x1a\n" + b"".join(chunks)
    return f"data:image/png;base64,{base64.b64encode(file).decode()}"


def drawn(
    document: PolePlanDoc, picture: PlanPicture, view: View, placement: int | None = None
) -> Html:
    """Draw the place from above, with the poles of one placement, or of all.

    Poles are marked so that the page's code can move them.
    """
    labels = Labels(WIDTH, view.height)
    lidars = view.of(picture.lidars[:, :3, 3])
    ahead = picture.lidars[:, :3, 0].copy()
    ahead /= np.maximum(np.linalg.norm(ahead[:, :2], axis=1, keepdims=True), 1e-9)
    arrows = ARROW / view.scale * view.way(ahead)
    labels.keep_free(40.0, view.height - 12.0, 50.0, 14.0)
    for (x, y), (dx, dy) in zip(lidars.tolist(), arrows.tolist(), strict=True):
        labels.keep_free(x, y, 8.0)
        labels.keep_free(x + dx, y + dy, 6.0)
        labels.keep_free(x + dx / 2, y + dy / 2, 6.0)
    poles = _poles(document, picture, view, placement, labels)
    marks = []
    for k, ((x, y), (dx, dy)) in enumerate(zip(lidars.tolist(), arrows.tolist(), strict=True)):
        turn = float(np.degrees(np.arctan2(dy, dx)))
        colour = colour_class(k)
        marks.append(fill("plan-lidar", colour=colour, x=x, y=y, dx=dx, dy=dy, turn=turn))
        name = short(document.lidars[k].name)
        marks.append(labels.place(name, x, y, 13.0, f"name {colour}"))
    metres = round_below(0.28 * (WIDTH - 2 * MARGIN) / view.scale)
    y = view.height - 14.0
    bar = fill("scale", y=y, above=y - 10.0, length=metres * view.scale, m=large(metres))
    bar = fill("plan-bar", metres=f"{metres:g}", bar=bar)
    return join([fill("plan-backdrop"), fill("plan-spots"), *marks, bar, *poles])


def _poles(
    document: PolePlanDoc,
    picture: PlanPicture,
    view: View,
    placement: int | None,
    labels: Labels,
) -> list[Html]:
    """Draw each pole where it stands in the plan, above the ring that stays there."""
    ghosts, poles, number = [], [], 0
    for p, (own, numbers) in enumerate(zip(document.placements, picture.chosen, strict=True)):
        for pole, k in zip(own.poles, numbers, strict=True):
            if placement in (None, p):
                ((x, y),) = view.of(picture.foot[[k]]).tolist()
                dx, dy = _stroke(view.way(document.length_m * picture.axis[[k]])[0])
                labels.keep_free(x, y, 12.0)
                for part in (0.5, 1.0):
                    labels.keep_free(x + part * dx, y + part * dy, 6.0)
                ghosts.append(fill("plan-ghost", x=x, y=y))
                place = {"x": x, "y": y, "dx": dx, "dy": dy}
                poles.append(
                    fill("plan-pole", number=number, place=p, name=pole.name, kind=p % 4, **place)
                )
            number += 1
    return [*ghosts, *poles]


def _stroke(way: Array) -> tuple[float, float]:
    """Lengthen what a pole covers from above (2,), so that it is seen; upright it is nothing."""
    length = float(np.linalg.norm(way))
    x, y = way * (max(length, LEAST_STROKE) / length if length > 1.0 else 0.0)
    return float(x), float(y)
