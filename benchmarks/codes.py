"""What each code of an answer tells: the error with it and without, and how often it is wrong.

Honest runs are three easy scenes (corridor, street, harbor) with all the errors of a field, and the
hard scenes of `hard_scenes`; deceiving ones are the rows of `deception` that are not honest. A code
that does not tell wrong answers from others is a note and no warning: larger errors are stated. The
easy scenes are run with the times at which both were recorded, and without.

Prints Markdown tables: of the honest answers, how many are ok; and of each code, over honest and
over deceiving runs, how many answers have it, the median e_rt with it and without, and how many of
the answers are wrong with it and without.

    python benchmarks/codes.py --easy 100 --hard 700 --draws 40 --first 4000 --processes 2

Seeds below 1000 are for setting what is a note (0 to 60 of easy scenes, 0 to 200 of hard ones, 100
to 135 of those that deceive); those from 4000 on state figures.
"""

from __future__ import annotations

import argparse
import zlib
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context

import numpy as np
from threadpoolctl import threadpool_limits

from deception import interval
from deception_runs import run as run_deception
from deception_runs import timed
from deception_scenes import HONEST, KINDS
from detection_hard import WRONG_ANGLE, WRONG_DISTANCE
from hard_arrangements import draw_pair
from retropole.base import se3
from retropole.base.reasons import is_note
from retropole.checking.metrics import e_rt
from retropole.pipeline import Options, calibrate
from retropole.simulation import FIELD, SimulatedPair, SimulationError, simulate_pair

EASY, TIMED, HARD = "easy scenes", "easy scenes, times known", "hard scenes"
SCENES = ("corridor", "street", "harbor")


@dataclass(frozen=True)
class Answer:
    """What came of a run: its codes, whether it is wrong, and its e_rt, metres."""

    kind: str
    seed: int
    status: str
    codes: tuple[str, ...]
    wrong: bool
    error: float


def run(job: tuple[str, int]) -> Answer | None:
    kind, seed = job
    if kind in KINDS:
        found = run_deception(job)
        if found is None:
            return None
        codes = (*found.codes, *found.notes)
        return Answer(kind, seed, found.status, codes, found.wrong, np.nan)
    pair = drawn(kind, seed)
    if pair is None:
        return None
    clouds = pair.target, pair.source
    if kind == TIMED:
        clouds = timed(clouds[0], 0.0), timed(clouds[1], 0.0)
    answer = calibrate(*clouds, options=Options(sensors=pair.sensors))
    codes = tuple(each.code for each in (*answer.reasons, *answer.notes))
    T = answer.T_target_source
    if T is None:
        return Answer(kind, seed, answer.status, codes, False, np.nan)
    off = se3.difference(T, pair.T_target_source)
    wrong = off.rotation > WRONG_ANGLE or off.translation > WRONG_DISTANCE
    error = e_rt(T, pair.T_target_source)
    return Answer(kind, seed, answer.status, codes, wrong, error)


def drawn(kind: str, seed: int) -> SimulatedPair | None:
    """Draw honest recordings; None where nothing possible was drawn."""
    if kind == HARD:
        found = draw_pair(seed)
        return None if found is None else found[1]
    rng = np.random.default_rng([zlib.crc32(b"codes"), seed])
    try:
        return simulate_pair(SCENES[seed % 3], rng, noise=FIELD)
    except SimulationError:
        return None


def honest_table(answers: Sequence[Answer]) -> str:
    lines = [
        "| honest recordings | runs | answered | right | of these ok | 95 %, % |",
        "| --- |" + " --- |" * 5,
    ]
    for kind in (EASY, TIMED, HARD):
        own = [each for each in answers if each.kind == kind]
        answered = [each for each in own if each.status != "refused"]
        right = [each for each in answered if not each.wrong]
        ok = sum(each.status == "ok" for each in right)
        cells = kind, len(own), len(answered), len(right), ok, interval(ok, len(right))
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


def code_table(answers: Sequence[Answer]) -> str:
    lines = [
        "| code | | honest answers with it | median e_rt mm, with | without | wrong, with "
        "| without | deceiving answers with it | wrong, with | without |",
        "| --- |" + " --- |" * 9,
    ]
    given = [each for each in answers if each.status != "refused"]
    honest = [each for each in given if each.kind not in KINDS and each.kind != TIMED]
    deceiving = [each for each in given if each.kind in KINDS]
    every = {code for each in given for code in each.codes}
    for code in sorted(every, key=lambda code: (is_note(code), code)):
        cells: list[object] = [f"`{code}`", "note" if is_note(code) else "warning"]
        for of in (honest, deceiving):
            groups = [[a for a in of if (code in a.codes) == with_it] for with_it in (True, False)]
            cells.append(len(groups[0]))
            if of is honest:
                cells += [
                    f"{1e3 * np.median([a.error for a in g]):.1f}" if g else "" for g in groups
                ]
            cells += [f"{sum(a.wrong for a in g)} of {len(g)}" for g in groups]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--easy", type=int, default=100, help="easy scenes of each kind")
    parser.add_argument("--hard", type=int, default=700, help="hard scenes")
    parser.add_argument("--draws", type=int, default=40, help="of each row that deceives")
    parser.add_argument("--first", type=int, default=4000, help="first seed")
    parser.add_argument("--processes", type=int, default=1)
    arguments = parser.parse_args()
    first = arguments.first
    jobs = [(kind, first + k) for kind in (EASY, TIMED) for k in range(3 * arguments.easy)]
    jobs += [(HARD, first + k) for k in range(arguments.hard)]
    kinds = [kind for kind in KINDS if kind not in HONEST]
    jobs += [(kind, first + k) for k in range(arguments.draws) for kind in kinds]
    with ProcessPoolExecutor(
        arguments.processes,
        mp_context=get_context("spawn"),
        initializer=threadpool_limits,
        initargs=(1,),
    ) as pool:
        answers = [each for each in pool.map(run, jobs) if each is not None]
    print(honest_table(answers), code_table(answers), sep="\n\n")
    deceiving = [each for each in answers if each.kind in KINDS]
    wrong = [each for each in deceiving if each.wrong]
    ok = sum(each.status == "ok" for each in wrong)
    print(f"\n{len(deceiving)} runs deceive: {len(wrong)} wrong answers, {ok} of them ok.")


if __name__ == "__main__":
    main()
