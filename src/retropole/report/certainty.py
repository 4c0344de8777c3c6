"""How certain an answer is, in words that the console, the page and Python share."""

from __future__ import annotations

from typing import NamedTuple

from ..base.quantities import error, percent, value, value_and_error
from ..base.uncertainty import predicted_error, source_words
from ..result import ResultDoc

BUDGET_RANGE = 30.0
"""Range at which the shares of the budget are stated, metres."""


class ErrorParts(NamedTuple):
    """Predicted error at a range, metres, and its two parts; squared, they add up."""

    range_m: float
    together: float
    random: float
    systematic: float


def error_parts(result: ResultDoc) -> list[ErrorParts]:
    """Part the predicted error at each range; empty where its parts are not stated."""
    stated, parts = result.predicted_error, result.uncertainty
    if not stated or parts is None:
        return []
    ranges = tuple(each.range_m for each in stated)
    random, systematic = (
        predicted_error(part, ranges) for part in (parts.random, parts.systematic)
    )
    return [
        ErrorParts(each.range_m, each.sigma_m, of_random.sigma_m, of_systematic.sigma_m)
        for each, of_random, of_systematic in zip(stated, random, systematic, strict=True)
    ]


def largest_error(result: ResultDoc) -> str | None:
    """Name the largest source of error, and its share; None where no budget is stated."""
    if not result.budget:
        return None
    entry = max(result.budget, key=lambda each: each.share_at_30m)
    at = [each.sigma_m for each in result.predicted_error or [] if each.range_m == BUDGET_RANGE]
    whole = "".join(f" of ± {error(sigma)}" for sigma in at)
    share = f"{percent(entry.share_at_30m)} of the variance{whole} at {BUDGET_RANGE:g} m"
    return f"{source_words(entry.name, entry.sensor)}: {share}"


def radius_words(result: ResultDoc) -> str | None:
    """Say the radius as given and as estimated; None where it was not estimated."""
    radius = result.radius
    if radius is None:
        return None
    given = value(radius.given, radius.sigma)
    return f"{given} given, {value_and_error(radius.estimated, radius.sigma)} estimated"


def scene_words(result: ResultDoc) -> str | None:
    """Say how many places agree with the pose and deny it; None where the scene was not asked."""
    return None if result.confirmation is None else result.confirmation.words
