"""Ok, warn or refused, and why: the rules that stand between an estimate and an answer."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.special import chdtri

from .alignment.adjustment import RADIUS_DENIED, BeamAlignment
from .datatypes import Hypothesis, Pole, Reason, Scan
from .errors import Refusal
from .matching.confirmation import doubtful_reasons
from .matching.correspondence import widest_angle
from .matching.placements import PairedPlacement
from .quantities import error, value, value_and_error
from .scene.refinement import Refinement
from .uncertainty import WeakDirection

RIVAL_OVERLAP = 0.62
RIVAL_FREE_SPACE_VIOLATION = 0.025
"""A hypothesis is a rival of the best where it has so much of its overlap, and where no more than
this share of the points beyond the best's own speaks against it. The score alone does not do: it
favours, by up to 0.2, whatever brings the LiDARs near each other, since near each other they see
the same things (see docs/hypotheses.md)."""

WARN_MARGIN = 0.1
"""Below this margin the answer stands, but a person should look at the hypotheses."""

MIN_OVERLAP = 0.25
"""Share of the points that must find a neighbour in the other cloud."""

MIN_COVISIBLE_OVERLAP, LEAST_OVERLAP = 0.35, 0.15
"""The same of the points that both LiDARs could see: LiDARs of different reach and field of view
share less than `MIN_OVERLAP`, but agree where they look at the same. Then all the points need no
more than `LEAST_OVERLAP`. Right poses have 0.43 and more of the first, of recordings from
different places with the same poles the best has 0.30 (docs/hypotheses.md)."""

WEAK_ANGLE = np.radians(15.0)
"""Poles nearer to parallel than this make a weak answer."""

WARN_MAHALANOBIS_SQ, MAX_MAHALANOBIS_SQ = 22.5, 100.0
"""Squared Mahalanobis distance of the refined pose from the poles' own above which it is said, and
above which the answer is refused. χ² with 6 degrees of freedom exceeds the first once in a thousand
times. In 56 simulated recordings between which a pole was moved by 3 to 15 cm, the refined pose was
off by more than 0.1 m or 1° only beyond the second, or where the poles were found inconsistent."""

AXES_CHANCE = 1e-3
"""How often poles that stood still may be taken for inconsistent."""

FEW_POINTS = 12
"""Returns on a pole below which its line is weak."""

FEW_RINGS = 3
"""Rings on a pole up to which its direction is weak."""

NOISE_RATIO, ANY_NOISE = 3.0, 0.03
"""Returns on poles scatter no more than this many times the noise that the manufacturer states,
or, of a sensor not known, than this, metres."""

WEAK_SIGMA = 0.05
"""1 σ of the poles' place above which a direction is called weak, metres."""

OFFSET_SHARE = 2.0
"""By this factor a range offset or the radius, were they known, would sharpen the pose, before it
is said that they are what limits it."""


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
    covisible = best.covisible_overlap or 0.0
    if best.overlap < MIN_OVERLAP and (
        best.overlap < LEAST_OVERLAP or covisible < MIN_COVISIBLE_OVERLAP
    ):
        raise Refusal(
            "no_overlap",
            f"under the best hypothesis only {best.overlap:.0%} of the points have a neighbour in "
            f"the other cloud, and {covisible:.0%} of those that both LiDARs could see; "
            f"{MIN_OVERLAP:.0%}, or {LEAST_OVERLAP:.0%} and {MIN_COVISIBLE_OVERLAP:.0%}, are "
            "needed: do both LiDARs see the same place, and the same two poles?",
            {"overlap": best.overlap, "covisible": covisible, "needed": MIN_OVERLAP},
        )
    rivals = [h for h in hypotheses[1:] if _is_rival(h, best)]
    if rivals:
        rival = max(rivals, key=lambda h: h.score)
        raise Refusal(
            "ambiguous",
            f"the scene does not tell {1 + len(rivals)} hypotheses apart (overlap "
            f"{best.overlap:.2f} and {rival.overlap:.2f}, free space violated by "
            f"{best.free_space_violation:.3f} and {rival.free_space_violation:.3f}): add a third "
            "pole, or move the poles, a car or a box so that the surroundings are not symmetric "
            "about the poles",
            {
                "rivals": len(rivals),
                "overlap": best.overlap,
                "rival_overlap": rival.overlap,
                "free_space": best.free_space_violation,
                "rival_free_space": rival.free_space_violation,
            },
        )


def _is_rival(hypothesis: Hypothesis, best: Hypothesis) -> bool:
    return (
        hypothesis.match.exact
        and hypothesis.overlap >= RIVAL_OVERLAP * best.overlap
        and hypothesis.free_space_violation
        <= best.free_space_violation + RIVAL_FREE_SPACE_VIOLATION
    )


