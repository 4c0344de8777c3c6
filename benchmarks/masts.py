"""What becomes of poles on the ground and LiDARs on masts: by height, distance and tube.

A street or a quay, all errors of a field, two new LiDARs of one model. Each hangs on a mast of its
own, tilted down by up to 20° towards two poles, one upright and one leaning by 15 to 25°, that
stand 1 to 2.5 m apart at about the same distance from both. What is hidden or falls between the
beams is not drawn again. A row counts the runs with an answer, those that are right, and of those
in which one pole has 8 returns or more from both the ones with an answer.

    python benchmarks/masts.py --runs 10

Seeds up to 1000, where this starts, are for setting constants; those after it state figures.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import product
from multiprocessing import get_context

import numpy as np
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

from deception_sites import leaning
from detection_hard import WRONG_ANGLE, WRONG_DISTANCE
from hard_scenes import FIRST_STATED_SEED
from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.base.sensors import find_sensor
from retropole.pipeline import Options, calibrate
from retropole.simulation import FIELD, Cylinder, draw_device
from retropole.simulation.pairs import Arrangement, Recorders, record
from retropole.simulation.scenes import SURROUNDINGS, TAPE, UP

HEIGHTS, DISTANCES, MODELS = (2.0, 4.0, 6.0, 8.0), (6.0, 10.0, 15.0), ("VLP-16", "XT32", "OS1")
TUBES = {0.04: 2.0, 0.06: 3.0, 0.11: 3.0, 0.16: 3.0}
"""Length of a tube, metres, by its diameter."""

PLACES = "street", "harbor"
ENOUGH = 8
"""Returns on one pole from both LiDARs from which an answer is to be expected."""

TILT, LEAN, APART = (0.0, 20.0), (15.0, 25.0), (1.0, 2.5)
"""Least and greatest tilt and lean, degrees, and distance of the poles, metres."""


@dataclass(frozen=True)
class Case:
    """A cell of the table: heights of the masts and distance, metres; tube's diameter; LiDAR."""

    height: float
    distance: float
    tube: float
    model: str


@dataclass(frozen=True)
class Outcome:
    """What came of one run; ``returns`` are the most that both LiDARs have on one pole."""

    case: Case
    seed: int
    returns: int
    status: str
    code: str
    rotation: float
    translation: float

    @property
    def answered(self) -> bool:
        """Whether a pose is given."""
        return self.status != "refused"

    @property
    def right(self) -> bool:
        """Whether it is near the truth."""
        near = self.rotation <= WRONG_ANGLE and self.translation <= WRONG_DISTANCE
        return self.answered and near


def draw(case: Case, rng: np.random.Generator) -> Arrangement:
    """Draw who stands where."""
    place = SURROUNDINGS[PLACES[int(rng.integers(2))]](rng)
    length, along = TUBES[case.tube], rng.uniform(0, 2 * np.pi)
    apart = rng.uniform(*APART) * np.array([np.cos(along), np.sin(along)])
    axes = UP, leaning(float(np.radians(rng.uniform(*LEAN))), rng.uniform(0, 2 * np.pi))
    poles = [
        Cylinder(
            np.r_[side * apart / 2, 0.02] + axis * length / 2, axis, case.tube / 2, length, TAPE
        )
        for side, axis in zip((-1, 1), axes, strict=True)
    ]
    # Along the street, on either side of it, or both on one: not through the houses.
    bearings = rng.choice([0.0, np.pi], 2) + rng.uniform(-0.4, 0.4, 2)
    poses = [_on_mast(case, float(bearing), rng) for bearing in bearings]
    return Arrangement(place.surfaces, poles, (poses[0], poses[1]), place.clear)


def _on_mast(case: Case, bearing: float, rng: np.random.Generator) -> Array:
    """Pose (4, 4) of a LiDAR that looks down a little towards the poles."""
    away = np.array([np.cos(bearing), np.sin(bearing), 0.0])
    eye = case.distance * rng.uniform(0.9, 1.1) * away
    eye[2] = case.height * rng.uniform(0.95, 1.05)
    tilt = Rotation.from_rotvec(np.radians(rng.uniform(*TILT)) * np.cross(UP, -away))
    R = (tilt * Rotation.from_euler("z", rng.uniform(0, 2 * np.pi))).as_matrix()
    return se3.from_rt(np.asarray(R), eye)


