"""How often recordings that deceive are answered wrongly, and under which verdict.

Every row is a kind of deception, or an honest recording that is hard (`deception_poles`,
`deception_scenes`, where it is written what counts as the truth). Corridor, street, harbor and bare
ground come in turn, so do the four pairs of sensors of `coverage`; half of the draws have ordinary
noise, half all the errors of a field. Prints Markdown tables: what came of each row, with the exact
95 % interval (Clopper and Pearson 1934) of the wrong answers as a share of all draws, how the
probability that they state compares with how often they are wrong, and what the scene says of them.

With ``--times`` both clouds say when they were recorded: at the same time where the deception needs
none in between, and ten minutes apart otherwise.

    python benchmarks/deception.py --draws 300
    python benchmarks/deception.py --draws 30 --times

Seeds below 1000 are for setting constants; those from 1000 on, where this starts, state figures.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from functools import partial
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest
from threadpoolctl import threadpool_limits

from deception_runs import Outcome, run
from deception_scenes import HONEST, KINDS
from detection_hard import ENOUGH_RETURNS
from hard_scenes import FIRST_STATED_SEED

PROBABILITIES = 0.0, 0.003, 0.01, 0.05, 0.2, 0.6, 1.0
"""Answers are grouped by what they state of being wrong."""


def interval(count: int, draws: int) -> str:
    if not draws:
        return ""
    exact = binomtest(count, draws).proportion_ci(0.95, method="exact")
    return f"{100 * exact.low:.1f} – {100 * exact.high:.1f}"


def row(name: str, own: Sequence[Outcome]) -> str:
    count = Counter(o.verdict for o in own)
    wrong: dict[str, list[int]] = {}
    for o in own:
        if o.wrong:
            wrong.setdefault(f"{o.status} {' '.join(o.codes)}".strip(), []).append(o.seed)
    refused = Counter(o.codes[0] for o in own if not o.answered)
    kept = ("ok right", "warn right", "ok wrong", "warn wrong", "refused")
    cells = (
        name,
        len(own),
        *(count[verdict] for verdict in kept),
        *(interval(count[verdict], len(own)) for verdict in kept[2:4]),
        ", ".join(f"{code} {times}" for code, times in refused.most_common()),
        "; ".join(f"{codes}: {' '.join(map(str, seeds))}" for codes, seeds in wrong.items()),
    )
    return "| " + " | ".join(map(str, cells)) + " |"


def table(outcomes: Sequence[Outcome], names: Sequence[str]) -> str:
    lines = [
        "| recordings | draws | ok right | warn right | ok wrong | warn wrong | refused "
        "| wrong ok, % | wrong warn, % | refused for | wrong: codes and seeds |",
        "| --- |" + " --- |" * 10,
    ]
    lines += [row(name, [o for o in outcomes if o.kind == name]) for name in names]
    bare = [o for o in outcomes if o.scene == "bare"]
    rest = [o for o in outcomes if o.scene != "bare"]
    totals = {"all": outcomes, "all on bare ground": bare, "all off bare ground": rest}
    # Seeds of different rows are different draws: they are named in the rows only.
    lines += [row(name, own).rsplit("|", 2)[0] + "| |" for name, own in totals.items()]
    return "\n".join(lines)


def calibration_table(outcomes: Sequence[Outcome]) -> str:
    """Compare what answers state of being wrong with how often they are."""
    lines = [
        "| stated probability | answers | stated, mean | wrong | share | 95 %, % |",
        "| --- |" + " --- |" * 5,
    ]
    stated = [
        (o.probability, o.wrong) for o in outcomes if o.answered and o.probability is not None
    ]
    for low, high in pairwise(PROBABILITIES):
        own = [(p, wrong) for p, wrong in stated if low <= p < high]
        if own:
            count = sum(wrong for _, wrong in own)
            mean = float(np.mean([p for p, _ in own]))
            cells = (
                f"{100 * low:g} – {100 * high:g} %",
                len(own),
                f"{100 * mean:.1f} %",
                count,
                f"{100 * count / len(own):.1f} %",
                interval(count, len(own)),
            )
            lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


def honest_table(outcomes: Sequence[Outcome]) -> str:
    """Count what becomes of recordings in which nothing is wrong, off bare ground."""
    own = [o for o in outcomes if o.kind in HONEST and o.scene != "bare"]
    seen = [o for o in own if o.returns >= ENOUGH_RETURNS]
    groups = {
        "all": own,
        f"{ENOUGH_RETURNS} returns or more on every pole": seen,
        "all with the errors of a field": [o for o in own if o.noise == "field"],
        f"of these {ENOUGH_RETURNS} returns or more": [o for o in seen if o.noise == "field"],
    }
    lines = [
        "| nothing wrong, off bare ground | recordings | answered | 95 %, % | confirmed | 95 %, % "
        "| refused for |",
        "| --- |" + " --- |" * 6,
    ]
    for name, group in groups.items():
        answers = [o for o in group if o.answered]
        confirmed = sum("not_confirmed" not in o.codes for o in answers)
        refused = Counter(o.codes[0] for o in group if not o.answered)
        cells = (
            name,
            len(group),
            len(answers),
            interval(len(answers), len(group)),
            confirmed,
            interval(confirmed, len(answers)),
            ", ".join(f"{code} {times}" for code, times in refused.most_common()),
        )
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


def scene_table(outcomes: Sequence[Outcome], names: Sequence[str]) -> str:
    lines = [
        "| answers | | number | overlap | covisible overlap | violation | in the way "
        "| tall in the way | tall apart | tall points | χ² |",
        "| --- |" + " --- |" * 10,
    ]
    groups = {name: [o for o in outcomes if o.kind == name] for name in names}
    groups["all on bare ground"] = [o for o in outcomes if o.scene == "bare"]
    groups["all off bare ground"] = [o for o in outcomes if o.scene != "bare"]
    for name, group in groups.items():
        for is_wrong in (False, True):
            own = [
                (o.scenery, o.chi2) for o in group if o.scenery is not None and o.wrong == is_wrong
            ]
            if own:
                values = [
                    (
                        *(s.overlap, s.covisible_overlap, s.violation, s.in_the_way),
                        *(s.tall_in_the_way, s.tall_apart, s.tall_common, chi2),
                    )
                    for s, chi2 in own
                ]
                low, middle, high = np.quantile(np.array(values, float), (0.1, 0.5, 0.9), axis=0)
                digits = 2, 2, 4, 4, 4, 2, 0, 1
                cells = [
                    f"{m:.{d}f} ({a:.{d}f} – {b:.{d}f})"
                    for a, m, b, d in zip(low, middle, high, digits, strict=True)
                ]
                cells = [name, "wrong" if is_wrong else "right", str(len(own)), *cells]
                lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def line(o: Outcome) -> str:
    off = f"{np.degrees(o.rotation):.2f}° {o.translation:.3f} m" if o.answered else ""
    if o.from_lie is not None:
        off += f", from the lie {np.degrees(o.from_lie[0]):.2f}° {o.from_lie[1]:.3f} m"
    if o.scenery is not None and o.chi2 is not None:
        s = o.scenery
        off += (
            f", χ² {o.chi2:.1f}, overlap {s.overlap:.2f}, covisible {s.covisible_overlap:.2f}, "
            f"violation {s.violation:.4f}, in the way {s.in_the_way:.4f} of {s.common}, tall "
            f"{s.tall_in_the_way:.4f} of {s.tall_common}, apart {s.tall_apart:.2f}"
        )
    return (
        f"{o.kind} {o.seed}: {o.verdict} {off} {' '.join(o.codes)} ({o.scene}, {o.noise}, "
        f"{' '.join(o.sensors)}; {o.seconds[0]:.1f} + {o.seconds[1]:.1f} s)"
    )


def record(o: Outcome) -> dict[str, Any]:
    """Give a draw for JSON; no number where there is no answer, or none is right."""
    error = {name: getattr(o, name) for name in ("rotation", "translation")}
    finite = {name: value if np.isfinite(value) else None for name, value in error.items()}
    return asdict(o) | finite | {"verdict": o.verdict}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=300, help="of each row")
    parser.add_argument("--first", type=int, default=FIRST_STATED_SEED, help="first seed")
    parser.add_argument("--times", action="store_true", help="clouds say when they were recorded")
    parser.add_argument("--poles", type=int, help="as of retropole calibrate; 0: by the place")
    parser.add_argument("--rows", nargs="*", help="only those whose name has one of these parts")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--save", type=Path, help="JSON file for a record of every draw")
    parser.add_argument("--verbose", action="store_true", help="print every draw as it ends")
    arguments = parser.parse_args()
    parts = arguments.rows
    names = [name for name in KINDS if not parts or any(part in name for part in parts)]
    seeds = range(arguments.first, arguments.first + arguments.draws)
    jobs = [(name, seed) for name in names for seed in seeds]
    asked = partial(run, times=arguments.times, poles=arguments.poles)
    outcomes = []
    with ProcessPoolExecutor(
        arguments.processes,
        mp_context=get_context("spawn"),
        initializer=threadpool_limits,
        initargs=(1,),
    ) as pool:
        for job, o in zip(jobs, pool.map(asked, jobs), strict=True):
            if o is not None:
                outcomes.append(o)
            if arguments.verbose:
                print(f"{job}: nothing possible was drawn" if o is None else line(o), flush=True)
    if arguments.save is not None:
        text = json.dumps([record(o) for o in outcomes], indent=1, allow_nan=False)
        arguments.save.write_text(text, encoding="utf-8")
    tables = table(outcomes, names), honest_table(outcomes), calibration_table(outcomes)
    print(*tables, scene_table(outcomes, names), sep="\n\n")
    drawing, calibrating = np.mean([o.seconds for o in outcomes], axis=0)
    print(
        f"\n{len(jobs) - len(outcomes)} of {len(jobs)} draws gave nothing possible. CPU seconds "
        f"for each: {drawing:.1f} to draw and record, {calibrating:.1f} to calibrate."
    )


if __name__ == "__main__":
    main()
