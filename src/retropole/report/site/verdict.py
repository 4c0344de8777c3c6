"""The verdict on a site in words, before all else."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from ...base.quantities import counted, percent
from ...result.site import LidarDoc, SiteDoc
from ..certainty import BUDGET_RANGE
from ..markup import MISSING, inline, number, plus_minus
from ..sections import SYMBOLS, reason_item
from .pairs import LIMIT_W

TITLES = {
    "ok": "Calibrated: {count} in one frame",
    "warn": "Calibrated, with a warning: {count} in one frame",
    "refused": "Refused: no poses",
}

WORDS = {
    "ok": "Every pose below maps points of its LiDAR into the frame of the site.",
    "warn": "There is a pose for every LiDAR, and a reason to look twice before you use them.",
    "refused": "The data do not support an answer that could be trusted, so none is given.",
}


def verdict(document: SiteDoc, notes: Sequence[str] = ()) -> str:
    """Say ok, warn or refused, how good the poses are, and every reason with what to do."""
    status = document.status
    title = TITLES[status].format(count=counted(len(document.lidars), "LiDAR"))
    items = "".join(reason_item(reason) for reason in document.reasons)
    alerts = "".join(f'<p class="alert" role="note">{escape(note)}</p>' for note in notes)
    said = [WORDS[status]]
    said += _groups(document) if status == "refused" else [*_accuracy(document), *_checks(document)]
    return (
        f'{alerts}<section class="verdict {status}" aria-labelledby="verdict">'
        f'<div class="mark" aria-hidden="true">{SYMBOLS[status]}</div><div>'
        f'<h2 id="verdict">{escape(title)}</h2>{_fitness(document)}'
        f"<p>{escape(' '.join(said))}</p>"
        + (f'<ul class="reasons">{items}</ul>' if items else "")
        + f"{_next_steps(document)}</div>{_tiles(document)}</section>"
    )


def _fitness(document: SiteDoc) -> str:
    """Answer whether every pose is as accurate as was asked for; nothing where nothing was."""
    asked = [(each.name, each.fitness) for each in document.lidars if each.fitness is not None]
    if not asked:
        return ""
    short = [
        f"{name}: {fitness.words.partition(': ')[2] or fitness.words}"
        for name, fitness in asked
        if fitness.answer != "yes"
    ]
    first = asked[0][1]
    need = f"Within {100 * first.within_m:g} cm at {first.at_m:g} m"
    if not short:
        return f"<p><b>{escape(need)}: yes, all poses.</b></p>"
    return f"<p><b>{escape(f'{need}: not all poses. ' + '; '.join(short))}.</b></p>"


def far_error(lidar: LidarDoc) -> float | None:
    """Predicted error of a point at `BUDGET_RANGE`, 1 σ, metres; None where none is stated."""
    stated = lidar.predicted_error or []
    return next((each.sigma_m for each in stated if each.range_m == BUDGET_RANGE), None)


def _worst(document: SiteDoc) -> tuple[float, str] | None:
    stated = [(far_error(each), each.name) for each in document.lidars]
    return max(((sigma, name) for sigma, name in stated if sigma is not None), default=None)


def _accuracy(document: SiteDoc) -> list[str]:
    """Say what fixes the frame, and how far off the worst point may land."""
    said = [f"Datum: {document.datum}."] if document.datum else []
    worst = _worst(document)
    if worst is not None:
        said.append(
            f"A point {BUDGET_RANGE:g} m from its LiDAR is expected to land within "
            f"{plus_minus(worst[0])} (1 σ) of its true place in the site; that is the worst, of "
            f"{worst[1]}."
        )
    return said


def _checks(document: SiteDoc) -> list[str]:
    """Say what the tests and loops showed."""
    said = []
    tests = [each for each in document.tests if each.w is not None]
    if tests:
        largest = max(tests, key=lambda each: abs(each.w or 0.0))
        high = sum(abs(each.w or 0.0) > LIMIT_W for each in tests)
        beyond = (
            f"none above {LIMIT_W:g}" if not high else f"{counted(high, 'test')} above {LIMIT_W:g}"
        )
        said.append(
            f"{counted(len(tests), 'test')} of what the poses rest on: {beyond}, the largest "
            f"|w| is {number(abs(largest.w or 0.0), 1)} ({largest.name})."
        )
    loops = [each.probability for each in document.loops if each.probability is not None]
    if loops:
        said.append(
            f"{counted(len(loops), 'loop')} of pairs closed; the least likely misclosure has a "
            f"probability of {probability(min(loops))}."
        )
    if not document.tests and not document.loops:
        said.append("Nothing checks these poses: no test and no loop.")
    return said


def probability(p: float | None) -> str:
    """Write a probability; what is very small as a bound."""
    if p is None:
        return MISSING
    return "< 0.1 %" if p < 0.001 else f"{100 * p:.1f} %" if p < 0.1 else percent(p)


def _groups(document: SiteDoc) -> list[str]:
    if len(document.groups) < 2:
        return []
    names = [", ".join(document.lidars[k].name for k in group) for group in document.groups]
    return [f"Nothing links these groups of LiDARs to each other: {' | '.join(names)}."]


def _next_steps(document: SiteDoc) -> str:
    """Say what to do with an answer; what to do about a refusal is said with its reasons."""
    if document.status == "refused":
        return ""
    first = "Settle the warning first, as written above. " if document.status == "warn" else ""
    steps = (
        f"{first}Look at the clouds below: walls and ground of all LiDARs must coincide, far away "
        "too; switch them off and on one by one.",
        "Look at the tests: what stands out names the pole, the placement or the LiDAR to look at.",
        "Take the poses along: each can be copied below, and `site-result.json` holds them all.",
    )
    items = "".join(f"<li>{inline(step)}</li>" for step in steps)
    return f'<div class="advice next"><b>What to do next</b><ol>{items}</ol></div>'


def _tiles(document: SiteDoc) -> str:
    """Show the size of the site, and its worst figures, as tiles."""
    tiles = [
        (str(len(document.lidars)), "LiDARs"),
        (str(len(document.placements)), "placements"),
    ]
    if document.poles:
        tiles.append((str(len(document.poles)), "poles"))
    worst = _worst(document)
    if worst is not None:
        tiles.append((plus_minus(worst[0]), f"at {BUDGET_RANGE:g} m, 1 σ, worst"))
    tests = [abs(each.w) for each in document.tests if each.w is not None]
    if tests:
        tiles.append((number(max(tests), 1), "largest |w|"))
    cells = "".join(f"<div><dt>{escape(b)}</dt><dd>{escape(a)}</dd></div>" for a, b in tiles)
    return f'<dl class="tiles">{cells}</dl>'
