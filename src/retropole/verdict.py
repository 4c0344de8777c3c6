"""Ok, warn or refused, and why: the rules that stand between an estimate and an answer."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .correspondence import widest_angle
from .datatypes import Hypothesis, Pole, Reason
from .errors import Refusal
from .refinement import Refinement

RIVAL_OVERLAP = 0.62
RIVAL_FREE_SPACE = 0.025
"""A hypothesis is a rival of the best where it has so much of its overlap, and where no more than
this share of the points beyond the best's own speaks against it. The score alone does not do: it
favours, by up to 0.2, whatever brings the LiDARs near each other, since near each other they see
the same things (see docs/hypotheses.md)."""

WARN_MARGIN = 0.1
"""Below this margin the answer stands, but a person should look at the hypotheses."""

MIN_OVERLAP = 0.25
"""Share of the points that must find a neighbour in the other cloud."""

WEAK_ANGLE = np.radians(15.0)
"""Poles nearer to parallel than this make a weak answer."""

MAX_PULL = 30.0
"""Squared Mahalanobis distance of the refined pose from the poles' own: χ² with 6 degrees of
freedom exceeds it once in 25,000 times."""

FEW_POINTS = 12
"""Returns on a pole below which its line is weak."""


def margin_of(hypotheses: Sequence[Hypothesis]) -> float | None:
    """Score of the first hypothesis over the next best; None where there is only one."""
    if len(hypotheses) < 2:
        return None
    return hypotheses[0].score - max(h.score for h in hypotheses[1:])


def check_choice(hypotheses: Sequence[Hypothesis]) -> None:
    """Refuse where the scene does not decide between the hypotheses, or denies them all.

    Raises
    ------
    Refusal
        ``no_overlap`` or ``ambiguous``.
    """
    best = hypotheses[0]
    if best.overlap < MIN_OVERLAP:
        raise Refusal(
            "no_overlap",
            f"under the best hypothesis only {best.overlap:.0%} of the points have a neighbour in "
            f"the other cloud, {MIN_OVERLAP:.0%} are needed: do both LiDARs see the same place, "
            "and the same two poles?",
            {"overlap": best.overlap, "needed": MIN_OVERLAP},
        )
    rivals = [h for h in hypotheses[1:] if _is_rival(h, best)]
    if rivals:
        rival = max(rivals, key=lambda h: h.score)
        raise Refusal(
            "ambiguous",
            f"the scene does not tell {1 + len(rivals)} hypotheses apart (overlap "
            f"{best.overlap:.2f} and {rival.overlap:.2f}, contradicted {best.free_space:.3f} and "
            f"{rival.free_space:.3f}): add a third pole, or move the poles, a car or a box so "
            "that the surroundings are not symmetric about the poles",
            {
                "rivals": len(rivals),
                "overlap": best.overlap,
                "rival_overlap": rival.overlap,
                "free_space": best.free_space,
                "rival_free_space": rival.free_space,
            },
        )


def _is_rival(hypothesis: Hypothesis, best: Hypothesis) -> bool:
    return (
        hypothesis.match.exact
        and hypothesis.overlap >= RIVAL_OVERLAP * best.overlap
        and hypothesis.free_space <= best.free_space + RIVAL_FREE_SPACE
    )


def weaknesses(
    target: Sequence[Pole], source: Sequence[Pole], hypotheses: Sequence[Hypothesis]
) -> list[Reason]:
    """Say what makes an answer weak that is good enough to give.

    Parameters
    ----------
    target, source
        The poles that the chosen hypothesis pairs, in the same order.
    hypotheses
        All hypotheses, the chosen one first.
    """
    reasons = []
    margin = margin_of(hypotheses)
    if margin is not None and margin < WARN_MARGIN:
        reasons.append(
            Reason(
                "small_margin",
                f"the chosen hypothesis leads by {margin:.3f} only (comfortable: {WARN_MARGIN:g}); "
                "look at the hypotheses in the report before you use the transform",
                {"margin": margin, "comfortable": WARN_MARGIN},
            )
        )
    angle = min(widest_angle(target), widest_angle(source))
    if angle < WEAK_ANGLE:
        degrees = float(np.degrees(angle))
        reasons.append(
            Reason(
                "nearly_parallel_poles",
                f"the poles are {degrees:.1f}° apart, which leaves height weak; lean one by 15° "
                "or more",
                {"angle_deg": degrees},
            )
        )
    for name, poles in (("target", target), ("source", source)):
        fewest = min(len(pole.xyz) for pole in poles)
        if fewest < FEW_POINTS:
            reasons.append(
                Reason(
                    "few_points",
                    f"a pole has {fewest} returns from the {name} LiDAR; move it nearer or record "
                    "more frames",
                    {"lidar": name, "points": fewest},
                )
            )
    return reasons


def check_pull(refined: Refinement | None) -> list[Reason]:
    """Warn where the scene draws the pose further away than the poles' uncertainty allows."""
    if refined is None or refined.pull <= MAX_PULL:
        return []
    return [
        Reason(
            "poles_and_scene_disagree",
            f"the scene draws the pose {1000 * refined.moved:.0f} mm and "
            f"{np.degrees(refined.turned):.2f}° away from the poles, "
            f"{np.sqrt(refined.pull / 6):.1f} times what their uncertainty allows: did "
            "something move between the two recordings, or is --radius wrong?",
            {"pull": refined.pull, "moved_m": refined.moved, "turned_rad": refined.turned},
        )
    ]
