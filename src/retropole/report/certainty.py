"""How certain an answer is, in words that the terminal, the page and Python share."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from ..adjustment.blunders import POOR, is_poor
from ..base.quantities import UNKNOWN, counted, error, percent, value, value_and_error
from ..base.uncertainty import ErrorAtRange, Uncertainty, predicted_error, source_words
from ..result import ResultDoc
from ..result.site import LidarDoc, LoopDoc, SiteDoc, TestDoc
from .subject import Subject

BUDGET_RANGE = 30.0
"""Range at which the shares of the budget are stated, metres."""

UNCHECKED = 0.01
"""Less redundancy than this is none: nothing would show an error there."""

NAMED = 3
"""So many observations that stand out are named; the page lists them all."""


Stated = ResultDoc | LidarDoc
"""What states how certain a pose is: the result of a pair, or one LiDAR of a site."""


def number(value: float | None, digits: int, scale: float = 1.0, unit: str = "") -> str:
    """Write a number with fixed digits, without a negative zero; a dash where there is none."""
    if value is None or not math.isfinite(value):
        return UNKNOWN
    return f"{round(float(value) * scale, digits) + 0.0:.{digits}f}{unit}"


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
    """Name the main source of error, and its share of the variance; None without a budget."""
    if not stated.budget:
        return None
    entry = max(stated.budget, key=lambda each: each.share_at_30m)
    return f"{source_words(entry.name, entry.sensor)} ({percent(entry.share_at_30m)})"


def radius_words(result: ResultDoc) -> str | None:
    """Say the radius as given and as estimated; None where it was not estimated."""
    radius = result.radius
    if radius is None:
        return None
    given = value(radius.given, radius.sigma)
    return f"{given} given, {value_and_error(radius.estimated, radius.sigma)} estimated"


def scene_words(result: ResultDoc) -> str | None:
    """Say how many patches agree or contradict the pose; None where the scene was not asked."""
    return None if result.confirmation is None else result.confirmation.words


def statements(subject: Subject, *, verbose: bool = False) -> Iterator[str]:
    """Say how certain an answer is and what checked it, a sentence each.

    Parameters
    ----------
    subject
        The answer, or the refusal.
    verbose
        Whether the kinds of error and the radius are told as well.
    """
    site, pair = subject.site, subject.pair
    if subject.answered and pair is None:
        yield f"frame: {site.frame.name}; datum: {site.datum}"
    worst = worst_lidar(site.lidars)
    if worst is not None:
        errors = worst.predicted_error or []
        at = ", ".join(f"± {error(each.sigma_m)} at {each.range_m:g} m" for each in errors)
        yield f"predicted error, 1 sigma{'' if pair else f', {worst.name} being the worst'}: {at}"
        parts = error_parts(errors, pair.uncertainty if pair and verbose else None)
        for each in parts:
            if each.range_m == BUDGET_RANGE:
                kinds = f"random ± {error(each.random)}, systematic ± {error(each.systematic)}"
                yield f"at {BUDGET_RANGE:g} m: {kinds}"
        largest = largest_error(worst)
        if largest is not None:
            yield f"main error source at {BUDGET_RANGE:g} m: {largest}"
    if site.sways:
        found = max(site.sways, key=lambda each: each.sway.left_rad)
        yield f"swayed while recorded: {subject.called(found.lidar)} {found.sway.words}"
    if pair is not None:
        yield from _of_pair(pair, verbose)
    else:
        yield from _of_site(site, subject.answered)
    moved = [each for each in site.without if each.translation is not None]
    if moved:
        most = max(moved, key=lambda each: each.translation or 0.0)
        whose = "" if most.lidar is None else f"{subject.called(most.lidar)}, "
        change = f"{error(most.translation)} and {error(most.rotation, 'rad')}"
        without = f"({whose}without placement {subject.placement(most.placement)})"
        yield f"leaving out one placement: the pose changes by at most {change} {without}"


def _of_pair(pair: ResultDoc, verbose: bool) -> Iterator[str]:
    """Say what only a pair states: its weakest direction, the radius, what the scene says."""
    if pair.weakest is not None:
        yield f"weakest direction, 1 sigma: {pair.weakest.words}"
    radius, scene = radius_words(pair), scene_words(pair)
    if verbose and radius is not None:
        yield f"radius of the poles: {radius}"
    if scene is not None:
        yield f"scene check: {scene}"


def _of_site(site: SiteDoc, answered: bool) -> Iterator[str]:
    """Say what pairs, loops and tests showed, or which LiDARs nothing links."""
    if len(site.groups) > 1:
        groups = (", ".join(site.lidars[k].name for k in group) for group in site.groups)
        yield f"not linked with each other: {' | '.join(groups)}"
    if answered:
        yield from checks_of_site(site)


def checks_of_site(site: SiteDoc) -> Iterator[str]:
    """Say what pairs, loops and consistency checks of an answer showed."""
    standing = [min(pair.standing, 2) for pair in site.pairs]
    counts = (
        (standing.count(1), "unambiguous"),
        (standing.count(2), "ambiguous and decided by others"),
        (standing.count(0), "linked through others"),
    )
    if standing:
        yield f"pairs: {', '.join(f'{n} {what}' for n, what in counts if n)}"
    loops = [loop for loop in site.loops if loop.probability is not None]
    if loops:
        worst = min(loops, key=lambda loop: loop.probability or 0.0)
        which = f"{len(loops)} loops; the worst," if loops[1:] else "loop"
        misses = f"{error(worst.translation)} and {error(worst.rotation, 'rad')}"
        by_chance = f"by chance: {probability(worst.probability)}"
        yield f"{which} {around(site, worst)}: misses by {misses} ({by_chance})"
    elif len(site.lidars) > 2:
        yield "no closed loop: no third LiDAR checks a pair"
    tests = ranked_tests(site)
    if not tests:
        yield "no consistency checks: nothing verifies these poses"
        return
    high = [each for each in tests if is_poor(abs(each.w or 0.0), each.chi2 or 0.0, each.freedom)]
    checks, most = counted(len(tests), "consistency check"), f"{POOR:g} is the most to expect"
    named = [f"{each.name} (w {abs(each.w or 0.0):.1f})" for each in (high or tests)[:NAMED]]
    if high:
        rest = f" and {len(high) - NAMED} more" if len(high) > NAMED else ""
        yield f"{checks}, {len(high)} suspicious: {', '.join(named)}{rest}; {most}"
    else:
        yield f"{checks}, none suspicious; the largest: {named[0]}, {most}"
    blind = unchecked(site)
    if blind:
        yield f"{counted(blind, 'observation')} without a check: an error there would not show"


def fitness_words(subject: Subject) -> str:
    """Answer whether every pose is as accurate as was asked for; empty where nothing was."""
    asked = [(each.name, each.fitness) for each in subject.site.lidars if each.fitness]
    if not asked:
        return ""
    first = asked[0][1]
    if subject.pair is not None:
        return first.words
    short = [
        f"{name}: {fitness.words.partition(': ')[2] or fitness.words}"
        for name, fitness in asked
        if fitness.answer != "yes"
    ]
    need = f"within {100 * first.within_m:g} cm at {first.at_m:g} m"
    return f"{need}: {'not every LiDAR; ' + '; '.join(short) if short else 'yes, every LiDAR'}"


def ranked_tests(site: SiteDoc) -> list[TestDoc]:
    """Give the tests that have a w, the largest first."""
    tests = [each for each in site.tests if each.w is not None]
    return sorted(tests, key=lambda each: -abs(each.w or 0.0))


def unchecked(site: SiteDoc) -> int:
    """Count the tests that would not show an error."""
    return sum(each.redundancy is not None and each.redundancy < UNCHECKED for each in site.tests)


def around(site: SiteDoc, loop: LoopDoc) -> str:
    """Name the LiDARs around a loop, back to the first."""
    names = (site.lidars[k].name for k in (*loop.lidars, *loop.lidars[:1]))
    return " → ".join(names) or UNKNOWN


def probability(p: float | None) -> str:
    """Write a probability; what is very small as a bound."""
    if p is None:
        return UNKNOWN
    return "< 0.1 %" if p < 0.001 else f"{100 * p:.1f} %" if p < 0.1 else percent(p)
