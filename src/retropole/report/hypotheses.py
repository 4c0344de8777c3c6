"""The ways of laying the poles of a pair on each other, and which of them the scene supports."""

from __future__ import annotations

from ..result import HypothesisDoc, ResultDoc
from .hypotheses_text import deciding, pose_numbers, relative_words, standing
from .markup import inline, number, table
from .page import Html, fill, fill_each, join
from .subject import hypothesis_name, pair_name

COLUMNS = (
    *("hypothesis", "pairs", "exact", "pole rms, mm", "e_r, rad", "e_t, m"),
    *("overlap", "free-space violation", "score"),
)


def hypothesis_row(k: int, hypothesis: HypothesisDoc, mark: str) -> list[str]:
    """Write the figures of the k-th hypothesis, in the order of `COLUMNS`."""
    return [
        hypothesis_name(k) + (mark if hypothesis.chosen else ""),
        " ".join(map(pair_name, hypothesis.pairs)),
        "yes" if hypothesis.exact else "no",
        number(hypothesis.pole_rms_m, 1, 1000),
        number(hypothesis.icp_rotation_rad, 4),
        number(hypothesis.icp_translation_m, 4),
        number(hypothesis.overlap, 1, 100, " %"),
        number(hypothesis.free_space_violation, 1, 100, " %"),
        number(hypothesis.score, 3),
    ]


def hypotheses(result: ResultDoc | None) -> Html:
    """Show all hypotheses of a pair as panels (drawn by the page's code) and as a table."""
    if result is None or not result.hypotheses:
        return Html("")
    rows = [hypothesis_row(k, each, " · chosen") for k, each in enumerate(result.hypotheses)]
    return fill(
        "hypotheses",
        standing=_standing(result),
        panels=join(_panel(k, each) for k, each in enumerate(result.hypotheses)),
        table=table("Hypotheses, best first", COLUMNS, rows, (1,)),
    )


def _standing(result: ResultDoc) -> Html:
    """List the hypotheses between which a person may decide, and the options that would."""
    named = standing(result)
    if not named:
        return Html("")
    rows = [
        (
            name + (" · chosen" if each.chosen else ""),
            *pose_numbers(each),
            "" if each is result.hypotheses[0] else relative_words(result, each),
        )
        for name, each in named
    ]
    header = ("hypothesis", "roll, deg", "pitch, deg", "yaw, deg", "x, m", "y, m", "z, m")
    items = fill_each("li", map(inline, deciding(result, named)))
    return fill(
        "standing",
        table=table("Hypotheses that stand", (*header, "as against a"), rows, (7,)),
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
