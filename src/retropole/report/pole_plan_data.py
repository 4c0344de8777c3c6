"""What the code of a plan's page moves poles with: where they could stand, and what each tells."""

from __future__ import annotations

import base64
from collections.abc import Sequence

import msgspec
import numpy as np

from ..base.datatypes import Array, BoolArray
from ..base.uncertainty import ErrorAtRange, predicted_error
from ..result.pole_plan import PolePlanDoc, SightDoc
from .pole_plan_picture import LEAST_STROKE, WIDTH, Compressed, PlanPicture, View

STEPS = 32767
"""Steps of a number of a root up to the largest of its column: 16 bits."""


class PackedRoots(msgspec.Struct, frozen=True):
    """What predicts the error under any set of poles.

    Attributes
    ----------
    size, lidars
        How many directions there are, and how many LiDARs but the first.
    rows, rest
        Base64 of little-endian float32 (lidars, 6, size), and (lidars,) m².
    ranks
        Of each pole, how many columns its root has.
    scales, roots
        Base64 of little-endian float32, one for each column of all roots, and of int16 (columns,
        size): an element is the product of both.
    """

    size: int
    lidars: int
    rows: str
    rest: list[float]
    ranks: list[int]
    scales: str
    roots: str


class PlanData(msgspec.Struct, frozen=True):
    """What the page's code has.

    Attributes
    ----------
    document
        The plan; with other poles in it, it is what the page saves.
    lidars, at
        Names of all LiDARs, and (L, 3) where they are, metres.
    foot, axis, words, towards
        Of each pole that could stand, as `PlanPicture` has them.
    sights
        Of each, for each LiDAR in order: returns, rings and its distance, mm; −1 where it does not
        see it, or has no rings.
    seen, pairs
        Base64 of bits (C, L) and (C, C), the first one highest.
    names, chosen
        Of each placement, the names of its poles, and their numbers.
    range, length
        Where the error is predicted, and of the poles, metres.
    stated
        (2, L - 1) what the plan predicts there with the surfaces, and by the poles alone, metres.
    together, alone
        What predicts it.
    spacing, angle, lean
        As `PlanPicture` has them.
    middle, scale, width, height, stroke
        Of the picture; see `View` and `LEAST_STROKE`.
    """

    document: PolePlanDoc
    lidars: list[str]
    at: Array
    foot: Array
    axis: Array
    words: list[str]
    towards: list[str]
    sights: list[list[int]]
    seen: str
    pairs: str
    names: list[list[str]]
    chosen: list[list[int]]
    range: float
    length: float
    stated: list[list[float]]
    together: PackedRoots
    alone: PackedRoots
    spacing: float
    angle: float
    lean: float
    middle: Array
    scale: float
    width: float
    height: float
    stroke: float


def plan_data(document: PolePlanDoc, picture: PlanPicture, view: View) -> PlanData:
    """Gather what the page's code needs."""
    names = [each.name for each in document.lidars]
    return PlanData(
        document,
        names,
        picture.lidars[:, :3, 3].round(3),
        picture.foot.round(3),
        picture.axis.round(5),
        list(picture.words),
        list(picture.towards),
        [_returns(each, names) for each in picture.sights],
        _bits(picture.seen),
        _bits(picture.pairs),
        [[pole.name for pole in each.poles] for each in document.placements],
        [list(each) for each in picture.chosen],
        document.range_m,
        document.length_m,
        [stated(document), stated_alone(document)],
        packed(picture.together),
        packed(picture.alone),
        picture.spacing,
        picture.angle,
        picture.lean,
        view.middle,
        view.scale,
        WIDTH,
        view.height,
        LEAST_STROKE,
    )


def _returns(sights: Sequence[SightDoc], names: Sequence[str]) -> list[int]:
    """Returns, rings and distance, mm, for each LiDAR, one behind the other."""
    found = {
        each.lidar: [
            each.returns,
            -1 if each.rings is None else each.rings,
            round(1e3 * each.distance_m),
        ]
        for each in sights
    }
    return [number for name in names for number in found.get(name, [-1, -1, -1])]


def stated(document: PolePlanDoc) -> list[float]:
    """1 σ of each LiDAR but the first at the plan's range, metres."""
    at = (document.range_m,)
    return [predicted_error(np.array(p.covariance), at)[0].sigma_m for p in document.predicted]


def stated_alone(document: PolePlanDoc) -> list[float]:
    """The same by the poles alone."""
    return [_at_range(each.alone, document.range_m) for each in document.predicted]


def _at_range(errors: Sequence[ErrorAtRange], at: float) -> float:
    """1 σ at a range, of that at others: its square grows with the square of the range."""
    squares = np.array([[each.range_m**2, each.sigma_m**2] for each in errors])
    growth, own = np.polyfit(squares[:, 0], squares[:, 1], 1, w=1 / squares[:, 1])
    return float(np.sqrt(max(growth * at**2 + own, 0.0)))


def packed(model: Compressed) -> PackedRoots:
    """Pack what predicts the error."""
    lidars, _, size = model.rows.shape
    columns = np.concatenate([np.zeros((size, 0)), *model.roots], axis=1).T
    scales = np.maximum(np.abs(columns).max(axis=1, initial=0.0), 1e-30) / STEPS
    return PackedRoots(
        size,
        lidars,
        _text(model.rows.astype("<f4").tobytes()),
        model.rest.tolist(),
        [each.shape[1] for each in model.roots],
        _text(scales.astype("<f4").tobytes()),
        _text(np.rint(columns / scales[:, None]).astype("<i2").tobytes()),
    )


def _bits(values: BoolArray) -> str:
    return _text(np.packbits(values).tobytes())


def _text(data: bytes) -> str:
    return base64.b64encode(data).decode()
