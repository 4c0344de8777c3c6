"""How often the whole method answers hard scenes, and how often it answers wrongly.

Each scene has all the errors of a field at once, new LiDARs of one of several pairs of models, and
two to four poles in a corridor, a street or a harbor. At random come on top: people in reflective
vests, bright plates, a bollard of another radius, poles 0.2 to 0.3 m from a wall, poles that are
short or far and have few returns, LiDARs that face each other or stand side by side, tilted by up
to 30° and some upside down. Any two poles lean 15° or more against each other, as users are told
to lean them. Prints Markdown tables; a scene counts in the row of every difficulty that it has.

    python benchmarks/hard_scenes.py --scenes 1000

Seeds below 1000 are for setting constants; those from 1000 on, where this starts, state figures.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context

import numpy as np
from scipy.stats import chi2
from threadpoolctl import threadpool_limits

from detection_hard import WRONG_ANGLE, WRONG_DISTANCE
from hard_arrangements import DIFFICULTIES, SENSORS, Scene, draw_pair
from retropole.base import se3
from retropole.checking.metrics import e_rt
from retropole.pipeline import Options, calibrate

FIRST_STATED_SEED = 1000
ENOUGH = 6
"""Returns of both LiDARs on one pole with which the place should be able to tell the rest."""

QUANTILES = 0.5, 0.95
"""Of e_rt, that are printed."""


@dataclass(frozen=True)
class Outcome:
    """What came of one scene, and the CPU seconds of its drawing and its calibration.

    ``returns`` are the least that a LiDAR has on a pole, ``common`` those that both have on the one
    that both see best. Off by ``rotation``, rad, and ``translation``, m, ``squared`` Mahalanobis
    distance, and the ``error`` e_rt, m; nan without an answer.
    """

    seed: int
    scene: Scene
    well_seen: bool
    returns: int
    common: int
    status: str
    codes: tuple[str, ...]
    rotation: float
    translation: float
    squared: float
    error: float
    seconds: tuple[float, float]

    @property
    def answered(self) -> bool:
        """Whether a pose is given."""
        return self.status != "refused"

    @property
    def wrong(self) -> bool:
        """Whether an answer is given that is too far from the truth."""
        far = self.rotation > WRONG_ANGLE or self.translation > WRONG_DISTANCE
        return self.answered and far


def outcome_of(seed: int, poles: int | None = None) -> Outcome | None:
    start = time.process_time()
    drawn = draw_pair(seed)
    if drawn is None:
        return None
    scene, pair = drawn
    ready = time.process_time()
    found = calibrate(pair.target, pair.source, options=Options(sensors=pair.sensors, poles=poles))
    seconds = ready - start, time.process_time() - ready
    off = np.full(6, np.nan)
    squared = error = np.nan
    if found.T_target_source is not None:
        assert found.covariance is not None
        off = se3.local(found.T_target_source, pair.T_target_source)
        squared = float(off @ np.linalg.solve(found.covariance, off))
        error = e_rt(found.T_target_source, pair.T_target_source)
    return Outcome(
        seed,
        scene,
        pair.sees_every_pole,
        min(min(each) for each in pair.returns_on_poles),
        max(min(each) for each in pair.returns_on_poles),
        found.status,
        tuple(reason.code for reason in found.reasons),
        float(np.linalg.norm(off[:3])),
        float(np.linalg.norm(off[3:])),
        squared,
        error,
        seconds,
    )


def row(name: str, own: Sequence[Outcome]) -> str:
    answered = [o for o in own if o.answered]
    wrong = [o for o in answered if o.wrong]
    well = [o for o in own if o.well_seen]
    right = sum(o.answered and not o.wrong for o in well)
    codes = Counter(o.codes[0] for o in own if not o.answered)
    held = [o.squared < chi2.ppf(0.95, 6) for o in answered]
    cells = (
        name,
        len(own),
        len(answered),
        sum(o.status == "ok" for o in answered),
        len(answered) - len(wrong),
        " ".join(str(o.seed) for o in wrong) or 0,
        ", ".join(f"{code} {count}" for code, count in codes.most_common()),
        f"{right} of {len(well)}" + (f", {100 * right / len(well):.1f} %" if well else ""),
        f"{100 * np.mean(held):.1f} %" if held else "",
        *(
            f"{1e3 * np.quantile([o.error for o in answered], q):.1f}"
            for q in QUANTILES
            if answered
        ),
    )
    return "| " + " | ".join(map(str, cells)) + " |"


def table(outcomes: Sequence[Outcome]) -> str:
    lines = [
        "| scenes with | runs | answered | ok | right | wrong: seeds | refused | well seen: right "
        "| in the 95 % region | e_rt mm, median | 95 % |",
        "| --- |" + " --- |" * 10,
    ]
    for name in DIFFICULTIES:
        lines.append(row(name, [o for o in outcomes if name in o.scene.difficulties]))
    for pair in SENSORS:
        lines.append(row(" and ".join(pair), [o for o in outcomes if o.scene.sensors == pair]))
    return "\n".join([*lines, row("all", outcomes)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=1000)
    parser.add_argument("--first", type=int, default=FIRST_STATED_SEED)
    parser.add_argument("--poles", type=int, help="as of retropole calibrate; 0: by the place")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--verbose", action="store_true", help="print every scene as it ends")
    arguments = parser.parse_args()
    seeds = range(arguments.first, arguments.first + arguments.scenes)
    outcomes = []
    with ProcessPoolExecutor(
        arguments.processes,
        mp_context=get_context("spawn"),
        initializer=threadpool_limits,
        initargs=(1,),
    ) as pool:
        run = partial(outcome_of, poles=arguments.poles)
        for seed, o in zip(seeds, pool.map(run, seeds), strict=True):
            if o is not None:
                outcomes.append(o)
            if arguments.verbose:
                print(f"{seed}: nothing possible was drawn" if o is None else line(o), flush=True)
    print(table(outcomes))
    shared = [o for o in outcomes if o.common >= ENOUGH]
    right = sum(o.answered and not o.wrong for o in shared)
    print(
        f"\nBoth LiDARs have {ENOUGH} returns or more on one pole in {len(shared)} scenes: {right} "
        f"are right, {100 * right / max(len(shared), 1):.1f} %."
    )
    drawing, calibrating = np.mean([o.seconds for o in outcomes], axis=0)
    print(
        f"\n{len(seeds) - len(outcomes)} of {len(seeds)} seeds gave no possible scene. CPU seconds "
        f"for each: {drawing:.1f} to draw and record, {calibrating:.1f} to calibrate."
    )


def line(o: Outcome) -> str:
    off = f"{np.degrees(o.rotation):.2f}° {o.translation:.3f} m, χ² {o.squared:.1f}"
    return (
        f"{o.seed}: {'WRONG ' * o.wrong}{o.status} {off}, least {o.returns} returns"
        f"{' seen' * o.well_seen}, {' '.join(o.codes)} ({', '.join(o.scene.difficulties)}; "
        f"{' '.join(o.scene.sensors)}; {o.seconds[0]:.1f} + {o.seconds[1]:.1f} s)"
    )


if __name__ == "__main__":
    main()
