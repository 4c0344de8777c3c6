"""Whether an answer is as accurate as required; if that is not shown, how to improve it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from ..adjustment.refinement import DISTORTION
from ..alignment.certainty import FLOOR
from ..base import quantities
from ..base.datatypes import Calibration
from ..base.errors import Reason
from ..base.reasons import remedy
from ..base.uncertainty import BUDGET_RANGE, floor, source_words
from ..base.uncertainty.purpose import (
    USABLE,
    Fitness,
    Need,
    displacement_bound,
    fitness,
    is_certainly_met,
)
from .map import MORE_OF_MAP

DOUBTS = (
    "not_confirmed",
    "without_poles",
    "not_converged",
    "small_margin",
    "chosen_by_hand",
    "several_minima",
)
"""Warnings that the pose may be another one, which its covariance does not include."""

MOST_OF_VARIANCE = 0.5
"""Sources of error are named, at most two, until they amount to this share of the variance."""


def judge(answer: Calibration, need: Need | None) -> Calibration:
    """Determine whether a pose is as accurate as required, and warn if that is not shown.

    Parameters
    ----------
    answer
        An answer, not a refusal.
    need
        The required accuracy. None requires `USABLE` of its covariance, and adds nothing if
        that is met.
    """
    assert answer.covariance is not None
    doubts: tuple[str, ...] = ()
    if need is None:
        if is_certainly_met(answer.covariance, USABLE):
            return answer
        fit = fitness(answer.covariance, USABLE)
    else:
        found = answer.confirmation
        wrong = None if found is None or found.trusted else found.probability_wrong
        codes = dict.fromkeys(reason.code for reason in answer.reasons)
        doubts = tuple(code for code in codes if code in DOUBTS)
        fit = fitness(answer.covariance, need, wrong=wrong or 0.0, doubts=doubts)
    why = _not_fit(fit, answer, is_asked=need is not None, is_doubted=bool(doubts))
    reasons = (*answer.reasons, *why)
    return replace(
        answer,
        status="warn" if reasons else "ok",
        reasons=reasons,
        fitness=None if need is None else fit,
    )


def _not_fit(
    fit: Fitness, answer: Calibration, *, is_asked: bool, is_doubted: bool
) -> Iterator[Reason]:
    """Report that an answer is not as accurate as required, and how to improve it."""
    if fit.answer == "yes":
        return
    said = [fit.words]
    values: dict[str, float | int | str] = {
        "within_m": fit.within_m,
        "at_m": fit.at_m,
        "probability": fit.probability,
    }
    if fit.bound_m is not None:
        values["bound_m"] = fit.bound_m
        said.append(f"95 % sure: within {quantities.at_most(fit.bound_m)}")
    said += _helping(fit, answer, is_doubted)
    if not is_asked:
        said.append("if less accuracy is enough, give it by --need-cm and --at-m")
    yield Reason("not_fit_for_purpose", "; ".join(said), values)


def _helping(fit: Fitness, answer: Calibration, is_doubted: bool) -> Iterator[str]:
    """State what would make an answer accurate enough, or that nothing would."""
    assert answer.covariance is not None
    if displacement_bound(answer.covariance, fit.at_m) <= fit.within_m:
        # The reasons for doubt have separate advice.
        if not is_doubted:
            more = "another pole, or a placement with the poles arranged differently"
            yield f"what would help: {MORE_OF_MAP if _is_in_map(answer) else more}"
        return
    least = displacement_bound(floor(), fit.at_m)
    if least > fit.within_m:
        yield f"no recording can show less than {quantities.at_most(least)}"
        return
    lead = "what would help"
    if answer.refined is None:
        yield f"{lead}: walls and ground that both LiDARs see, without --no-refine"
        lead = ""
    for sources, helps in _remedies(answer).items():
        yield f"{lead} against {sources}: {helps}".lstrip()
        lead = ""


def _is_in_map(answer: Calibration) -> bool:
    return answer.placements[0].target.cloud.is_map


def _remedies(answer: Calibration) -> dict[str, str]:
    """State how to reduce the largest sources of error, each with its share of the variance."""
    first = answer.placements[0]
    is_known = {
        "target": first.target.sensor is not None,
        "source": first.source.sensor is not None,
    }
    budget = () if answer.uncertainty is None else answer.uncertainty.budget
    helping: dict[str, list[str]] = {}
    share, unit = 0.0, f" of the variance at {BUDGET_RANGE:g} m"
    for entry in [each for each in budget if each.name != FLOOR][:2]:
        if share < MOST_OF_VARIANCE:
            part = quantities.percent(entry.share_at_30m) + unit
            unknown = None if entry.sensor is None or is_known[entry.sensor] else entry.sensor
            source = f"{source_words(entry.name, entry.sensor)} ({part})"
            helps = remedy(entry.name, unknown)
            if _is_in_map(answer) and entry.name != DISTORTION and entry.sensor is None:
                helps = MORE_OF_MAP
            helping.setdefault(helps, []).append(source)
            share, unit = share + entry.share_at_30m, ""
    return {" and ".join(sources): helps for helps, sources in helping.items()}
