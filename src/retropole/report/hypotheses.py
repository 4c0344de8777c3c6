"""The ways of laying the poles of a pair on each other, and which of them the scene supports."""

from __future__ import annotations

from ..result import HypothesisDoc, ResultDoc
from . import listings
from .certainty import number
from .hypotheses_text import deciding, pose_numbers, relative_words, standing
from .markup import inline, listed, table
from .page import EMPTY, Html, fill, fill_each, join
from .subject import hypothesis_name


def hypotheses(result: ResultDoc | None) -> Html:
    """Show all hypotheses of a pair as panels (drawn by the page's code) and as a table."""
    if result is None or not result.hypotheses:
        return EMPTY
    return fill(
        "hypotheses",
        standing=_standing(result),
        panels=join(_panel(k, each) for k, each in enumerate(result.hypotheses)),
        table=listed(listings.hypotheses(result)),
    )


def _standing(result: ResultDoc) -> Html:
    """List the hypotheses between which a person may decide, and the options that would."""
    named = standing(result)
    if not named:
        return EMPTY
    rows = [
        (
            name + (" · chosen" if each.chosen else ""),
            *pose_numbers(each),
            "" if each is result.hypotheses[0] else relative_words(result, each),
        )
        for name, each in named
    ]
    names = "hypothesis; roll, deg; pitch, deg; yaw, deg; x, m; y, m; z, m; as against a"
    items = fill_each("li", map(inline, deciding(result, named)))
    return fill(
        "standing",
        table=table("Hypotheses that stand", listings.columns(names), rows, (7,)),
        options=fill("advice", title="What decides", items=items) if items else items,
    )


def _panel(k: int, hypothesis: HypothesisDoc) -> Html:
    return fill(
        "panel",
        name=hypothesis_name(k),
        key=fill("key", key=k + 1) if k < 9 else "",
        kind=" chosen" if hypothesis.chosen else "",
        chosen=" · chosen" if hypothesis.chosen else "",
        overlap=number(hypothesis.overlap, 0, 100, " %"),
        score=number(hypothesis.score, 3),
    )
