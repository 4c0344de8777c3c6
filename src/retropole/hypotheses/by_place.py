"""Poles that leave a part of the pose open, and the place that gives it: chosen, or refused.

One pole that both LiDARs see, or parallel ones, are laid on each other in all ways in which the
place lies on itself (`one_pole`); without any, ground is laid on ground. What stands
off the ground chooses, rules the others out, and must confirm the pose; surfaces must hold it.
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

HELD = 0.25
"""The scene holds a pose where no direction of it has a larger part of the 1 σ that the place was
taken to give before (`alignment.adjustment.SURROUNDINGS_SIGMA`): 0.5° and 5 cm. With twice that, an
answer between two rows of posts was off by 1.2° under ok, as its 1 σ allowed."""

MAX_CONTRADICTED = 0.06
"""Without any pole no more of the patches may contradict the pose. Two wrong poses of 88 recordings
(benchmarks/deception.py --poles 0, seeds 3000 to 3003) had 9.5 % and 10.8 %, the 21 right ones of
them and 11 of real pairs (benchmarks/no_poles.py) 4.2 % at most."""

MAP_SIGMA = np.repeat([np.radians(0.1), 0.03], 3)
"""1 σ of a pose in a map that is registered to what cannot have driven off, rad and m: chosen. Of
86 in benchmarks/mapped.py, seeds 0 to 59 and 400 to 449, 83 were off by less, and two with the
wheels of cars that had moved by more."""

LEAVES = "one pole, or parallel ones, leave a part of the pose open"
"""What the poles do not tell."""

SET_UP_TWO = "set up two poles that both LiDARs see, one of them leaning by 15° or more"
"""What to do where it does not without any pole."""

LEAN_ANOTHER = "lean a second pole by 15° or more against the first where both LiDARs see it"
"""What to do where the place does not tell."""


def choose_by_place(
    placements: Sequence[Placement],
    radius: float,
    *,
    count: int | None = None,
    prior: PosePrior | None = None,
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
    scans = [scan for placement in placements for scan in placement.scans]
    if count is not None and min(len(scan.poles) for scan in scans) < count:
        return None
    grounds = _grounds(placements)
    try:
        scored = []
        for placement, standing in zip(placements, grounds, strict=True):
            found = _matches(placement, standing, radius, count, prior)
            found = agreeing_with_prior(found, prior)
            # What is not exact is only compared with.
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


def align_by_place_where_open(
    chosen: Chosen,
    *,
    radius: float,
    radius_sigma: float,
    by_place: bool,
    count: int | None = None,
    prior: PosePrior | None = None,
) -> tuple[Chosen, BeamAlignment]:
    """Align the chosen poles; where these leave the pose all but free, let the place choose.

    Short or poorly seen poles fit in a pose that is degrees off.

    Parameters
    ----------
    chosen
        With every placement paired.
    radius, radius_sigma
        Of the poles, and its 1 σ, metres.
    by_place
        Whether the place may choose.
    count, prior
        As of `choose_by_place`.

    Raises
    ------
    Refusal
        As `alignment.adjustment.align_beams` does, and where the place does not tell.
    """
    known = {"radius": radius, "radius_sigma": radius_sigma}
    T = chosen.hypotheses[0].match.T_target_source
    if has_no_poles(chosen.paired) and chosen.paired[0].placement.target.cloud.is_map:
        T = registered_in_map(chosen.paired[0].placement, T)
        return chosen, without_poles(T, radius, MAP_SIGMA)
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
    """Lay a placement on itself about one pole, or without any where that is asked for."""
    if count == 0:
        return matches_from_above(placement, grounds, prior=prior)
    found = matches_about(placement, (grounds[0][0], grounds[1][0]), radius)
    if any(match.exact for match in found) or not all(scan.poles for scan in placement.scans):
        return found
    # A short piece of a pole does not tell which way it leans.
    return matches_from_above(placement, grounds, radius, prior)


Grounds = Sequence[tuple[Sequence[SceneObjects], Sequence[SceneObjects]]]
"""What stands off each plane that may be the ground, in both clouds of every placement."""


def _grounds(placements: Sequence[Placement]) -> Grounds:
    # The same recordings give the same answer.
    rng = np.random.default_rng(0)
    return [grounds_of(each, rng) for each in placements]


def _counts_at(grounds: Grounds, T: Array) -> Confirmation:
    """Count what agrees with a pose (4, 4), and what conflicts with it."""
    return agreement([under(each, T) for each in grounds], T)


def _rivals(grounds: Grounds, T: Array, others: Sequence[Match]) -> list[Match]:
    """Find the poses that what stands off the ground does not rule out beside one (4, 4).

    The rule is `choice.is_not_ruled_out`, of patches off the ground.
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
    """Take the hypothesis that what stands off the ground confirms, and leaves no rival.

    LiDARs far from each other meet a surface in lines that lie apart: few returns have a neighbour
    under the right pose. A voxel still agrees in depth where either LiDAR sees it.

    Parameters
    ----------
    chosen
        With hypotheses that the scene scored, whether or not there is a refusal; of its choices
        the first `MOST_REFINED` may be taken.

    Returns
    -------
    Chosen or None
        Without a refusal; None where less than `MIN_TOTAL` says anything of the best hypothesis or
        more than `MAX_CONTRADICTED` of that conflicts, and where another is not ruled out.
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
    """Whether the place lies on itself as well at another angle about the pole that both see best.

    Three things that are taken for poles may lie on each other in one way only, and amid a place
    that a half turn changes nothing of that may be the wrong one.
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
    """Refuse a pose of which the place gives a part and does not confirm it.

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
    left, advice = _left_open(paired)
    needed = f"{MIN_TOTAL} patches and {100 * MAX_WRONG:.0f} % needed"
    if has_no_poles(paired):
        needed += f", at most {100 * MAX_CONTRADICTED:.0f} % against it"
    raise Refusal(
        "too_few_poles",
        f"{left}, and the surroundings do not fix it: {found.counts}; chance of a wrong pose "
        f"{found.chance} ({needed}); {advice}",
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


def _left_open(paired: Sequence[PairedPlacement]) -> tuple[str, str]:
    """Say what the poles leave to the place, and what to do where it does not tell."""
    if has_no_poles(paired):
        return "without poles all of the pose is open", SET_UP_TWO
    scans = [scan for each in paired for scan in (each.placement.target, each.placement.source)]
    few = (why_few_poles(scan) for scan in scans if len(scan.poles) < 2)
    return LEAVES, next(filter(None, few), LEAN_ANOTHER)


def check_constrained(
    paired: Sequence[PairedPlacement], refined: PoseEstimate | None, held: Array | None = None
) -> None:
    """Refuse a pose that the poles leave open, and the scene as well.

    Parameters
    ----------
    paired
        Every placement.
    refined
        Pose and all of its covariance; None where the surfaces gave none.
    held
        (6, 6) of it, rad and m, if every place is where it was; None takes all of the covariance.
        That a single place decides is no reason to refuse: it is reported, and what the others
        leave is stated, up to what poles may leave.

    Raises
    ------
    Refusal
        ``degenerate_poles``.
    """
    if not is_by_place(paired):
        return
    left, advice = _left_open(paired)
    if refined is None:
        raise Refusal(
            "degenerate_poles",
            f"{left}, and too few surfaces that both LiDARs see tell it; {advice}",
            {"poles": max(len(each.target_poles) for each in paired)},
        )
    assert refined.covariance is not None
    held = refined.covariance if held is None else held
    if is_constrained(held) and is_nearly_determined(refined.covariance):
        return
    check_constrained_by_scene(refined.covariance, left=left, advice=advice)


def is_constrained(covariance: Array) -> bool:
    """Whether a pose (6, 6) is known far better than the place was taken to give it."""
    by_place = covariance / np.outer(SURROUNDINGS_SIGMA, SURROUNDINGS_SIGMA)
    return float(np.linalg.eigvalsh(by_place)[-1]) <= HELD**2


def check_constrained_by_scene(
    covariance: Array,
    lidars: str = "both LiDARs",
    *,
    left: str = LEAVES,
    advice: str = LEAN_ANOTHER,
) -> None:
    """Refuse a pose that the scene holds little better than the place was taken to give it.

    Parameters
    ----------
    covariance
        (6, 6) of the pose of one LiDAR in the frame of the other, over ``[φ, δ]``, rad and m.
    lidars
        What they are called.
    left, advice
        What the poles leave open, and what to do.

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
        f"{left}, and the surfaces that {lidars} see hold the pose to "
        f"{np.degrees(rotation):.2f}° and {translation:.2f} m only (1 σ); {advice}",
        {"rotation_sigma_rad": rotation, "translation_sigma_m": translation},
    )