def run(job: tuple[Case, int]) -> Outcome:
    case, seed = job
    numbers = [round(100 * case.height), round(case.distance), round(100 * case.tube)]
    rng = np.random.default_rng([*numbers, MODELS.index(case.model), seed])
    sensor = find_sensor(case.model)
    *for_devices, for_recording = rng.spawn(3)
    devices = [draw_device(sensor, FIELD, each) for each in for_devices]
    recorders = Recorders((sensor, sensor), devices, FIELD, frames=1)
    pair = record(draw(case, rng), recorders, for_recording)
    found = calibrate(
        pair.target, pair.source, options=Options(sensors=pair.sensors, radius=case.tube / 2)
    )
    rotation = translation = np.nan
    if found.T_target_source is not None:
        off = se3.difference(found.T_target_source, pair.T_target_source)
        rotation, translation = off.rotation, off.translation
    return Outcome(
        case,
        seed,
        max(min(each) for each in pair.returns_on_poles),
        found.status,
        found.reasons[0].code if found.reasons else "",
        rotation,
        translation,
    )


def row(name: Sequence[str], own: Sequence[Outcome]) -> str:
    answered = [o for o in own if o.answered]
    seen = [o for o in own if o.returns >= ENOUGH]
    off = [1000 * o.translation for o in answered]
    cells = (
        *name,
        len(own),
        len(answered),
        sum(o.status == "ok" for o in own),
        sum(o.answered and not o.right for o in own),
        f"{sum(o.answered for o in seen)} of {len(seen)}" if seen else "",
        f"{np.median(off):.0f}" if off else "",
    )
    return "| " + " | ".join(map(str, cells)) + " |"


def table(outcomes: Sequence[Outcome]) -> str:
    lines = [
        "| masts | from the poles | runs | answered | ok | wrong | answered of those with 8 "
        "returns on one pole from both | off, mm, median |",
        "| --- |" + " --- |" * 7,
    ]
    for height, distance in product(HEIGHTS, DISTANCES):
        own = [o for o in outcomes if (o.case.height, o.case.distance) == (height, distance)]
        lines.append(row((f"{height:.0f} m up", f"{distance:.0f} m"), own))
    for tube, length in TUBES.items():
        own = [o for o in outcomes if o.case.tube == tube]
        lines.append(row((f"tubes of {100 * tube:.0f} cm and {length:g} m", "all"), own))
    for model in MODELS:
        lines.append(row((f"two {model}", "all"), [o for o in outcomes if o.case.model == model]))
    return "\n".join([*lines, row(("all", "all"), outcomes)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=10, help="of each cell")
    parser.add_argument("--models", nargs="+", choices=MODELS, default=MODELS)
    parser.add_argument("--heights", nargs="+", type=float, choices=HEIGHTS, default=HEIGHTS)
    parser.add_argument("--distances", nargs="+", type=float, choices=DISTANCES, default=DISTANCES)
    parser.add_argument("--first", type=int, default=FIRST_STATED_SEED, help="first seed")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--verbose", action="store_true", help="print every run as it ends")
    arguments = parser.parse_args()
    seeds = range(arguments.first, arguments.first + arguments.runs)
    heights, distances, models = arguments.heights, arguments.distances, arguments.models
    cells = [Case(*each) for each in product(heights, distances, TUBES, models)]
    jobs = [(case, seed) for seed in seeds for case in cells]
    outcomes = []
    with ProcessPoolExecutor(
        arguments.processes,
        mp_context=get_context("spawn"),
        initializer=threadpool_limits,
        initargs=(1,),
    ) as pool:
        for o in pool.map(run, jobs):
            outcomes.append(o)
            if arguments.verbose:
                print(o, flush=True)
    print(table(outcomes))


if __name__ == "__main__":
    main()
