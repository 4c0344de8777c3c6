"""How certain an answer is, in words that the terminal, the page and Python share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from ..base.quantities import UNKNOWN, error, percent, value, value_and_error
from ..base.uncertainty import ErrorAtRange, Uncertainty, predicted_error, source_words
from ..result import ResultDoc
from ..result.site import SiteDoc
from ..result.site_checks import LoopDoc, TestDoc
from ..result.site_parts import LidarDoc

BUDGET_RANGE = 30.0
"""Range at which the shares of the budget are stated, metres."""

LIMIT_W = 3.29
"""A sound observation is beyond this once in a thousand times (Baarda 1968)."""


Stated = ResultDoc | LidarDoc
"""What states how certain a pose is: the result of a pair, or one LiDAR of a site."""


class ErrorParts(NamedTuple):
    """Predicted error at a range, metres, and its two parts; squared, they add up."""

    range_m: float
    together: float
    random: float
    systematic: float


def error_parts(
    stated: Sequence[ErrorAtRange] | None, parts: Uncertainty | None
) -> list[ErrorParts]:
    """Part the predicted error at each range; empty where its parts are not stated."""
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


def far_error(stated: Stated) -> float | None:
    """Predicted error of a point at `BUDGET_RANGE`, 1 σ, metres; None where none is stated."""
    errors = stated.predicted_error or []
    return next((each.sigma_m for each in errors if each.range_m == BUDGET_RANGE), None)


def worst_lidar(lidars: Sequence[LidarDoc]) -> LidarDoc | None:
    """Find the LiDAR with the largest predicted error; None where none is stated."""
    stated = [each for each in lidars if each.predicted_error]
    return max(stated, key=lambda each: far_error(each) or 0.0, default=None)


def largest_error(stated: Stated) -> str | None:
    """Name the largest source of error, and its share; None where no budget is stated."""
    if not stated.budget:
        return None
    entry = max(stated.budget, key=lambda each: each.share_at_30m)
    sigma = far_error(stated)
    whole = "" if sigma is None else f" of ± {error(sigma)}"
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


def group_words(site: SiteDoc) -> str:
    """Name the LiDARs of each group that nothing links to the others."""
    groups = (", ".join(site.lidars[k].name for k in group) for group in site.groups)
    return " | ".join(groups)


def ranked_tests(site: SiteDoc) -> tuple[list[TestDoc], list[TestDoc]]:
    """Give the tests that have a w, the largest first, and those of them that stand out."""
    tests = [each for each in site.tests if each.w is not None]
    tests.sort(key=lambda each: -abs(each.w or 0.0))
    return tests, [each for each in tests if abs(each.w or 0.0) > LIMIT_W]


def least_likely(site: SiteDoc) -> list[LoopDoc]:
    """Give the loops that have a probability, the least likely first."""
    loops = [each for each in site.loops if each.probability is not None]
    return sorted(loops, key=lambda each: each.probability or 0.0)


def around(site: SiteDoc, loop: LoopDoc) -> str:
    """Name the LiDARs around a loop, back to the first."""
    names = (site.lidars[k].name for k in (*loop.lidars, *loop.lidars[:1]))
    return " → ".join(names) or UNKNOWN


def probability(p: float | None) -> str:
    """Write a probability; what is very small as a bound."""
    if p is None:
        return UNKNOWN
    return "< 0.1 %" if p < 0.001 else f"{100 * p:.1f} %" if p < 0.1 else percent(p)