def weaknesses(
    paired: Sequence[PairedPlacement],
    hypotheses: Sequence[Hypothesis],
    aligned: BeamAlignment,
    weakest: WeakDirection,
    refined: Refinement | None,
) -> list[Reason]:
    """Say what makes an answer weak that is good enough to give.

    Parameters
    ----------
    paired
        Every placement, its poles paired by the choice.
    hypotheses
        All hypotheses, the chosen one first.
    aligned
        The poles' pose.
    weakest
        The direction in which the answer is least certain.
    refined
        The pose of poles and scene; None where the scene was not asked, or had nothing to say.
    """
    return [
        *doubtful_reasons(paired, hypotheses),
        *_weak_choice(hypotheses),
        *_weak_poles(paired),
        *_noisy_poles(paired[0], aligned),
        *_weak_pose(aligned, weakest),
        *_radius_denied(aligned),
        *check_agreement(refined),
        *_several_minima(refined),
        *_not_converged(aligned, refined),
    ]


def _weak_choice(hypotheses: Sequence[Hypothesis]) -> Iterator[Reason]:
    margin = margin_of(hypotheses)
    if margin is not None and margin < WARN_MARGIN:
        yield Reason(
            "small_margin",
            f"the chosen hypothesis leads by {margin:.3f} only (comfortable: {WARN_MARGIN:g}); "
            "look at the hypotheses in the report before you use the transform",
            {"margin": margin, "comfortable": WARN_MARGIN},
        )


def _weak_poles(paired: Sequence[PairedPlacement]) -> Iterator[Reason]:
    target = [pole for each in paired for pole in each.target_poles]
    source = [pole for each in paired for pole in each.source_poles]
    angle = widest_angle(target)
    if angle < WEAK_ANGLE:
        degrees = float(np.degrees(angle))
        yield Reason(
            "nearly_parallel_poles",
            f"the poles are {degrees:.1f}° apart, which leaves height weak; lean one by 15° "
            "or more",
            {"angle_deg": degrees},
        )
    yield from _thin_evidence("target", target)
    yield from _thin_evidence("source", source)


def _thin_evidence(lidar: str, poles: Sequence[Pole]) -> Iterator[Reason]:
    """Say which LiDAR has little to tell of a pole."""
    points, rings = min(len(p.xyz) for p in poles), min(p.rings for p in poles)
    if points < FEW_POINTS:
        yield Reason(
            "few_points",
            f"a pole has {points} returns from the {lidar} LiDAR; move it nearer or record more "
            "frames",
            {"lidar": lidar, "points": points},
        )
    elif rings <= FEW_RINGS:
        yield Reason(
            "few_rings",
            f"a pole is met by {rings} rings of the {lidar} LiDAR; move it nearer, or use a longer "
            "one",
            {"lidar": lidar, "rings": rings},
        )


def _noisy_poles(paired: PairedPlacement, aligned: BeamAlignment) -> Iterator[Reason]:
    target, source = aligned.noise
    yield from _noisy("target", paired.placement.target, target)
    yield from _noisy("source", paired.placement.source, source)


def _noisy(lidar: str, scan: Scan, noise: float) -> Iterator[Reason]:
    """Say which LiDAR's returns on the poles scatter more than its manufacturer's figure allows."""
    expected = ANY_NOISE if scan.sensor is None else scan.sensor.range_noise
    allowed = ANY_NOISE if scan.sensor is None else NOISE_RATIO * scan.sensor.range_noise
    if noise > allowed:
        yield Reason(
            "noisy_poles",
            f"the {lidar}'s returns on the poles scatter by {1000 * noise:.0f} mm along the beam, "
            f"{1000 * allowed:.0f} mm are the most to expect: is --radius right, and did the poles "
            "stand still?",
            {"lidar": lidar, "noise_m": noise, "expected_m": expected},
        )


def _weak_pose(aligned: BeamAlignment, weakest: WeakDirection) -> Iterator[Reason]:
    if weakest.sigma > WEAK_SIGMA:
        yield Reason(
            "weak_direction",
            f"least certain is {weakest.words} (1 σ); lean the poles more against each other, move "
            "them nearer, or add a placement",
            {"sigma_m": weakest.sigma, "allowed_m": WEAK_SIGMA, "condition": weakest.condition},
        )
        assert aligned.pose.covariance is not None
        with_offset, without = (
            float(np.sqrt(np.trace(c[3:, 3:])))
            for c in (aligned.pose.covariance, aligned.covariance_if_known)
        )
        if with_offset > OFFSET_SHARE * without:
            yield Reason(
                "offset_not_separable",
                "the returns cannot tell the pose from a range offset that the tape may cause, or "
                f"from an error of the radius: with these known the poles' pose would have 1 σ of "
                f"{100 * without:.1f} cm, without {100 * with_offset:.1f} cm; put poles on "
                "different sides of the LiDARs",
                {"sigma_m": with_offset, "sigma_if_known_m": without},
            )


