"""The verdict of a document on one line, for whoever takes its pose along."""

from __future__ import annotations

from collections.abc import Sequence

from ..base.uncertainty.confirmation import UNUSABLE
from . import ReasonDoc


def chance_wrong(reasons: Sequence[ReasonDoc]) -> float:
    """Give the largest chance of a wrong pose that a warning states; 0 where none does."""
    stated = (each.values.get("probability_wrong") for each in reasons)
    return max((float(each) for each in stated if isinstance(each, int | float)), default=0.0)


def verdict_line(status: str, reasons: Sequence[ReasonDoc]) -> str:
    """Write a verdict on one line that is safe in a comment of any format.

    ``verdict of the calibration: warn, not_confirmed; chance of a wrong pose 41.1 %``.
    """
    codes = "".join(f", {code}" for code in dict.fromkeys(each.code for each in reasons))
    wrong = chance_wrong(reasons)
    doubt = f"; chance of a wrong pose {100 * wrong:.1f} %" if wrong else ""
    advice = "; do not use it yet" if wrong > UNUSABLE else ""
    return f"verdict of the calibration: {status}{codes}{doubt}{advice}"
