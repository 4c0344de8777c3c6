"""Which hypotheses the scene does not rule out, which is selected, and the choice by hand.

The poles alone cannot decide. If the scene cannot either, a person who knows the site may:
by the letter of a hypothesis in the list.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from string import ascii_lowercase
from typing import Protocol

import numpy as np

from ..base import se3
from ..base.datatypes import Array, Calibration, Hypothesis, Placement
from ..base.errors import Reason, Refusal, UsageError
from ..surfaces.consistency import ground_normal
from ..surfaces.static import check_static
from .placements import (
    Choice,
    Chosen,
    PairedPlacement,
    PlacementHypotheses,
    find_recurring,
    rank_joint_hypotheses,
    uses_candidates,
)

RIVAL_OVERLAP, RIVAL_FREE_SPACE_VIOLATION = 0.62, 0.025
"""A hypothesis is a rival of the best if it has at least this part of its overlap, and if the
share of points that contradict it exceeds that of the best by at most this (see docs/method.md)."""

WARN_MARGIN = 0.1
"""Below this margin the answer is given, but a person should check the hypotheses."""

MIN_OVERLAP = 0.25
"""Share of the points that must find a neighbour in the other cloud."""

MIN_COVISIBLE_OVERLAP, LEAST_OVERLAP = 0.35, 0.15
"""The same for the points that both LiDARs could see: LiDARs of different range and field of
view share less than `MIN_OVERLAP`, but agree where their views coincide. Then `LEAST_OVERLAP` of
all points is enough. Right poses have 0.43 and more of the first; the best of recordings
from different places with the same poles has 0.30 (docs/method.md)."""

UNCONTRADICTED, MIN_UNCONTRADICTED_OVERLAP, MIN_UNCONTRADICTED_COVISIBLE = 25.0, 0.04, 0.2
"""LiDARs with limited fields of view share less still. The second of all points and the third of
the covisible ones are enough if the overlap is this many times the free-space violation: right
poses had 41 and more, wrong ones with as much of both 20 at most but for one of 441, which the
scene contradicts later (docs/method.md)."""

SAME_VERTICAL = np.radians(10.0)
"""The grounds seen by the two LiDARs are the same if their normals differ by less, rad: a
plane that is mistaken for the ground in one cloud is seldom mistaken in the other, too."""


def hypothesis_name(k: int) -> str:
    """Name the k-th hypothesis: a, b, c, … (Xue et al. 2019, Fig. 4)."""
    return ascii_lowercase[k : k + 1] or f"h{k}"


def is_hypothesis_name(text: object) -> bool:
    """Whether some hypothesis could have this name."""
    return isinstance(text, str) and re.fullmatch(r"[a-z]|h[1-9][0-9]{1,3}", text) is not None


def margin_of(hypotheses: Sequence[Hypothesis]) -> float | None:
    """Score of the first hypothesis minus that of the next best; None if there is only one."""
    if len(hypotheses) < 2:
        return None
    return hypotheses[0].score - max(h.score for h in hypotheses[1:])


def choose_best(scored: Sequence[PlacementHypotheses]) -> Chosen:
    """Select the hypothesis on which the scenes of all placements agree; a refusal is kept."""
    hypotheses: tuple[Hypothesis, ...] = scored[0].hypotheses
    choices: Sequence[Choice] = ()
    try:
        choices = find_recurring(scored)
        hypotheses = rank_joint_hypotheses(choices, scored)
        check_choice(hypotheses)
        check_paired(choices[0].paired)
    except Refusal as refusal:
        return Chosen(hypotheses, (), refusal, tuple(choices), scored=tuple(scored))
    return Chosen(hypotheses, choices[0].paired, None, tuple(choices), scored=tuple(scored))


def check_choice(hypotheses: Sequence[Hypothesis]) -> None:
    """Refuse if the scene does not decide between the hypotheses, or conflicts with them all.

    Raises
    ------
    Refusal
        ``no_overlap`` or ``ambiguous``.
    """
    best = hypotheses[0]
    check_overlap(best)
    rivals = [h for h in hypotheses[1:] if _is_rival(h, best)]
    if rivals:
        raise ambiguous(best, rivals)


class Scored(Protocol):
    """Scores of a hypothesis from the scene."""

    @property
    def overlap(self) -> float:
        """Share of the points that have a neighbour in the other cloud."""

    @property
    def free_space_violation(self) -> float:
        """Share of the points in space that the other LiDAR saw to be empty."""

    @property
    def score(self) -> float:
        """Overlap minus free-space violation."""


NOT_SYMMETRIC = (
    "add another pole that leans by another angle, or move the poles, a car or a box so that the "
    "surroundings are not symmetric about the poles"
)
"""Advice on how to distinguish hypotheses."""


def ambiguous(best: Scored, rivals: Sequence[Scored], advice: str = NOT_SYMMETRIC) -> Refusal:
    """Give the refusal if the scene does not distinguish some hypotheses from the best."""
    rival = max(rivals, key=lambda h: h.score)
    return Refusal(
        "ambiguous",
        f"the scene does not distinguish {1 + len(rivals)} hypotheses (overlap "
        f"{best.overlap:.2f} and {rival.overlap:.2f}, free space violated by "
        f"{best.free_space_violation:.3f} and {rival.free_space_violation:.3f}): {advice}",
        {
            "rivals": len(rivals),
            "overlap": best.overlap,
            "rival_overlap": rival.overlap,
            "free_space": best.free_space_violation,
            "rival_free_space": rival.free_space_violation,
        },
    )


def is_not_ruled_out(
    agreeing: float, conflicting: float, best_agreeing: float, best_conflicting: float
) -> bool:
    """Whether the surroundings do not rule out a pose in comparison with the best one.

    The score alone is not sufficient: it favours, by up to 0.2, poses that bring the LiDARs near
    each other, since LiDARs near each other see the same objects.

    Parameters
    ----------
    agreeing, best_agreeing
        Amount of the surroundings that agrees with either pose: a share or a count.
    conflicting, best_conflicting
        Shares of the surroundings that conflict with them.
    """
    return (
        agreeing >= RIVAL_OVERLAP * best_agreeing
        and conflicting <= best_conflicting + RIVAL_FREE_SPACE_VIOLATION
    )


def is_as_possible(each: Scored, best: Scored) -> bool:
    """Whether `is_not_ruled_out` is true by the overlap and the free space of two poses."""
    return is_not_ruled_out(
        each.overlap, each.free_space_violation, best.overlap, best.free_space_violation
    )


def _is_rival(hypothesis: Hypothesis, best: Hypothesis) -> bool:
    return hypothesis.match.exact and is_as_possible(hypothesis, best)


def check_overlap(
    hypothesis: Hypothesis,
    name: str = "the best hypothesis",
    question: str = "do both LiDARs see the same place, and the same two poles?",
) -> None:
    """Refuse a hypothesis under which the two clouds do not show the same place.

    Raises
    ------
    Refusal
        ``no_overlap``.
    """
    overlap, covisible = hypothesis.overlap, hypothesis.covisible_overlap or 0.0
    is_uncontradicted = overlap >= UNCONTRADICTED * hypothesis.free_space_violation
    if (
        overlap >= MIN_OVERLAP
        or (overlap >= LEAST_OVERLAP and covisible >= MIN_COVISIBLE_OVERLAP)
        or (
            is_uncontradicted
            and overlap >= MIN_UNCONTRADICTED_OVERLAP
            and covisible >= MIN_UNCONTRADICTED_COVISIBLE
        )
    ):
        return
    raise Refusal(
        "no_overlap",
        f"under {name} only {overlap:.0%} of the points have a neighbour in "
        f"the other cloud, and {covisible:.0%} of those that both LiDARs could see; "
        f"{MIN_OVERLAP:.0%}, or {LEAST_OVERLAP:.0%} and {MIN_COVISIBLE_OVERLAP:.0%}, are "
        f"needed: {question}",
        {"overlap": overlap, "covisible": covisible, "needed": MIN_OVERLAP},
    )


def check_paired(paired: Sequence[PairedPlacement]) -> None:
    """Refuse poles that moved while they were recorded, of those that a choice pairs.

    Raises
    ------
    Refusal
        ``moving_pole``.
    """
    for each in paired:
        check_static("target", each.placement.target.cloud, each.target_poles)
        check_static("source", each.placement.source.cloud, each.source_poles)


def not_rejected(hypotheses: Sequence[Hypothesis]) -> list[bool]:
    """For each hypothesis, the best first: whether the scene does not rule it out.

    Not ruled out are the best, its rivals, and those that fit exactly and score nearly as well.
    """
    return [
        k == 0
        or _is_rival(each, hypotheses[0])
        or (each.match.exact and hypotheses[0].score - each.score < WARN_MARGIN)
        for k, each in enumerate(hypotheses)
    ]


def take_by_hand(chosen: Chosen, name: str | None) -> Chosen:
    """Select the hypothesis given by a person instead of the best one.

    The letter is that of the list given by the same run without a letter. It lifts
    only the refusal ``ambiguous``, which is the question that it answers.

    Parameters
    ----------
    chosen
        The choice by poles and scene.
    name
        As `hypothesis_name` gives it; None leaves the choice as it is.

    Returns
    -------
    Chosen
        The given hypothesis first; with a refusal if it cannot be right.

    Raises
    ------
    UsageError
        If no hypothesis that fits the poles has this name.
    """
    if name is None or (chosen.refusal is not None and chosen.refusal.code != "ambiguous"):
        return chosen
    # Candidate poles are used for the one hypothesis that the scene confirms, and for no other.
    doubtful = any(uses_candidates(each.placement) for each in chosen.paired)
    names = [hypothesis_name(k) for k in range(1 if doubtful else len(chosen.choices))]
    if name not in names:
        raise UsageError(
            f"no hypothesis {name!r} (--hypothesis) fits the poles of these recordings; those that "
            f"fit are {', '.join(names)}"
        )
    k = names.index(name)
    choice = chosen.choices[k]
    try:
        check_overlap(
            choice.joint,
            f"hypothesis {name}",
            "the scene conflicts with the hypothesis given by --hypothesis",
        )
        check_paired(choice.paired)
    except Refusal as refusal:
        return replace(chosen, paired=(), refusal=refusal)
    others = (*chosen.hypotheses[:k], *chosen.hypotheses[k + 1 :])
    return replace(
        chosen, hypotheses=(choice.joint, *others), paired=choice.paired, refusal=None, place=k
    )


def list_hypotheses(answer: Calibration, chosen: Chosen, by_hand: str | None) -> Calibration:
    """List the hypotheses with their names, and report an answer that was chosen by hand.

    Parameters
    ----------
    answer
        Its hypotheses begin with the selected one.
    chosen
        From `take_by_hand`.
    by_hand
        The name of the hypothesis, if a person chose it.
    """
    if answer.hypotheses:
        first, *others = answer.hypotheses
        listed = (*others[: chosen.place], first, *others[chosen.place :])
        stand = not_rejected(listed)
        listed = tuple(replace(h, stands=s) for h, s in zip(listed, stand, strict=True))
        answer = replace(answer, hypotheses=listed, chosen=chosen.place)
        if sum(stand) > 1:
            vertical = vertical_of(answer.placements[0], first.match.T_target_source)
            answer = replace(answer, vertical=vertical)
    if by_hand is None or answer.status == "refused":
        return answer
    kept = (reason for reason in answer.reasons if reason.code != "small_margin")
    return replace(answer, status="warn", reasons=(_by_hand(answer, by_hand), *kept))


def vertical_of(placement: Placement, T: Array) -> Array | None:
    """Find the vertical (3,) in the target's frame: the normal of the ground that both LiDARs see.

    None if their grounds do not coincide under the pose ``T``, (4, 4).
    """
    rng = np.random.default_rng(0)
    target, source = (
        ground_normal(scan.cloud, rng) for scan in (placement.target, placement.source)
    )
    if abs(target @ T[:3, :3] @ source) < np.cos(SAME_VERTICAL):
        return None
    return target if target @ placement.target.cloud.axis >= 0 else -target


def _by_hand(answer: Calibration, name: str) -> Reason:
    """Report which hypothesis a person chose, with its scores and those of the best other."""
    own = answer.hypotheses[answer.chosen]
    roll, pitch, yaw = np.degrees(se3.rpy_from_rotation(own.match.T_target_source[:3, :3]))
    message = (
        f"hypothesis {name} (roll {roll:.0f}°, pitch {pitch:.0f}°, yaw {yaw:.0f}°) was chosen by "
        f"hand: overlap {own.overlap:.2f}, free space violated by {own.free_space_violation:.3f}"
    )
    values: dict[str, float | int | str] = {"hypothesis": name, "overlap": own.overlap}
    values["free_space"] = own.free_space_violation
    others = [(k, h) for k, h in enumerate(answer.hypotheses) if k != answer.chosen]
    if others:
        k, other = max(others, key=lambda each: each[1].score)
        message += (
            f"; the best other is {hypothesis_name(k)} with {other.overlap:.2f} and "
            f"{other.free_space_violation:.3f}"
        )
        values |= {"other_overlap": other.overlap, "other_free_space": other.free_space_violation}
    return Reason("chosen_by_hand", message, values)