def check_axes(aligned: BeamAlignment) -> None:
    """Refuse poles that did not stand to each other alike when each LiDAR recorded them.

    Raises
    ------
    Refusal
        ``poles_inconsistent``.
    """
    test = aligned.axes_test
    limit = float(chdtri(test.freedom, AXES_CHANCE))
    if test.chi2 > limit:
        worst = int(np.argmax(test.by_pole))
        raise Refusal(
            "poles_inconsistent",
            "the poles do not stand to each other alike in both recordings: χ² is "
            f"{test.chi2:.0f} with {test.freedom} degrees of freedom, {limit:.0f} are allowed, and "
            f"pole {worst} fits worst; did one move between the recordings, or is one another "
            "object?",
            {"chi2": test.chi2, "limit": limit, "dof": test.freedom, "pole": worst},
        )


def check_contradiction(refined: Refinement | None) -> None:
    """Refuse poles and a scene that give poses further apart than both allow by far.

    Raises
    ------
    Refusal
        ``poles_scene_contradict``.
    """
    if refined is None or refined.mahalanobis_sq <= MAX_MAHALANOBIS_SQ:
        return
    apart = refined.from_poles
    raise Refusal(
        "poles_scene_contradict",
        f"the scene has the LiDARs {error(apart.translation, 'm')} and "
        f"{error(apart.rotation, 'rad')} from where the poles have them, "
        f"{np.sqrt(refined.mahalanobis_sq / 6):.0f} times what their uncertainty allows: did a "
        "pole move between the two recordings, or is one another object?",
        {
            "mahalanobis_sq": refined.mahalanobis_sq,
            "moved_m": apart.translation,
            "turned_rad": apart.rotation,
        },
    )


def _radius_denied(aligned: BeamAlignment) -> Iterator[Reason]:
    radius = aligned.radius
    if aligned.radius_denied > RADIUS_DENIED:
        yield Reason(
            "radius_differs",
            f"the returns deny the given radius, {value(radius.given, radius.sigma)}, by "
            f"{aligned.radius_denied:.0f} σ and have "
            f"{value_and_error(radius.estimated, radius.sigma)}: is --radius a diameter? The "
            "answer uses what the returns have",
            {"given_m": radius.given, "estimated_m": radius.estimated, "sigma_m": radius.sigma},
        )


def _several_minima(refined: Refinement | None) -> Iterator[Reason]:
    if refined is not None and refined.other_minima:
        furthest = max(refined.other_minima, key=lambda step: float(np.linalg.norm(step[3:])))
        metres, radians = (float(np.linalg.norm(part)) for part in (furthest[3:], furthest[:3]))
        yield Reason(
            "several_minima",
            "from other starts within the poles' uncertainty the scene leads to another pose, "
            f"{error(metres, 'm')} and {error(radians, 'rad')} away; the one that more of the "
            "scene agrees with is given",
            {"apart_m": metres, "apart_rad": radians, "starts": 1 + len(refined.other_minima)},
        )


def check_agreement(refined: Refinement | None) -> list[Reason]:
    """Warn where the scene moves the pose further away than the poles' uncertainty allows."""
    if refined is None or refined.mahalanobis_sq <= WARN_MAHALANOBIS_SQ:
        return []
    apart = refined.from_poles
    return [
        Reason(
            "poles_and_scene_disagree",
            f"the scene moves the pose {1000 * apart.translation:.0f} mm and "
            f"{np.degrees(apart.rotation):.2f}° away from the poles, "
            f"{np.sqrt(refined.mahalanobis_sq / 6):.1f} times what their uncertainty allows: did "
            "something move between the two recordings, or is --radius wrong?",
            {
                "pull": refined.mahalanobis_sq,
                "moved_m": apart.translation,
                "turned_rad": apart.rotation,
            },
        )
    ]


def _not_converged(aligned: BeamAlignment, refined: Refinement | None) -> Iterator[Reason]:
    if not aligned.converged:
        yield Reason(
            "not_converged",
            f"the poles' pose still moved after {aligned.iterations} iterations; record more "
            "frames, or look at what was taken for a pole",
            {"stage": "poles", "iterations": aligned.iterations},
        )
    if refined is not None and not refined.converged:
        yield Reason(
            "not_converged",
            f"the refinement by the scene still moved after {refined.iterations} iterations; "
            "compare with --no-refine",
            {"stage": "refined", "iterations": refined.iterations},
        )
