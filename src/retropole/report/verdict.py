"""The verdict in words, before all else: how good the poses are, every reason, what to do next."""

from __future__ import annotations

from collections.abc import Sequence

from ..base.quantities import counted, percent
from ..base.reasons import explain
from ..result import ReasonDoc
from .listings import fitness_words, statements
from .page import EMPTY, Html, fill, fill_each, folded, inline, join
from .subject import Subject

VERDICTS = {
    "ok": ("✓", "Calibrated", "Every LiDAR has a pose in the frame of {}."),
    "warn": (
        "!",
        "Calibrated, with a warning",
        "There is a pose. Read the reason before you use it.",
    ),
    "refused": (
        "✕",
        "Refused: no pose",
        "The data do not determine a pose that can be trusted.",
    ),
}
"""Symbol, title and meaning of each status."""


def verdict(subject: Subject, notes: Sequence[str] = (), sentence: str = "") -> Html:
    """State ok, warn or refused, the accuracy of the poses, and every reason with advice.

    Of an answer it is short: its transform comes next, and what is certain of it below.

    Parameters
    ----------
    subject
        What the page is of.
    notes
        What a reader has to know of the page itself before all else.
    sentence
        How far off points are, if that is known.
    """
    site = subject.site
    symbol, title, template = VERDICTS.get(site.status, ("?", site.status, ""))
    if site.status in ("ok", "warn") and subject.pair is None:
        title += f": {counted(len(site.lidars), 'LiDAR')} in one frame"
    paths = tuple(item.path for item in site.inputs)
    items = join(reason_item(reason, paths) for reason in site.reasons)
    requested, is_short = fitness_words(subject), subject.answered
    text, meaning = requested and f"{requested}.", template.format(subject.frame)
    if subject.chance_wrong is not None:
        title, meaning = "Calibrated, not to be used yet", inline(instead_words(subject))
    elif is_short:
        # What a reason states is not stated twice.
        stated = any(requested and requested in reason.message for reason in site.reasons)
        text, meaning = "", sentence if stated else text or sentence or meaning
    body = fill(
        "said-of-verdict",
        fitness=fill("strong", text=text) if text else "",
        meaning=meaning,
        statements=EMPTY if is_short else listed_statements(subject),
        reasons=fill("reasons", items=items) if items else "",
        notes=EMPTY if is_short else folded_notes(subject),
    )
    kind = site.status if site.status in VERDICTS else "refused"
    box = verdict_box(kind, symbol, title, body)
    return join((fill_each("alert", notes), box))


def instead_words(subject: Subject) -> str:
    """Give, as Markdown, the alternative to an answer that is too likely wrong; else empty."""
    if subject.chance_wrong is None:
        return ""
    trusted = (
        ""
        if subject.pair is None
        else (" If you watched the poles and nobody touched them in between, give `--trust-poles`.")
    )
    return (
        f"The pose is wrong with a probability of {percent(subject.chance_wrong)}: do not use it. "
        "Add another pole or another placement, or record where more objects are around that both "
        f"LiDARs see.{trusted}"
    )


def listed_statements(subject: Subject) -> Html:
    """List how certain the answer is and what checked it, a sentence each."""
    items = fill_each("li", statements(subject))
    return fill("statements", items=items) if items else EMPTY


def folded_notes(subject: Subject) -> Html:
    """Fold away what to know of an answer that makes it no less true."""
    notes, paths = subject.site.notes, tuple(item.path for item in subject.site.inputs)
    items = join(reason_item(note, paths) for note in notes)
    return folded(_notes_title(notes), fill("reasons", items=items)) if items else EMPTY


def _notes_title(notes: Sequence[ReasonDoc]) -> str:
    titles = [known.title for known in (explain(note.code) for note in notes) if known is not None]
    return f"{counted(len(notes), 'note')}: {'; '.join(dict.fromkeys(titles))}"


def verdict_box(kind: str, symbol: str, title: str, body: Html) -> Html:
    """Set a verdict into a box of the colour of its kind: ok, warn or refused."""
    return fill("verdict", kind=kind, symbol=symbol, title=title, body=body)


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


def next_steps(subject: Subject) -> Html:
    """Advise on the next steps after an answer; a refusal has advice in its reasons."""
    if not subject.answered or subject.chance_wrong is not None:
        return EMPTY
    piece = "next-site" if subject.pair is None else "next-pair"
    return fill(piece, first=_warned_first(subject))


def _warned_first(subject: Subject) -> str:
    is_warned = subject.site.status == "warn"
    return "Resolve the warning first, as written above. " if is_warned else ""
