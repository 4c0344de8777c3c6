"""A free pole and one near a wall, which is doubtful by itself."""

import numpy as np

from retropole.base import se3
from retropole.base.datatypes import Array, Calibration, PointCloud
from retropole.base.sensors import find_sensor
from retropole.hypotheses.placements import PairedPlacement
from retropole.pipeline import Options, calibrate
from retropole.simulation import Box, Rectangle, Surface, scan
from tests.extraction.scenes import GROUND, PAINT, TAPE, X, Y, Z, pole

Confirmed = tuple[Calibration, tuple[PairedPlacement, ...]]
"""An answer that rests on a candidate pole, and its placement paired."""

SENSOR = find_sensor("XT32")
T_TARGET = np.eye(4)
T_SOURCE = se3.from_rt(se3.exp_so3(np.array([0.02, -0.03, 0.9])), np.array([0.8, -1.4, 0.2]))
PLACE: list[Surface] = [
    GROUND,
    Rectangle(5.2 * X, Y, Z, (4, 2), PAINT),
    Rectangle(np.array([0.0, 5.0, 0.5]), X, Z, (5.2, 2.5), PAINT),
    Box(np.array([-3.0, -3.5, 0]), np.eye(3), np.array([0.6, 1.0, 1.2]), PAINT),
    Box(np.array([1.5, 4.0, -0.6]), np.eye(3), np.array([0.4, 0.7, 0.6]), PAINT),
]
FREE = pole((3.6, 1.4), 0.35 * Y)
AT_THE_WALL = pole((5.0, -0.8), length=0.7)
"""A short pole 0.2 m from the wall."""


def vest(at: tuple[float, float]) -> list[Surface]:
    bands = [
        Box(np.array([*at, z]), np.eye(3), np.array([0.14, 0.24, 0.025]), TAPE)
        for z in (-0.15, 0.1)
    ]
    return [Box(np.array([*at, -0.35]), np.eye(3), np.array([0.12, 0.22, 0.85]), PAINT), *bands]


def recorded(things: list[Surface], seed: int = 0) -> tuple[PointCloud, PointCloud]:
    rng = np.random.default_rng(seed)
    target, source = (scan([*PLACE, *things], SENSOR, T, rng).cloud for T in (T_TARGET, T_SOURCE))
    return target, source


def answer_of(
    clouds: tuple[PointCloud, PointCloud], radius: float = 0.02, poles: int | None = None
) -> Calibration:
    return calibrate(*clouds, options=Options(sensors=(SENSOR, SENSOR), radius=radius, poles=poles))


def assert_right(T: Array | None) -> None:
    assert T is not None
    apart = se3.difference(se3.inverse(T_TARGET) @ T_SOURCE, T)
    assert apart.rotation < np.radians(1.0)
    assert apart.translation < 0.1


def confirmed_answer() -> Confirmed:
    answer = answer_of(recorded([FREE, AT_THE_WALL]))
    return answer, (PairedPlacement(answer.placements[0], answer.hypotheses[0]),)
