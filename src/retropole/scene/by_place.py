"""Poles that leave a part of the pose open, and the place that gives it: chosen, or refused.

One pole that both LiDARs see, or parallel ones, are laid on each other in all ways in which the
place lies on itself (`one_pole`). What stands off the ground chooses, rules the others out, and
must confirm the pose; surfaces must hold it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..alignment.adjustment import PLACE_SIGMA
from ..base.datatypes import Array, Hypothesis, Placement
from ..base.errors import Refusal
from ..base.uncertainty.confirmation import Confirmation
from ..matching.placements import (
    Chosen,
    PairedPlacement,
    PlacementHypotheses,
    find_recurring,
    is_by_place,
    rank_joint_hypotheses,
)
from ..matching.prior import RotationPrior, agreeing_with_prior
from .choice import RIVAL_FREE_SPACE_VIOLATION, RIVAL_OVERLAP, ambiguous
from .confirmation import MAX_WRONG, MIN_TOTAL, lifts, scenes_of
from .confirmation import count as agreement
from .consistency import Standing
from .disambiguation import score_hypotheses
from .one_pole import matches_about
from .refinement import Refinement

HELD = 0.25
"""The scene holds a pose where no direction of it has a larger part of the 1 σ that the place was
taken to give before (`alignment.adjustment.PLACE_SIGMA`): 0.5° and 5 cm. With twice that, an answer
between two rows of posts was off by 1.2° under ok, as its 1 σ allowed."""

LEAN_ANOTHER = "lean a second pole by 15° or more against the first where both LiDARs see it"
"""What to do where the place does not tell."""


def choose_by_place(
    placements: Sequence[Placement],
    radius: float,
    *,
    count: int | None = None,
    prior: RotationPrior | None = None,
) -> Chosen | None:
    """Lay one pole on one pole in every placement, and let the place give the rest of the pose.

    What stands off the ground chooses, not the overlap of all: the ground lies on itself at any
    angle, and best where it brings the LiDARs near each other.

    Parameters
    ----------
    placements
        With the poles of both LiDARs, the best supported first.
    radius
        Of the poles, metres.
    count, prior
        How many poles both LiDARs see, and what is known of the rotation.

    Returns
    -------
    Chosen or None
        None where nothing lies on each other so.
    """
    # The same recordings give the same answer.
    scenes = scenes_of(placements, np.random.default_rng(0))
    try:
        scored = []
        for placement, standing in zip(placements, scenes, strict=True):
            found = agreeing_with_prior(matches_about(placement, standing, radius), prior)
            own = [match for match in found if count in (None, len(match.pairs))]
            if not any(match.exact for match in own):
                return None
            clouds = placement.target.cloud, placement.source.cloud
            scored.append(PlacementHypotheses(placement, score_hypotheses(*clouds, own)))
        choices = find_recurring(scored)
    except Refusal:
        return None
    told = [agreement(scenes, choice.joint.match.T_target_source) for choice in choices]
    order = np.argsort([each.conflicting - each.agreeing for each in told], kind="stable")
    choices = [choices[k] for k in order]
    hypotheses = rank_joint_hypotheses(choices, scored)
    rivals = _rivals(scenes, hypotheses)
    refusal = ambiguous(hypotheses[0], rivals) if rivals else None
    paired = () if rivals else choices[0].paired
    return Chosen(hypotheses, paired, refusal, tuple(choices), scored=tuple(scored))


def _rivals(
    scenes: Sequence[tuple[Standing, Standing]], hypotheses: Sequence[Hypothesis]
) -> list[Hypothesis]:
    """Find the hypotheses that what stands off the ground does not rule out beside the first.

    That more agrees with one rules out no other: near each other LiDARs see the same things. The
    rule is that of `choice.check_choice`, of patches off the ground.
    """
    best, *others = hypotheses
    T = best.match.T_target_source
    own, lifted = agreement(scenes, T), lifts(scenes, T)
    found = []
    for other in others:
        told = agreement(scenes, other.match.T_target_source)
        stands = told.agreeing >= RIVAL_OVERLAP * own.agreeing
        stands &= told.contradicted <= own.contradicted + RIVAL_FREE_SPACE_VIOLATION
        if stands and (lifted or not lifts(scenes, other.match.T_target_source)):
            found.append(other)
    return found


def check_told(paired: Sequence[PairedPlacement], found: Confirmation) -> None:
    """Refuse a pose of which the place gives a part and does not confirm it.

    Raises
    ------
    Refusal
        ``too_few_poles``.
    """
    if not is_by_place(paired):
        return
    wrong = 1.0 if found.probability_wrong is None else found.probability_wrong
    if found.total >= MIN_TOTAL and wrong <= MAX_WRONG:
        return
    lead = found.z_margin or 0.0
    raise Refusal(
        "too_few_poles",
        "both LiDARs see one pole only, or parallel ones, and the place around does not tell the "
        f"rest of the pose: off the ground {found.counts}, and the pose leads others by {lead:.1f} "
        f"σ (chance of a wrong pose {found.chance_words}; {MIN_TOTAL} patches and "
        f"{100 * MAX_WRONG:.0f} % are needed); {LEAN_ANOTHER}",
        {
            "poles": max(len(each.target_poles) for each in paired),
            "needed": 2,
            "agreeing": found.agreeing,
            "contradicting": found.contradicting,
            "missing": found.missing,
            "lead": lead,
            "probability_wrong": wrong,
        },
    )


def check_held(paired: Sequence[PairedPlacement], refined: Refinement | None) -> None:
    """Refuse a pose that the poles leave open, and the scene as well.

    Raises
    ------
    Refusal
        ``degenerate_poles``.
    """
    if not is_by_place(paired):
        return
    if refined is None:
        raise Refusal(
            "degenerate_poles",
            f"one pole leaves a turn about it and a slide along it open, and too few surfaces that "
            f"both LiDARs see tell them; {LEAN_ANOTHER}",
            {"poles": 1},
        )
    assert refined.pose.covariance is not None
    check_held_by_scene(refined.pose.covariance)


def is_held(covariance: Array) -> bool:
    """Whether a pose (6, 6) is known far better than the place was taken to give it."""
    by_place = covariance / np.outer(PLACE_SIGMA, PLACE_SIGMA)
    return float(np.linalg.eigvalsh(by_place)[-1]) <= HELD**2


def check_held_by_scene(covariance: Array, lidars: str = "both LiDARs") -> None:
    """Refuse a pose that the scene holds little better than the place was taken to give it.

    Parameters
    ----------
    covariance
        (6, 6) of the pose of one LiDAR in the frame of the other, over ``[φ, δ]``, rad and m.
    lidars
        What they are called.

    Raises
    ------
    Refusal
        ``degenerate_poles``.
    """
    if is_held(covariance):
        return
    rotation, translation = (
        float(np.sqrt(np.linalg.eigvalsh(covariance[part, part])[-1]))
        for part in (slice(3), slice(3, 6))
    )
    raise Refusal(
        "degenerate_poles",
        "one pole leaves a turn about it and a slide along it open, and the surfaces that "
        f"{lidars} see hold the pose to {np.degrees(rotation):.2f}° and {translation:.2f} m only "
        f"(1 σ); {LEAN_ANOTHER}",
        {"rotation_sigma_rad": rotation, "translation_sigma_m": translation},
    )
