"""How certain an answer is, as the result document holds it, and back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Literal

import msgspec
import numpy as np

from ..base.datatypes import Array
from ..base.uncertainty import BudgetEntry, Confirmation, RadiusEstimate, Uncertainty, WeakDirection
from ..base.uncertainty.purpose import Fitness, Need
from .bounded import Count, Covariance, Number, Share, Size, Text, Vector

Matrix = list[list[float]]


class ErrorAtRange(msgspec.Struct, frozen=True):
    """Predicted error of a point at a range, 1 sigma."""

    range_m: Size
    sigma_m: Size


class WeakestDoc(msgspec.Struct, frozen=True):
    """The direction in which the pose is least certain, at the poles, target axes."""

    direction: Vector
    sigma_m: Size
    words: Text
    condition: Size


class UncertaintyDoc(msgspec.Struct, frozen=True):
    """The two parts of the covariance, in its order and frame; it is their sum."""

    random: Covariance
    systematic: Covariance


class BudgetEntryDoc(msgspec.Struct, frozen=True):
    """One source of error; `sigma` and `estimated` are in `unit`."""

    name: Text
    sensor: Literal["target", "source"] | None
    sigma: Size
    unit: Literal["m", "rad", "1"]
    estimated: Number | None
    share_at_30m: Share


class RadiusDoc(msgspec.Struct, frozen=True):
    """Radius of the poles as given and as the data have it, each with its 1 sigma."""

    given_m: Size
    given_sigma_m: Size
    estimated_m: Size
    sigma_m: Size


class ConfirmationDoc(msgspec.Struct, frozen=True, kw_only=True):
    """What stands in the scene says of the pose: the fields of `Confirmation`, and the share."""

    agreeing: Count
    contradicting: Count
    contradicted: Share
    missing: Count = 0
    better_at: Size | None = msgspec.field(default=None, name="better_at_m")
    lead: Number | None = None
    vouched: bool = False
    trusted: bool = False
    probability_wrong: Share | None = None


class FitnessDoc(msgspec.Struct, frozen=True):
    """Whether the pose is as accurate as was asked for: no point up to `at_m` off by `within_m`.

    `bound_m` is what it is accurate to with a probability of 95 %, null where nothing is; `words`
    say it all.
    """

    within_m: Size
    at_m: Size
    answer: Literal["yes", "no", "not shown"]
    probability: Share
    bound_m: Size | None
    words: Text


def matrix_rows(value: Array) -> Matrix:
    """Write a matrix row by row."""
    return [[float(v) for v in row] for row in value]


def weakest_document(weakest: WeakDirection | None) -> WeakestDoc | None:
    """Write the weakest direction; None where there is none."""
    if weakest is None:
        return None
    return WeakestDoc(weakest.direction.tolist(), weakest.sigma, weakest.words, weakest.condition)


def uncertainty_document(uncertainty: Uncertainty | None) -> UncertaintyDoc | None:
    """Write both parts of the covariance; None where they are not known."""
    if uncertainty is None:
        return None
    return UncertaintyDoc(matrix_rows(uncertainty.random), matrix_rows(uncertainty.systematic))


def budget_document(uncertainty: Uncertainty | None) -> list[BudgetEntryDoc] | None:
    """Write every source of error, the largest first; None where they are not known."""
    if uncertainty is None:
        return None
    return budget_entries(uncertainty.budget)


def budget_entries(budget: Sequence[BudgetEntry]) -> list[BudgetEntryDoc]:
    """Write sources of error, the largest first."""
    return [
        BudgetEntryDoc(
            entry.name,
            entry.sensor,
            float(entry.sigma),
            entry.unit,
            None if entry.estimated is None else float(entry.estimated),
            float(entry.share_at_30m),
        )
        for entry in sorted(budget, key=lambda entry: -entry.share_at_30m)
    ]


def radius_document(radius: RadiusEstimate | None) -> RadiusDoc | None:
    """Write the radius as given and as estimated; None where it was not estimated."""
    if radius is None:
        return None
    return RadiusDoc(radius.given, radius.given_sigma, radius.estimated, radius.sigma)


def confirmation_document(confirmation: Confirmation | None) -> ConfirmationDoc | None:
    """Write what stands in the scene says; None where it was not asked."""
    if confirmation is None:
        return None
    return ConfirmationDoc(
        contradicted=confirmation.denied,
        probability_wrong=confirmation.probability_wrong,
        **asdict(confirmation),
    )


def fitness_document(fitness: Fitness | None) -> FitnessDoc | None:
    """Write whether the pose is as accurate as was asked for; None where nothing was."""
    if fitness is None:
        return None
    need = fitness.need
    return FitnessDoc(
        need.within, need.at, fitness.answer, fitness.probability, fitness.bound, fitness.words
    )


def uncertainty_of(
    document: UncertaintyDoc | None, budget: Sequence[BudgetEntryDoc] | None
) -> Uncertainty | None:
    """Read back what `uncertainty_document` and `budget_document` wrote."""
    if document is None:
        return None
    return Uncertainty(
        np.array(document.random, dtype=float),
        np.array(document.systematic, dtype=float),
        budget_of(budget),
    )


def budget_of(document: Sequence[BudgetEntryDoc] | None) -> tuple[BudgetEntry, ...]:
    """Read back what `budget_entries` wrote; empty where there is none."""
    return tuple(BudgetEntry(**msgspec.structs.asdict(entry)) for entry in document or ())


def fitness_of(document: FitnessDoc | None) -> Fitness | None:
    """Read back what `fitness_document` wrote, but for the doubts, which its words name."""
    if document is None:
        return None
    return Fitness(Need(document.within_m, document.at_m), document.probability, document.bound_m)


def radius_of(document: RadiusDoc | None) -> RadiusEstimate | None:
    """Read back what `radius_document` wrote."""
    if document is None:
        return None
    return RadiusEstimate(
        document.given_m, document.given_sigma_m, document.estimated_m, document.sigma_m
    )


def confirmation_of(document: ConfirmationDoc | None) -> Confirmation | None:
    """Read back what `confirmation_document` wrote."""
    if document is None:
        return None
    fields = msgspec.structs.asdict(document)
    for follows in ("contradicted", "probability_wrong"):
        del fields[follows]
    return Confirmation(**fields)
