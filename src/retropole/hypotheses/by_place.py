"""The pose from the surroundings where the poles do not fully determine it: chosen, or refused.

If both LiDARs see one pole, or parallel ones, these are aligned in all ways in which the
surroundings coincide (`one_pole`); without poles, ground is aligned with ground. Objects above the
ground select a hypothesis, rule the others out, and must confirm the pose; surfaces must determine
it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..alignment.adjustment import (
    SURROUNDINGS_SIGMA,
    BeamAlignment,
    is_nearly_determined,
    widest,
    without_poles,
)
from ..base.datatypes import Array, Match, Placement, PoseEstimate, Scan
from ..base.errors import Refusal
from ..base.uncertainty.confirmation import Confirmation
from ..surfaces.consistency import SceneObjects
from ..surfaces.scans import why_few_poles
from ..surfaces.visibility import score_hypotheses
from .choice import NOT_SYMMETRIC, ambiguous, is_not_ruled_out
from .correspondence import same_pose
from .evidence import MAX_WRONG, MIN_TOTAL, grounds_of, raises_grounds, under
from .evidence import count as agreement
from .icp_refinement import MOST_REFINED
from .in_map import registered_in_map
from .one_pole import matches_about, matches_from_above
from .placements import (
    Chosen,
    PairedPlacement,
    PlacementHypotheses,
    align,
    find_recurring,
    has_no_poles,
    is_by_place,
    rank_joint_hypotheses,
)
from .prior import PosePrior, agreeing_with_prior

DETERMINED = 0.25
"""The scene determines a pose if its 1 σ is in no direction a larger part than this of the 1 σ
assumed for the surroundings before (`alignment.adjustment.SURROUNDINGS_SIGMA`): 0.5° and 5 cm.
With twice that, an answer with the verdict ok between two rows of posts was off by 1.2°, as its 1
σ allowed."""

MAX_CONTRADICTED = 0.06
"""Without poles, at most this share of the patches may contradict the pose. Two wrong poses of 88
recordings (benchmarks/deception.py --poles 0, seeds 3000 to 3003) had 9.5 % and 10.8 %, the 21
right ones of them and 11 of real pairs (benchmarks/no_poles.py) at most 4.2 %."""

REGISTRATION_SIGMA = np.repeat([np.radians(0.1), 0.03], 3)
"""1 σ of a pose in a map that is registered to objects that cannot have driven off, rad and m:
chosen. Of 86 in benchmarks/mapped.py, seeds 0 to 59 and 400 to 449, 83 were off by less, and two
with the wheels of cars that had moved by more."""

LEAVES = "one pole, or parallel ones, do not determine the whole pose"
"""The part of the pose that the poles do not determine, in words."""

SET_UP_TWO = "set up two poles that both LiDARs see, one of them leaning by 15° or more"
"""Advice if the surroundings do not determine the pose without poles."""

LEAN_ANOTHER = "lean a second pole, in view of both LiDARs, by 15° or more against the first"
"""Advice if the surroundings do not determine the rest of the pose."""


def choose_by_place(
    placements: Sequence[Placement],
    radius: float,
    *,
    count: int | None = None,
    prior: PosePrior | None = None,
) -> Chosen | None:
    """Align one pole in every placement, and determine the rest of the pose from the surroundings.

    Objects above the ground decide, not the overlap of all points: the ground coincides at any
    angle, and best where it brings the LiDARs near each other.

    Parameters
    ----------
    placements
        With the poles of both LiDARs, the best supported first.
    radius
        Of the poles, metres.
    count, prior
        Number of poles that both LiDARs see, and prior knowledge of the rotation.

    Returns
    -------
    Chosen or None
        None if no pose makes the surroundings coincide.
    """
    scans = [scan for placement in placements for scan in placement.scans]
    if count is not None and min(len(scan.poles) for scan in scans) < count:
        return None
    grounds = _grounds(placements)
    try:
        scored = []
        for placement, standing in zip(placements, grounds, strict=True):
            found = _matches(placement, standing, radius, count, prior)
            found = agreeing_with_prior(found, prior)
            # Inexact hypotheses are used for comparison only.
            own = [each for each in found if not each.exact or count in (None, len(each.pairs))]
            if not any(match.exact for match in own):
                return None
            clouds = placement.target.cloud, placement.source.cloud
            scored.append(PlacementHypotheses(placement, score_hypotheses(*clouds, own)))
        choices = find_recurring(scored)
    except Refusal:
        return None
    counts = [_counts_at(grounds, choice.joint.match.T_target_source) for choice in choices]
    order = np.argsort([each.conflicting - each.agreeing for each in counts], kind="stable")
    choices = [choices[k] for k in order]
    hypotheses = rank_joint_hypotheses(choices, scored)
    beside = _rivals(
        grounds, hypotheses[0].match.T_target_source, [h.match for h in hypotheses[1:]]
    )
    rivals = [each for each in hypotheses if each.match in beside]
    advice = SET_UP_TWO if count == 0 else NOT_SYMMETRIC
    refusal = ambiguous(hypotheses[0], rivals, advice) if rivals else None
    paired = () if rivals else choices[0].paired
    return Chosen(hypotheses, paired, refusal, tuple(choices), scored=tuple(scored))


def align_by_place_if_open(
    chosen: Chosen,
    *,
    radius: float,
    radius_sigma: float,
    by_place: bool,
    count: int | None = None,
    prior: PosePrior | None = None,
) -> tuple[Chosen, BeamAlignment]:
    """Align the chosen poles; if these hardly constrain the pose, let the surroundings decide.

    Short or poorly visible poles also fit under a pose that is off by degrees.

    Parameters
    ----------
    chosen
        With every placement paired.
    radius, radius_sigma
        Of the poles, and its 1 σ, metres.
    by_place
        Whether the surroundings may decide.
    count, prior
        As of `choose_by_place`.

    Raises
    ------
    Refusal
        As `alignment.adjustment.align_beams` does, and if the surroundings do not determine the
        pose.
    """
    known = {"radius": radius, "radius_sigma": radius_sigma}
    T = chosen.hypotheses[0].match.T_target_source
    if has_no_poles(chosen.paired) and chosen.paired[0].placement.target.cloud.is_map:
        T = registered_in_map(chosen.paired[0].placement, T)
        return chosen, without_poles(T, radius, REGISTRATION_SIGMA)
    try:
        return chosen, align(chosen.paired, T, **known)
    except Refusal as refusal:
        is_open = refusal.code == "degenerate_poles" and not is_by_place(chosen.paired)
        if not (by_place and is_open):
            raise
        placements = [each.placement for each in chosen.paired]
        again = choose_by_place(placements, radius, count=count, prior=prior)
        if again is None or again.refusal is not None:
            raise
    return again, align(again.paired, again.hypotheses[0].match.T_target_source, **known)


def _matches(
    placement: Placement,
    grounds: tuple[Sequence[SceneObjects], Sequence[SceneObjects]],
    radius: float,
    count: int | None,
    prior: PosePrior | None,
) -> list[Match]:
    """Match the clouds of a placement about one pole, or without poles if that is requested."""
    if count == 0:
        return matches_from_above(placement, grounds, prior=prior)
    found = matches_about(placement, (grounds[0][0], grounds[1][0]), radius)
    if any(match.exact for match in found) or not all(scan.poles for scan in placement.scans):
        return found
    # A short piece of a pole does not show in which direction it leans.
    return matches_from_above(placement, grounds, radius, prior)


Grounds = Sequence[tuple[Sequence[SceneObjects], Sequence[SceneObjects]]]
"""Objects above each plane that may be the ground, in both clouds of every placement."""


def _grounds(placements: Sequence[Placement]) -> Grounds:
    # The same recordings give the same answer.
    rng = np.random.default_rng(0)
    return [grounds_of(each, rng) for each in placements]


def _counts_at(grounds: Grounds, T: Array) -> Confirmation:
    """Count the patches that agree with a pose (4, 4), and those that conflict with it."""
    return agreement([under(each, T) for each in grounds], T)


def _rivals(grounds: Grounds, T: Array, others: Sequence[Match]) -> list[Match]:
    """Find the poses that objects above the ground do not rule out in addition to one (4, 4).

    The rule is `choice.is_not_ruled_out`, applied to patches above the ground.
    """
    own, lifted = _counts_at(grounds, T), _raises(grounds, T)
    found = []
    for other in others:
        counted = _counts_at(grounds, other.T_target_source)
        possible = is_not_ruled_out(
            counted.agreeing, counted.contradicted, own.agreeing, own.contradicted
        )
        if possible and (lifted or not _raises(grounds, other.T_target_source)):
            found.append(other)
    return found


def _raises(grounds: Grounds, T: Array) -> bool:
    return raises_grounds([under(each, T) for each in grounds], T)


def confirmed_by_place(chosen: Chosen) -> Chosen | None:
    """Select the hypothesis that objects above the ground confirm, if it has no rival.

    LiDARs far from each other sample a surface along different lines: few returns have a neighbour
    under the right pose. Voxels still agree in depth if either LiDAR sees them.

    Parameters
    ----------
    chosen
        With hypotheses that the scene scored, whether or not there is a refusal; one of its
        first `MOST_REFINED` choices may be selected.

    Returns
    -------
    Chosen or None
        Without a refusal; None if fewer than `MIN_TOTAL` patches give information about the best
        hypothesis, if more than `MAX_CONTRADICTED` of them conflict, or if another is not ruled
        out.
    """
    if not chosen.choices:
        return None
    grounds = _grounds([each.placement for each in chosen.scored])
    first = [choice.joint.match.T_target_source for choice in chosen.choices[:MOST_REFINED]]
    counts = [_counts_at(grounds, T) for T in first]
    k = min(range(len(counts)), key=lambda k: counts[k].conflicting - counts[k].agreeing)
    best = chosen.choices[k]
    if counts[k].total < MIN_TOTAL or counts[k].contradicted > MAX_CONTRADICTED:
        return None
    others = [each for each in chosen.hypotheses if each.match is not best.joint.match]
    if _rivals(grounds, first[k], [each.match for each in others]):
        return None
    choices = (best, *chosen.choices[:k], *chosen.choices[k + 1 :])
    return replace(
        chosen,
        hypotheses=(best.joint, *others),
        paired=best.paired,
        refusal=None,
        choices=choices,
    )


def has_rival(paired: Sequence[PairedPlacement], radius: float) -> bool:
    """Whether the surroundings also coincide at another angle about the pole that both see best.

    Three objects that are detected as poles may match in one way only, and in surroundings that are
    symmetric under a half turn this may be the wrong one.
    """
    first = paired[0]
    match = first.hypothesis.match
    grounds = _grounds([each.placement for each in paired])
    i, j = max(
        match.pairs,
        key=lambda pair: min(
            len(scan.poles[k].xyz) for scan, k in zip(first.placement.scans, pair, strict=True)
        ),
    )
    alone = Placement(_alone(first.placement.target, i), _alone(first.placement.source, j))
    standing = grounds[0][0][0], grounds[0][1][0]
    at = np.array([pole.point for pole in alone.source.poles])
    found = matches_about(alone, standing, radius)
    others = [each for each in found if each.exact and not same_pose(each, match, at)]
    return bool(_rivals(grounds, match.T_target_source, others))


def _alone(scan: Scan, k: int) -> Scan:
    """Keep one pole of those found in a cloud."""
    assert scan.detection is not None
    return replace(scan, detection=replace(scan.detection, poles=(scan.poles[k],)))


def check_confirmed_by_surroundings(paired: Sequence[PairedPlacement], found: Confirmation) -> None:
    """Refuse a pose that is partly from the surroundings if these do not confirm it.

    Raises
    ------
    Refusal
        ``too_few_poles``.
    """
    if not is_by_place(paired):
        return
    wrong = 1.0 if found.probability_wrong is None else found.probability_wrong
    contradicted = MAX_CONTRADICTED if has_no_poles(paired) else 1.0
    if found.total >= MIN_TOTAL and wrong <= MAX_WRONG and found.contradicted <= contradicted:
        return
    left, advice = _undetermined(paired)
    needed = f"{MIN_TOTAL} patches and {100 * MAX_WRONG:.0f} % needed"
    if has_no_poles(paired):
        needed += f", at most {100 * MAX_CONTRADICTED:.0f} % contradicting"
    raise Refusal(
        "too_few_poles",
        f"{left}; the surroundings are not enough: {found.counts}; chance of a "
        f"wrong pose {found.chance} ({needed}); {advice}",
        {
            "poles": max(len(each.target_poles) for each in paired),
            "needed": 2,
            "agreeing": found.agreeing,
            "contradicting": found.contradicting,
            "missing": found.missing,
            "lead": found.z_margin or 0.0,
            "probability_wrong": wrong,
        },
    )


def _undetermined(paired: Sequence[PairedPlacement]) -> tuple[str, str]:
    """Describe the part of the pose left to the surroundings, and give advice if they do not
    determine it."""
    if has_no_poles(paired):
        return "without poles the pose is undetermined", SET_UP_TWO
    scans = [scan for each in paired for scan in (each.placement.target, each.placement.source)]
    few = (why_few_poles(scan) for scan in scans if len(scan.poles) < 2)
    return LEAVES, next(filter(None, few), LEAN_ANOTHER)


def check_constrained(
    paired: Sequence[PairedPlacement], refined: PoseEstimate | None, held: Array | None = None
) -> None:
    """Refuse a pose that neither the poles nor the scene determine.

    Parameters
    ----------
    paired
        Every placement.
    refined
        Pose and its whole covariance; None if the surfaces gave none.
    held
        (6, 6) covariance, rad and m, on the assumption that no place has moved; None uses the
        whole covariance. It is no reason to refuse that a single place decides: this is reported,
        and the uncertainty without it is stated, up to the limit for poles.

    Raises
    ------
    Refusal
        ``degenerate_poles``.
    """
    if not is_by_place(paired):
        return
    left, advice = _undetermined(paired)
    if refined is None:
        raise Refusal(
            "degenerate_poles",
            f"{left}, and too few surfaces are seen by both LiDARs to determine the rest; {advice}",
            {"poles": max(len(each.target_poles) for each in paired)},
        )
    assert refined.covariance is not None
    held = refined.covariance if held is None else held
    if is_constrained(held) and is_nearly_determined(refined.covariance):
        return
    check_constrained_by_scene(refined.covariance, left=left, advice=advice)


def is_constrained(covariance: Array) -> bool:
    """Whether a pose (6, 6) is known far better than was assumed for the surroundings."""
    by_place = covariance / np.outer(SURROUNDINGS_SIGMA, SURROUNDINGS_SIGMA)
    return float(np.linalg.eigvalsh(by_place)[-1]) <= DETERMINED**2


def check_constrained_by_scene(
    covariance: Array,
    lidars: str = "both LiDARs",
    *,
    left: str = LEAVES,
    advice: str = LEAN_ANOTHER,
) -> None:
    """Refuse a pose that the scene determines little better than was assumed for the surroundings.

    Parameters
    ----------
    covariance
        (6, 6) of the pose of one LiDAR in the frame of the other, over ``[φ, δ]``, rad and m.
    lidars
        Names of the LiDARs, in words.
    left, advice
        The part that the poles do not determine, and advice.

    Raises
    ------
    Refusal
        ``degenerate_poles``.
    """
    if is_constrained(covariance):
        return
    rotation, translation = widest(covariance)
    raise Refusal(
        "degenerate_poles",
        f"{left}, and the surfaces that {lidars} see determine the pose only to "
        f"{np.degrees(rotation):.2f}° and {translation:.2f} m (1 σ); {advice}",
        {"rotation_sigma_rad": rotation, "translation_sigma_m": translation},
    )
