"""A plan of poles from above: what was recorded, the LiDARs, and the poles as they lean."""

from __future__ import annotations

import base64
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..base.datatypes import Array, BoolArray
from ..base.quantities import large, round_below
from ..result.pole_plan import PlannedPlacementDoc, PolePlanDoc, below
from .page import Html, fill, join
from .subject import colour_class
from .svg import Labels, short

WIDTH = 520.0
"""Of the picture, in its units."""

HEIGHTS = 300.0, 620.0
"""Least and greatest height of the picture."""

MARGIN = 46.0
"""Around all that is there: room for names."""

SURROUNDED = 2.5
"""What is drawn around LiDARs and poles, metres: enough to recognize the site."""

LEAST_SPAN = 4.0
"""A place is drawn as at least so wide, metres."""

FINE = 2
"""Dots of what was recorded in a unit of the picture, across and down."""

ABOVE = 0.3
"""What was recorded higher than this above the ground is drawn as an object, metres."""

ARROW = 30.0
"""Length of a LiDAR's x axis in the picture."""

LEAST_STROKE = 25.0
"""Least length of a leaning pole in the picture: its foot covers less."""


@dataclass(frozen=True, eq=False)
class PlanPicture:
    """What the page of a plan is drawn from, in the frame of the scene.

    Attributes
    ----------
    lidars
        (L, 4, 4) where the beams of each LiDAR start, and its axes.
    points
        Of each LiDAR (N, 3) what it recorded, metres; empty if the scene was drawn.
    feet
        (C, 3) possible positions of poles, metres: they follow the ground.
    """

    lidars: Array
    points: Sequence[Array]
    feet: Array


@dataclass(frozen=True, eq=False)
class View:
    """From the scene, metres, to the picture: ahead of the first LiDAR is up, its left is left.

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


def view_of(document: PolePlanDoc, picture: PlanPicture) -> View:
    """Choose units per metre and height: LiDARs, poles and what is near are in it."""
    poles = [pole for each in document.placements for pole in each.poles]
    feet = np.array([pole.foot_m for pole in poles]).reshape(-1, 3)
    tops = feet + document.length_m * np.array([pole.direction for pole in poles]).reshape(-1, 3)
    there = [picture.lidars[:, :3, 3], feet, tops]
    points = np.concatenate([each[:, :2] for each in there])
    low, high = points.min(axis=0) - SURROUNDED, points.max(axis=0) + SURROUNDED
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
    # The feet are on the ground: the plane through them follows a slope.
    level = np.c_[picture.feet[:, :2], np.ones(len(picture.feet))]
    plane = np.linalg.lstsq(level, picture.feet[:, 2], rcond=None)[0]
    is_raised = points[:, 2] > points[:, :2] @ plane[:2] + plane[2] + ABOVE
    layers = []
    for name, chosen in (("ground", ~is_raised), ("standing", is_raised)):
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
    """Draw the scene from above, with the poles of one placement, or of all.

    The lengths to measure are drawn where the poles of one placement are alone in the picture.
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
    shown = document.placements if placement is None else [document.placements[placement]]
    poles = _poles(document, view, placement or 0, shown, labels)
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
    tape = _tape(document, view, shown[0], labels) if len(shown) == 1 else []
    return join([fill("plan-backdrop"), *tape, *marks, bar, *poles])


def _poles(
    document: PolePlanDoc,
    view: View,
    first: int,
    placements: Sequence[PlannedPlacementDoc],
    labels: Labels,
) -> list[Html]:
    """Draw each pole where it is; of the placements the first has a number."""
    poles = []
    for p, placement in enumerate(placements, first):
        for pole in placement.poles:
            ((x, y),) = view.of(pole.foot_m[None]).tolist()
            dx, dy = _stroke(view.way(document.length_m * pole.direction[None])[0])
            labels.keep_free(x, y, 12.0)
            for part in (0.5, 1.0):
                labels.keep_free(x + part * dx, y + part * dy, 6.0)
            poles.append(fill("plan-pole", name=pole.name, kind=p % 4, x=x, y=y, dx=dx, dy=dy))
    return poles


def _tape(
    document: PolePlanDoc, view: View, placement: PlannedPlacementDoc, labels: Labels
) -> list[Html]:
    """Draw the lengths to measure, each with its metres."""
    at = {below(each.name): each.T_place_lidar[:3, 3] for each in document.lidars}
    at |= {pole.name: pole.foot_m for pole in placement.poles}
    marks = []
    for each in placement.tape:
        if each.start in at and each.end in at:
            (x, y), (u, v) = view.of(np.array([at[each.start], at[each.end]])).tolist()
            marks.append(fill("plan-tape-line", x=x, y=y, dx=u - x, dy=v - y))
            middle = (x + u) / 2, (y + v) / 2
            marks.append(labels.place(f"{each.metres:.2f} m", *middle, 4.0, "soft"))
    return marks


def _stroke(way: Array) -> tuple[float, float]:
    """Lengthen what a pole covers from above (2,), so that it is seen; upright it is nothing."""
    length = float(np.linalg.norm(way))
    x, y = way * (max(length, LEAST_STROKE) / length if length > 1.0 else 0.0)
    return float(x), float(y)
