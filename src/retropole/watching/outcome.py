"""What to do about an answer: stop, keep still for longer, or stand the poles elsewhere."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ..alignment.certainty import SWAY
from ..base.quantities import at_most, counted
from ..base.reasons import explain
from ..base.uncertainty import floor
from ..base.uncertainty.purpose import (
    USABLE,
    Need,
    displacement_bound,
    fitness,
)
from ..result import ResultDoc
from .advice import Advice, remedy_of

SPOILT = {"moving_pole", "moving_lidar", "no_match", "placements_disagree", "poor_fit"}
SPOILT |= {"poles_inconsistent", "poles_scene_contradict", "scene_contradicts"}
"""Refusals after which the newest placement is left out: with others it would spoil them too."""


ENOUGH = 0.99
"""Probability that the need is met, from which a watch stops. More than `purpose.CONFIDENCE`, by
which one answer is judged: a watch stops at the first of several that is good enough, and so rather
at one that is luckily so. By 0.95 the need was met in 48 of 50 stops (benchmarks/watch.py, good,
seeds 1000 to 1055)."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """An answer, and what follows from it.

    Attributes
    ----------
    document
        The answer.
    need
        How accurate it must be.
    probability, bound
        That it is; and what no point up to there is off by more than, with 95 % probability,
        metres. None where it was refused.
    """

    document: ResultDoc
    need: Need
    probability: float | None
    bound: float | None

    @property
    def is_enough(self) -> bool:
        """Whether to stop: the verdict is ok, and the need is met."""
        sure = self.probability is not None and self.probability >= ENOUGH
        return self.document.status == "ok" and sure

    @property
    def is_spoilt(self) -> bool:
        """Whether the newest placement is of no use to others."""
        codes = {reason.code for reason in self.document.reasons}
        return self.document.status == "refused" and bool(codes & SPOILT)

    @property
    def seconds_more(self) -> float:
        """How much longer to record, where masts sway and that is why the need is not met."""
        budget = self.document.budget or []
        if self.is_enough or not budget or budget[0].name != SWAY:
            return 0.0
        return max((each.sway.seconds_more for each in self.document.sways), default=0.0)


def outcome_of(document: ResultDoc, need: Need | None) -> Outcome:
    """Judge an answer by what it is needed for, or by what any answer is good for."""
    asked = need or USABLE
    if document.covariance is None:
        return Outcome(document, asked, None, None)
    # That of the document counts that the answer may be another pose altogether.
    fit = document.fitness or fitness(document.covariance, asked)
    return Outcome(document, asked, fit.probability, fit.bound_m)


def advice_after(outcome: Outcome, placements: int) -> Advice:
    """Say what to do next, after so many placements.

    Parameters
    ----------
    outcome
        Of all of them.
    placements
        How many were recorded.
    """
    document = outcome.document
    if outcome.is_enough:
        return Advice("done", f"Done: {_so_far(outcome)}.", True)
    if all(reason.code == "not_fit_for_purpose" for reason in document.reasons):
        least = displacement_bound(floor(), outcome.need.at)
        if least > outcome.need.within:
            return Advice(
                "need_too_small",
                f"No recording shows less than {at_most(least)}: end here, or ask for less with "
                f"--need-cm. {_so_far(outcome).capitalize()}.",
            )
        return Advice(
            "need_not_met",
            f"Placement {placements + 1}: stand the poles elsewhere, on another side. So far "
            f"{_so_far(outcome)}; needed is {outcome.need.words}, {100 * ENOUGH:g} % sure.",
        )
    reason = next(r for r in document.reasons if r.code != "not_fit_for_purpose")
    if reason.code == "radius_differs" and document.radius is not None:
        millimetres = 1e3 * document.radius.estimated
        return Advice(
            reason.code,
            f"The poles seem to have a radius of {millimetres:.0f} mm, not "
            f"{1e3 * document.config.radius_m:.0f}: measure one, and start again with --radius.",
        )
    explained = explain(reason.code)
    title = explained.title if explained else reason.message
    verdict = "Refused" if document.status == "refused" else "A warning"
    return Advice(reason.code, f"{verdict}: {title.lower()}. {remedy_of(reason.code)}".strip())


def _so_far(outcome: Outcome) -> str:
    at = f"up to {outcome.need.at:g} m away"
    if outcome.bound is None:
        return f"nothing {at} is sure"
    return f"no point {at} is off by more than {at_most(outcome.bound)}, 95 % sure"


def keep_still(captured: int, wanted: int, seconds: float) -> Advice:
    """Say that all is good, and how much is still to come."""
    left = f", {math.ceil(seconds)} s more" if seconds > 1 and captured >= wanted else ""
    return Advice(
        "good", f"Good: keep still, {captured} of {counted(wanted, 'sweep')}{left}.", True
    )
