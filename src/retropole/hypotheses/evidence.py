"""Whether the objects in the scene confirm a pose, and how many of them could have contradicted it.

The absence of conflicts shows little if no conflict was possible: in a corridor of
plain walls a pose may slide along them. So the same voxels are counted at other poses: the
best shifts along the ground and off it, small turns about the vertical, and the other ways of
matching the poles. The pose must be better than all these. Two measures, the share of the voxels
that conflict with the pose and by how many σ it is better, are combined into one figure: the share
of such answers that are wrong in simulation.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import combinations, product

import numpy as np
from msgspec.structs import replace

from ..base import se3
from ..base.datatypes import Array, Hypothesis, Placement
from ..base.errors import Reason, Refusal
from ..base.uncertainty.confirmation import CLEAR_Z_MARGIN, DECEIVING, TOGETHER, Confirmation
from ..surfaces.consistency import (
    SceneObjects,
    best_lifts,
    best_shifts,
    blocks,
    coincides,
    consistency,
    grounds_in,
    is_ground_on_ground,
    objects_in,
    verdicts,
)
from ..surfaces.static import recorded_together
from ..surfaces.visibility import OVERLAP_DISTANCE
from .correspondence import are_similar
from .placements import PairedPlacement, is_by_place

MAX_CONFLICTING, MIN_TOTAL = 0.2, 60
"""From this share on, of at least this many voxels, the scene conflicts with a pose. At the right
pose of 200 hard scenes (benchmarks/hard_scenes.py, seeds below 200) the share was 0.8 % in the
median and at most 5.7 %."""

BETTER = 1.05
"""The scene fits better at a pose with more agreeing voxels by this factor: by 1.09 and more for
poles carried by 1 to 5 m along a corridor, a street or a harbor (benchmarks/deception.py, seeds 10
to 25)."""

TURN = np.radians(15.0)
"""Poses turned by this amount about the vertical are compared with the pose, rad."""

MAX_RIVALS = 3
"""Number of other hypotheses that are compared as well; all other angles about a pole, where the
surroundings gave the pose."""

REDUNDANT_POLES = 3
"""Number of poles that check each other: two fit a wrong pose as exactly as the right one."""

MAX_WRONG = 0.05
"""An answer is confirmed up to this share of wrong ones among simulated answers like it. At seeds
20000 to 20022 of benchmarks/deception.py the smallest figure of a wrong answer is 27 %; of 341
right ones 264 are confirmed with 5 %, 260 with 3 %, and 267 with 10 %."""


def confirm(
    paired: Sequence[PairedPlacement],
    T: Array,
    others: Sequence[Hypothesis],
    rng: np.random.Generator,
    *,
    trusted: bool = False,
    deceiving: float | None = None,
) -> Confirmation:
    """Compare an answer with the objects in the scene of all placements.

    Parameters
    ----------
    paired
        Every placement, its poles paired by the choice.
    T
        (4, 4) the answer, target from source.
    others
        The hypotheses that were not chosen, the best first.
    rng
        Chooses the planes that are tried for the ground.
    trusted
        Whether the user trusts the poles.
    deceiving
        Share of similar recordings with misleading poles; None chooses it by the times of both.
    """
    if is_by_place(paired):
        scenes = [under(grounds_of(each.placement, rng), T) for each in paired]
    else:
        scenes = scenes_of([each.placement for each in paired], rng)
    here = count(scenes, T)
    exact = [other.match for other in others if other.match.exact]
    angles = [other.match for other in others if other.match.by_place]
    rivals = [match.T_target_source for match in angles or exact[:MAX_RIVALS]]
    if not raises_grounds(scenes, T):
        rivals = [pose for pose in rivals if not raises_grounds(scenes, pose)]
    shifted = [*_shifted(scenes, T)]
    poses = [*shifted, *_turned(scenes, T), *rivals]
    margins, better = [], []
    fewer = [(target.downsampled(), source.downsampled()) for target, source in scenes]
    own = count(fewer, T)
    margin = _margin_in_map(fewer[0], T) if paired[0].placement.target.cloud.is_map else None
    for pose in poses:
        found = count(fewer, pose)
        margins.append(_z_margin(own, found) if margin is None else margin(pose))
        if (
            found.agreeing >= BETTER * max(own.agreeing, 1)
            and found.contradicted <= own.contradicted
        ):
            better.append((margins[-1], pose))
    points = np.concatenate([source.points for _, source in scenes])
    together = recorded_together([each.placement for each in paired])
    usual = TOGETHER if together else DECEIVING
    least = int(np.argmin(margins)) if margins else len(shifted)
    return replace(
        here,
        together=together,
        deceiving=usual if deceiving is None else deceiving,
        along=_way(T, shifted[least]) if least < len(shifted) else None,
        z_margin=min(margins, default=0.0),
        better_at=_median_distance(T, min(better, key=lambda each: each[0])[1], points)
        if better
        else None,
        redundant=_are_redundant(paired)
        and not any(
            margin <= CLEAR_Z_MARGIN and _poles_against(paired, scenes, pose) < REDUNDANT_POLES
            for margin, pose in zip(margins, poses, strict=True)
        ),
        trusted=trusted,
    )


def scenes_of(
    placements: Sequence[Placement], rng: np.random.Generator
) -> list[tuple[SceneObjects, SceneObjects]]:
    """Prepare both clouds of every placement; the poles themselves are left out."""
    return [
        (
            objects_in(placement.target.cloud, rng, placement.target.poles),
            objects_in(placement.source.cloud, rng, placement.source.poles),
        )
        for placement in placements
    ]


def grounds_of(
    placement: Placement, rng: np.random.Generator
) -> tuple[tuple[SceneObjects, ...], tuple[SceneObjects, ...]]:
    """Prepare both clouds of a placement for each plane that may be the ground."""
    target, source = (grounds_in(scan.cloud, rng, scan.poles) for scan in placement.scans)
    return target, source


def under(
    grounds: tuple[Sequence[SceneObjects], Sequence[SceneObjects]], T: Array
) -> tuple[SceneObjects, SceneObjects]:
    """Choose the planes that coincide under a pose (4, 4); the first of each if none do."""
    every = list(product(*grounds))
    return next((pair for pair in every if is_ground_on_ground(*pair, T)), every[0])


def count(scenes: Sequence[tuple[SceneObjects, SceneObjects]], T: Array) -> Confirmation:
    """Count the voxels of all scenes that agree with a pose (4, 4), or conflict with it."""
    each = [consistency(*scene, T) for scene in scenes]
    return Confirmation(
        agreeing=sum(one.agreeing for one in each),
        contradicting=sum(one.contradicting for one in each),
        missing=sum(one.missing for one in each),
    )


def _shifted(scenes: Sequence[tuple[SceneObjects, SceneObjects]], T: Array) -> Iterator[Array]:
    """Poses near a pose: the best shifts along the ground and off it.

    Off the ground only if the pose lifts the grounds off each other, and more coincides there.
    """
    for target, source in scenes:
        clouds = target.points, source.points, target.up, T
        shifts = best_shifts(*clouds)
        if raises_grounds([(target, source)], T):
            shifts += [shift for shift in best_lifts(*clouds) if shift.gain > 1]
        for shift in shifts:
            yield se3.retract(T, np.r_[np.zeros(3), shift.step])


def raises_grounds(scenes: Sequence[tuple[SceneObjects, SceneObjects]], T: Array) -> bool:
    """Whether a pose lifts the grounds of some scene off each other.

    Grounds that coincide conflict with all lifts, and are not among the points.
    """
    return any(
        abs((target.ground - se3.apply(T, source.ground)) @ target.up) > OVERLAP_DISTANCE
        for target, source in scenes
    )


def _turned(scenes: Sequence[tuple[SceneObjects, SceneObjects]], T: Array) -> Iterator[Array]:
    """Poses that are turned about the normal of the ground."""
    target, source = scenes[0]
    middle = se3.apply(T, np.median(source.points, axis=0)) if len(source.points) else T[:3, 3]
    for angle in (TURN, -TURN):
        R = se3.exp_so3(angle * target.up)
        yield se3.from_rt(R, middle - R @ middle) @ T


def _way(T: Array, other: Array) -> Array:
    """(3,) unit vector along which a pose is shifted from another."""
    step = other[:3, 3] - T[:3, 3]
    return np.asarray(step / np.linalg.norm(step))


def _z_margin(here: Confirmation, there: Confirmation) -> float:
    """By how many σ more voxels agree, and fewer conflict, at one pose than at another."""
    net = (here.agreeing - here.conflicting) - (there.agreeing - there.conflicting)
    return float(net / np.sqrt(here.total + there.total + 1))


def _margin_in_map(scene: tuple[SceneObjects, SceneObjects], T: Array) -> Callable[[Array], float]:
    """Give by how many σ a pose (4, 4) in a map is better than another.

    Most of a street agrees with either. So only the differences are used, and by blocks, since
    the voxels of one object are not independent: by chance, half of all blocks would prefer either
    pose.
    """
    here, block = verdicts(*scene, T), blocks(*scene, T)

    def margin(other: Array) -> float:
        by_block = np.bincount(block, here - verdicts(*scene, other))
        return float(by_block.sum() / np.sqrt(np.sum(by_block**2) + 1))

    return margin


def _median_distance(T: Array, other: Array, points: Array) -> float:
    """Median distance of the points of the source under two poses, metres."""
    points = points if len(points) else np.zeros((1, 3))
    return float(np.median(np.linalg.norm(se3.apply(T, points) - se3.apply(other, points), axis=1)))


def _are_redundant(paired: Sequence[PairedPlacement]) -> bool:
    """Whether the poles check each other: three poles, or two placements that differ.

    Files of two placements on one stand, mixed up, repeat the same error: both LiDARs must see
    that the shapes differ by more than their noise. Parallel ones may be posts of a row.
    """
    if is_by_place(paired):
        return False
    if max(len(each.target_poles) for each in paired) >= REDUNDANT_POLES:
        return True
    two = [each for each in paired if len(each.target_poles) == 2]
    return any(
        not are_similar(one.target_poles, other.target_poles)
        and not are_similar(one.source_poles, other.source_poles)
        for one, other in combinations(two, 2)
    )


def _poles_against(
    paired: Sequence[PairedPlacement], scenes: Sequence[tuple[SceneObjects, SceneObjects]], T: Array
) -> int:
    """Number of pairs of poles that coincide with nothing in the other cloud under another pose (4,
    4).

    Posts of a row lie on their neighbours where it is shifted by a post: only these poles do not
    contradict the shift, and one or two may have been carried.
    """
    return sum(
        not (coincides(target.xyz, there, se3.inverse(T)) or coincides(source.xyz, here, T))
        for each, (here, there) in zip(paired, scenes, strict=True)
        for target, source in zip(each.target_poles, each.source_poles, strict=True)
    )


def is_in_conflict(found: Confirmation) -> bool:
    """Whether the number of voxels that conflict with a pose is decisive by itself."""
    return found.total >= MIN_TOTAL and found.contradicted > MAX_CONFLICTING


def check_confirmation(found: Confirmation) -> None:
    """Refuse a pose that the objects in the scene conflict with.

    Raises
    ------
    Refusal
        ``scene_contradicts``.
    """
    is_better_elsewhere = found.better_at is not None
    if not (is_in_conflict(found) or (is_better_elsewhere and found.total >= MIN_TOTAL)):
        return
    elsewhere = f", and it fits better {found.better_at:.1f} m away" if is_better_elsewhere else ""
    raise Refusal(
        "scene_contradicts",
        f"under the pose that the poles give, of the patches above the ground {found.counts} "
        f"({found.contradicted:.0%} contradict it; {MAX_CONFLICTING:.0%} are "
        f"allowed){elsewhere}: did a pole move between the recordings, or are these two "
        "different placements?",
        {
            "agreeing": found.agreeing,
            "contradicting": found.contradicting,
            "missing": found.missing,
            "contradicted": found.contradicted,
            "allowed": MAX_CONFLICTING,
            **({} if found.better_at is None else {"better_at_m": found.better_at}),
        },
    )


def check_unconfirmed(found: Confirmation) -> Iterator[Reason]:
    """Warn if the scene does not confirm the pose, and the user does not trust the poles."""
    wrong = found.probability_wrong
    if found.trusted or wrong is None or wrong <= MAX_WRONG:
        return
    yield Reason(
        "not_confirmed",
        f"chance of a wrong pose: {found.chance_words}; {100 * MAX_WRONG:.0f} % is allowed. Scene "
        f"check: {found.counts}, {_margin_words(found.z_margin or 0.0)}. "
        f"{_constrained_by_poles(found)}. If nobody touched the poles between the recordings, "
        "give --trust-poles; otherwise add another pole or another placement",
        {
            "agreeing": found.agreeing,
            "contradicting": found.contradicting,
            "missing": found.missing,
            "lead": found.z_margin or 0.0,
            "probability_wrong": wrong,
            "deceiving_share": found.deceiving,
            "allowed": MAX_WRONG,
        },
    )


def _margin_words(sigmas: float) -> str:
    """Describe how this pose compares with the best of the others."""
    if sigmas < 0.0:
        return f"worse than another pose by {-sigmas:.1f} σ"
    return f"better than other poses by {sigmas:.1f} σ"


def _constrained_by_poles(found: Confirmation) -> str:
    """Describe the direction that only the poles constrain, if they cannot check each other."""
    if found.along is None:
        return "Only the poles constrain the pose"
    x, y, z = found.along
    return f"Only the poles constrain it along ({x:.1f}, {y:.1f}, {z:.1f}) of the target"
