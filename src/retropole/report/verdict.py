"""The verdict in words, before all else: how good the poses are, every reason, what to do next."""

from __future__ import annotations

from collections.abc import Sequence

from ..base.quantities import counted
from ..base.reasons import explain
from ..result import ReasonDoc
from .certainty import fitness_words, number, ranked_tests, statements, worst_lidar
from .page import EMPTY, Html, fill, fill_each, folded, inline, join, plus_minus
from .subject import Subject

VERDICTS = {
    "ok": ("✓", "Calibrated", "The poses below map points of each LiDAR into the frame of {}."),
    "warn": (
        "!",
        "Calibrated, with a warning",
        "There are poses, and a reason to look twice before you use them.",
    ),
    "refused": (
        "✕",
        "Refused: no pose",
        "The data do not support an answer that could be trusted, so none is given.",
    ),
}
"""Symbol, title and meaning of each status."""


def verdict(subject: Subject, notes: Sequence[str] = ()) -> Html:
    """Say ok, warn or refused, how good the poses are, and every reason with what to do.

    Parameters
    ----------
    subject
        What the page is of.
    notes
        What a reader has to know of the page itself before all else.
    """
    site = subject.site
    symbol, title, words = VERDICTS.get(site.status, ("?", site.status, ""))
    if site.status in ("ok", "warn") and subject.pair is None:
        title += f": {counted(len(site.lidars), 'LiDAR')} in one frame"
    paths = tuple(item.path for item in site.inputs)
    items = join(reason_item(reason, paths) for reason in site.reasons)
    of_notes = join(reason_item(note, paths) for note in site.notes)
    asked = fitness_words(subject)
    body = fill(
        "said-of-verdict",
        fitness=fill("strong", text=f"{asked}.") if asked else "",
        meaning=words.format(subject.frame),
        statements=fill_each("li", statements(subject)),
        reasons=fill("reasons", items=items) if items else "",
        notes=folded(_notes_title(site.notes), fill("reasons", items=of_notes)) if of_notes else "",
        steps=_next_steps(subject),
    )
    kind = site.status if site.status in VERDICTS else "refused"
    box = verdict_box(kind, symbol, title, body, _tiles(subject))
    return join((fill_each("alert", notes), box))


def _notes_title(notes: Sequence[ReasonDoc]) -> str:
    titles = [known.title for known in (explain(note.code) for note in notes) if known is not None]
    return f"{counted(len(notes), 'note')}: {'; '.join(dict.fromkeys(titles))}"


def verdict_box(kind: str, symbol: str, title: str, body: Html, below: Html = EMPTY) -> Html:
    """Set a verdict into a box of the colour of its kind: ok, warn or refused."""
    return fill("verdict", kind=kind, symbol=symbol, title=title, body=body, below=below)


def reason_item(reason: ReasonDoc, paths: tuple[str, ...] = ()) -> Html:
    """Show a reason: what happened here, what its code means, and what to do about it."""
    # A path keeps its small letter, also at the start.
    sentence = "" if reason.message.startswith(paths) else " sentence"
    known = explain(reason.code)
    advice = fill_each("li", map(inline, known.advice)) if known else EMPTY
    return fill(
        "reason",
        title=known.title if known else "",
        code=reason.code,
        sentence=sentence,
        message=reason.message,
        meaning=fill("meaning", text=inline(known.help)) if known else EMPTY,
        advice=fill("advice", title="What to do", items=advice) if advice else advice,
    )


def _next_steps(subject: Subject) -> Html:
    """Say what to do with an answer; what to do about a refusal is said with its reasons."""
    status = subject.site.status
    if not subject.answered:
        return EMPTY
    first = "Settle the warning first, as written above. " if status == "warn" else ""
    return fill("next-site" if subject.pair is None else "next-pair", first=first)


def _tiles(subject: Subject) -> Html:
    """Show the predicted error at each range, of the worst LiDAR, and the largest figures."""
    site, pair = subject.site, subject.pair
    worst, tests = worst_lidar(site.lidars), ranked_tests(site)
    whose = ", worst" if pair is None else ""
    tiles = [
        (plus_minus(each.sigma_m), f"at {each.range_m:g} m, 1 σ{whose}")
        for each in (worst.predicted_error if worst else None) or []
    ]
    if pair is not None and pair.margin is not None:
        tiles.append((number(pair.margin, 3), "margin over the next"))
    if tests:
        tiles.append((number(abs(tests[0].w or 0.0), 1), "largest |w|"))
    cells = join(fill("tile", name=name, value=value) for value, name in tiles)
    return fill("tiles", cells=cells) if cells else cells
