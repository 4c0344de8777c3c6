"""How often poles that are hard to find still give an answer, and how often a wrong one.

Two LiDARs look at two poles in a corridor or a street. One pole, or both, stand 0.2 to 0.3 m from a
wall, beside a person in a vest or beside a bright plate, or are short and 5 to 8 m away, so that
they have few returns. In the last kind one of the two poles is missing, and vests, plates, strips
of tape and bollards stand about: the right answer is a refusal, or the true pose by other things.

    python benchmarks/detection_hard.py --scenes 20

Seeds below 1000 are for setting constants, those from 1000 on, where this starts, state figures.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context

import numpy as np
from threadpoolctl import threadpool_limits

from retropole.base import se3
from retropole.base.datatypes import Array, Calibration
from retropole.base.sensors import find_sensor
from retropole.pipeline import Options, calibrate
from retropole.simulation import Box, Cylinder, Material, Rectangle, Surface, scan
from retropole.simulation.scenes import SURROUNDINGS, draw_lidar, draw_poles

FIRST_STATED_SEED = 1000
KINDS = ("wall", "vest", "plate", "few", "wall and few", "one pole missing")
SENSORS = ("VLP-16", "VLP-16"), ("VLP-16", "HDL-32E"), ("XT32", "VLP-16")
"""Pairs of LiDARs; of four scenes, two have the first."""

WRONG_ANGLE, WRONG_DISTANCE = np.radians(1.0), 0.3
"""An answer farther from the truth, rad and m, is wrong."""

ENOUGH_RETURNS = 6
"""A scene is *well seen* where both LiDARs have so many returns on each pole."""

MIN_RETURNS, MIN_RINGS = 3, 3
"""Scenes in which a pole has less from one LiDAR are drawn again."""

TAPE, PAINT = Material(0.9, retro=True), Material(0.5)
UP = np.array([0.0, 0.0, 1.0])
MAX_DRAWS = 600


@dataclass(frozen=True)
class Outcome:
    """What came of one scene: least returns on a pole, the verdict, and how far off it is."""

    kind: str
    seed: int
    returns: int
    status: str
    codes: tuple[str, ...]
    rotation: float
    translation: float

    @property
    def is_wrong(self) -> bool:
        """Whether an answer is given that is too far from the truth."""
        answered = self.status != "refused"
        return answered and (self.rotation > WRONG_ANGLE or self.translation > WRONG_DISTANCE)


def _level(bearing: float) -> Array:
    return np.array([np.cos(bearing), np.sin(bearing), 0.0])


def beside(pole: Cylinder, what: str, eyes: Array, rng: np.random.Generator) -> list[Surface]:
    """What stands beside a pole, as LiDARs at ``eyes`` (2, 3) see it."""
    foot = np.r_[pole.centre[:2], 0.0]
    away = foot - np.r_[eyes.mean(axis=0)[:2], 0.0]
    bearing = float(np.arctan2(away[1], away[0]))
    if what == "wall":
        # Behind the pole, turned by up to 50°, and never where the pole leans into it.
        normal = _level(bearing + rng.uniform(-0.9, 0.9))
        tip = pole.length / 2 * pole.axis
        reach = max(float(tip @ normal), float(-tip @ normal), 0.0)
        gap = rng.uniform(0.2, 0.3)
        lean = np.abs(float(pole.axis @ normal))
        at = foot + (gap + (reach if lean > 0 else 0.0)) * normal
        along = np.cross(UP, normal)
        return [Rectangle(at + 1.25 * UP, along, UP, (1.5, 1.25), PAINT)]
    side = _level(bearing + rng.choice([-1, 1]) * rng.uniform(1.0, 2.1))
    if what == "vest":
        at, yaw = foot + rng.uniform(0.3, 0.45) * side, bearing + np.pi / 2
        axes = np.stack([_level(yaw), np.cross(UP, _level(yaw)), UP], axis=1)
        body = Box(at + 0.85 * UP, axes, np.array([0.22, 0.12, 0.85]), PAINT)
        bands = [Box(at + z * UP, axes, np.array([0.24, 0.14, 0.025]), TAPE) for z in (1.05, 1.3)]
        return [body, *bands]
    at = foot + rng.uniform(0.35, 0.6) * side + rng.uniform(0.8, 1.6) * UP
    across = _level(bearing + np.pi / 2 + rng.uniform(-0.6, 0.6))
    return [Rectangle(at, across, UP, (rng.uniform(0.1, 0.3), rng.uniform(0.1, 0.4)), TAPE)]


def _clutter(
    poles: Sequence[Cylinder], eyes: Array, clear: tuple[float, float], rng: np.random.Generator
) -> list[Surface]:
    """A vest and a plate where the poles are, and other bright things about the place."""
    things = [*beside(poles[1], "vest", eyes, rng), *beside(poles[0], "plate", eyes, rng)]
    for what in rng.choice(["vest", "plate", "strip", "bollard"], rng.integers(3, 9)):
        spot = np.r_[rng.uniform(-1.3, 1.3, 2) * clear, 0.0]
        if what == "strip":
            length, at = rng.uniform(0.1, 0.5), spot + rng.uniform(0.4, 1.5) * UP
            things.append(Rectangle(at, _level(rng.uniform(0, 6)), UP, (0.03, length), TAPE))
        elif what == "bollard":
            height = rng.uniform(0.3, 0.6)
            things.append(Cylinder(spot + height * UP, UP, 0.08, 2 * height, TAPE))
        else:
            things += beside(replace(poles[0], centre=spot + UP), what, eyes, rng)
    return things


def outcome_of(job: tuple[str, int]) -> Outcome | None:
    """Draw one scene, calibrate, and compare with the truth; None where no scene was found."""
    kind, seed = job
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    names = SENSORS[(0, 0, 1, 2)[seed % 4]]
    sensors = find_sensor(names[0]), find_sensor(names[1])
    for _ in range(MAX_DRAWS):
        place = SURROUNDINGS[("corridor", "street")[seed % 2]](rng)
        if min(place.clear) <= 0:
            continue
        poles = draw_poles(rng, 2, place.clear, (np.radians(15), np.radians(60)), 0.02)
        if poles is None:
            continue
        if "few" in kind:
            lengths = rng.uniform(0.5, 1.2, 2)
            poles = [
                replace(p, centre=p.centre + (rng.uniform(0, 0.5) * p.axis), length=float(length))
                for p, length in zip(poles, lengths, strict=True)
            ]
        poses = draw_lidar(rng, poles, place.clear), draw_lidar(rng, poles, place.clear)
        if poses[0] is None or poses[1] is None:
            continue
        eyes = np.stack([poses[0][:3, 3], poses[1][:3, 3]])
        if np.linalg.norm(eyes[0] - eyes[1]) < 0.5:
            continue
        ranges = [np.linalg.norm(p.centre - eye) for p in poles for eye in eyes]
        if "few" in kind and max(ranges) < 5:
            continue
        things = [
            thing
            for what in ("wall", "vest", "plate")
            if what in kind
            for pole in (poles if rng.uniform() < 0.5 else poles[:1])
            for thing in beside(pole, what, eyes, rng)
        ]
        missing = kind == "one pole missing"
        if missing:
            things = _clutter(poles, eyes, place.clear, rng)
        standing = poles[:1] if missing else poles
        everything = [*place.surfaces, *things, *standing]
        scans = [scan(everything, s, T, rng) for s, T in zip(sensors, poses, strict=True)]
        first = len(everything) - len(standing)
        counts = []
        rings = []
        for one in scans:
            assert one.cloud.ring is not None
            for k in range(len(standing)):
                on_it = one.labels == first + k
                counts.append(int(np.count_nonzero(on_it)))
                rings.append(len(np.unique(one.cloud.ring[on_it])))
        if min(counts) < MIN_RETURNS or min(rings) < MIN_RINGS:
            continue
        found = calibrate(scans[0].cloud, scans[1].cloud, options=Options(sensors=sensors))
        truth = se3.inverse(poses[0]) @ poses[1]
        return _compared(kind, seed, min(counts), found, truth)
    return None


def _compared(kind: str, seed: int, returns: int, found: Calibration, truth: Array) -> Outcome:
    codes = tuple(reason.code for reason in (*found.reasons, *found.notes))
    if found.T_target_source is None:
        return Outcome(kind, seed, returns, found.status, codes, 0.0, 0.0)
    apart = se3.difference(truth, found.T_target_source)
    return Outcome(kind, seed, returns, found.status, codes, apart.rotation, apart.translation)


def table(outcomes: Sequence[Outcome]) -> str:
    lines = [
        "| kind | scenes | answered | ok | doubtful | wrong | well seen | of these answered |",
        "| --- |" + " --- |" * 7,
    ]
    for kind in (*KINDS, "all but the last"):
        own = [o for o in outcomes if o.kind == kind]
        if kind not in KINDS:
            own = [o for o in outcomes if o.kind != KINDS[-1]]
        if not own:
            continue
        well = [o for o in own if o.returns >= ENOUGH_RETURNS]
        counts = (
            len(own),
            sum(o.status != "refused" for o in own),
            sum(o.status == "ok" for o in own),
            sum("doubtful_poles" in o.codes for o in own),
            sum(o.is_wrong for o in own),
            len(well),
            sum(o.status != "refused" for o in well),
        )
        lines.append("| " + " | ".join([kind, *map(str, counts)]) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=20, help="of each kind")
    parser.add_argument("--first", type=int, default=FIRST_STATED_SEED)
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--verbose", action="store_true", help="print every scene")
    arguments = parser.parse_args()
    seeds = range(arguments.first, arguments.first + arguments.scenes)
    jobs = [(kind, seed) for kind in KINDS for seed in seeds]
    with ProcessPoolExecutor(
        arguments.processes,
        mp_context=get_context("spawn"),
        initializer=threadpool_limits,
        initargs=(1,),
    ) as pool:
        outcomes = [o for o in pool.map(outcome_of, jobs) if o is not None]
    if arguments.verbose:
        for o in outcomes:
            off = f"{np.degrees(o.rotation):.2f}° {o.translation:.3f} m"
            print(f"{o.kind} {o.seed}: {o.returns} returns, {o.status} {off} {' '.join(o.codes)}")
    print(table(outcomes))


if __name__ == "__main__":
    main()
