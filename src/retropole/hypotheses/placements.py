"""Several placements of the poles in view of the same two LiDARs: one pose for all placements.

Each placement has separate hypotheses; only the right pose recurs in all. The scores by the scene
are averaged over the placements.

A refusal states how many of the possible matches were tried. With bright objects that may be poles
hundreds of ways of matching are possible. A fixed number of each kind is tried, the best
first: counts, not seconds, so that the same recordings give the same answer on any machine.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ..alignment.adjustment import BeamAlignment, align_beams, without_poles
from ..alignment.observations import beams_of
from ..base import se3
from ..base.datatypes import Array, Hypothesis, Match, Placement, PointCloud, Pole
from ..base.errors import Refusal
from ..base.systematic import remaining_sway_of_each
from ..extraction.sensor_pattern import error_sizes


class Share(NamedTuple):
    """Number that was tried, the best first, and the number that is possible."""

    tried: int
    found: int


class Tried(NamedTuple):
    """How many of the possible matches of a placement were tried.

    Attributes
    ----------
    pairs
        Of the pairs of poles with the shape of a pair of the other LiDAR: matched.
    ways
        Of the ways of matching the poles: scored by the scene.
    fitting
        Of those that fit exactly: registered.
    """

    pairs: Share = Share(0, 0)
    ways: Share = Share(0, 0)
    fitting: Share = Share(0, 0)


NOTHING = Tried()

VERBS = {"pairs": "laid", "ways": "tried", "fitting": "registered"}


def uses_candidates(placement: Placement) -> bool:
    """Whether candidate poles are among those of a placement."""
    return any(
        pole is own for scan in placement.scans for pole in scan.poles for own in scan.candidates
    )


def with_attempts(refusal: Refusal, tried: Iterable[Tried]) -> Refusal:
    """Add to the values of a refusal what was left out to bound the time, if anything.

    Parameters
    ----------
    refusal
        Why there is no answer.
    tried
        In each attempt; the figures are of the one that had the most ways.
    """
    most = max(tried, key=lambda each: (each.ways.found, each.fitting.found), default=NOTHING)
    cut = {name: share for name, share in most._asdict().items() if share.tried < share.found}
    if not cut:
        return refusal
    counts = {
        key: count
        for name, share in cut.items()
        for key, count in ((name, share.found), (f"{name}_{VERBS[name]}", share.tried))
    }
    return Refusal(refusal.code, refusal.message, {**refusal.values, **counts})


AGREE_ANGLE, AGREE_DISTANCE = np.radians(4.0), 0.4
"""Poses of two placements are one if they differ by less, rad, and metres where the poles are.
Right ones differ by the uncertainty of the poles of one placement, wrong ones by half turns."""


@dataclass(frozen=True, eq=False)
class PlacementMatches:
    """A placement, the matches of its poles, and how much was tried to find them."""

    placement: Placement
    matches: list[Match]
    tried: Tried = NOTHING


@dataclass(frozen=True, eq=False)
class PlacementHypotheses:
    """A placement, all its hypotheses, the best score first, and how much was tried for them."""

    placement: Placement
    hypotheses: tuple[Hypothesis, ...]
    tried: Tried = NOTHING


@dataclass(frozen=True, eq=False)
class PairedPlacement:
    """A placement whose poles one hypothesis pairs."""

    placement: Placement
    hypothesis: Hypothesis

    @property
    def target_poles(self) -> list[Pole]:
        """The paired poles of the target."""
        return [self.placement.target.poles[i] for i, _ in self.hypothesis.match.pairs]

    @property
    def source_poles(self) -> list[Pole]:
        """The paired poles of the source, in the order of the target's."""
        return [self.placement.source.poles[j] for _, j in self.hypothesis.match.pairs]

    def without(self, pair: tuple[int, int]) -> PairedPlacement:
        """The same with one pair of poles left out."""
        match = self.hypothesis.match
        left = tuple(each for each in match.pairs if each != pair)
        return replace(self, hypothesis=replace(self.hypothesis, match=replace(match, pairs=left)))


@dataclass(frozen=True, eq=False)
class Choice:
    """A pose that recurs: the joint hypothesis, and every placement paired by its hypothesis."""

    joint: Hypothesis
    paired: tuple[PairedPlacement, ...]


@dataclass(frozen=True, eq=False)
class Chosen:
    """The pose that the poles and the scene agree on: every placement paired by it; or why none.

    Attributes
    ----------
    hypotheses
        The selected one, then all others, the best first.
    paired, refusal
        Every placement, its poles paired by the selected one; or why there is none.
    choices, place
        All that could be selected, the best first, and the position of the selected one.
    scored
        Every placement with its hypotheses, as the scene scored them; empty if none match.
    """

    hypotheses: tuple[Hypothesis, ...]
    paired: tuple[PairedPlacement, ...]
    refusal: Refusal | None = None
    choices: tuple[Choice, ...] = ()
    place: int = 0
    scored: tuple[PlacementHypotheses, ...] = ()


def find_recurring(scored: Sequence[PlacementHypotheses]) -> list[Choice]:
    """Find the poses that recur in all placements, the best score first.

    Raises
    ------
    Refusal
        ``placements_disagree`` if no pose recurs.
    """
    choices = []
    first, *others = scored
    poles = [pole.point for each in scored for pole in each.placement.source.poles]
    at = np.array(poles or [np.zeros(3)])
    nearest = np.inf
    for hypothesis in first.hypotheses:
        if not hypothesis.match.exact:
            continue
        paired = [PairedPlacement(first.placement, hypothesis)]
        for other in others:
            apart, best = _nearest(hypothesis, other.hypotheses, at)
            if apart.rotation > AGREE_ANGLE or apart.translation > AGREE_DISTANCE:
                nearest = min(nearest, apart.translation)
                break
            paired.append(PairedPlacement(other.placement, best))
        else:
            choices.append(Choice(_joint([each.hypothesis for each in paired]), tuple(paired)))
    if not choices:
        raise Refusal(
            "placements_disagree",
            f"no pose fits all {len(scored)} placements; the nearest two poses differ by "
            f"{nearest:.2f} m: did a LiDAR move between them, or are the files of a placement "
            "swapped?",
            {"placements": len(scored), "nearest_m": nearest},
        )
    return sorted(choices, key=lambda choice: -choice.joint.score)


def rank_joint_hypotheses(
    choices: Sequence[Choice], scored: Sequence[PlacementHypotheses]
) -> tuple[Hypothesis, ...]:
    """List the joint hypotheses, the best first; of a single placement, all others after them."""
    joint = tuple(choice.joint for choice in choices)
    if len(scored) > 1:
        return joint
    matches = [h.match for h in joint]
    others = [h for h in scored[0].hypotheses if all(h.match is not match for match in matches)]
    return (*joint, *others)


def _nearest(
    hypothesis: Hypothesis, others: Sequence[Hypothesis], at: Array
) -> tuple[se3.PoseDifference, Hypothesis]:
    """Find the exact hypothesis of another placement whose pose is nearest, and how near it is."""
    T = hypothesis.match.T_target_source
    gaps = [(se3.difference_at(T, h.match.T_target_source, at), h) for h in others if h.match.exact]
    return min(
        gaps,
        key=lambda gap: gap[0].rotation / AGREE_ANGLE + gap[0].translation / AGREE_DISTANCE,
    )


def _joint(each: Sequence[Hypothesis]) -> Hypothesis:
    """Average the scores by the scenes of all placements; pose and pairs are those of the first."""
    overlap = float(np.mean([h.overlap for h in each]))
    violation = float(np.mean([h.free_space_violation for h in each]))
    covisible = [h.covisible_overlap for h in each if h.covisible_overlap is not None]
    return replace(
        each[0],
        overlap=overlap,
        free_space_violation=violation,
        score=overlap - violation,
        covisible_overlap=float(np.mean(covisible)) if covisible else None,
    )


def align(
    paired: Sequence[PairedPlacement], T_start: Array, *, radius: float, radius_sigma: float
) -> BeamAlignment:
    """Align the paired poles of all placements by the beams that can have hit them.

    If those of every placement leave a part of the pose to the surroundings, that part is
    constrained to `T_start`.
    """
    if has_no_poles(paired):
        return without_poles(T_start, radius)
    target = [(pole, each.placement.target.cloud) for each in paired for pole in each.target_poles]
    source = [(pole, each.placement.source.cloud) for each in paired for pole in each.source_poles]
    first, second = paired[0].placement.scans
    return align_beams(
        beams_of(target, first.sensor),
        beams_of(source, second.sensor),
        T_start,
        radius=radius,
        radius_sigma=radius_sigma,
        sizes=(error_sizes(first.cloud, first.sensor), error_sizes(second.cloud, second.sensor)),
        placement=np.repeat(np.arange(len(paired)), [len(each.target_poles) for each in paired]),
        by_place=is_by_place(paired),
        left=remaining_sway_in([each.placement for each in paired]),
    )


def remaining_sway_in(placements: Sequence[Placement]) -> tuple[Array, ...]:
    """The remaining sway of target and source, (6, 6) each; empty if neither swayed."""
    both = zip(*(each.scans for each in placements), strict=True)
    return remaining_sway_of_each([[scan.sway for scan in own] for own in both])


def is_by_place(paired: Sequence[PairedPlacement]) -> bool:
    """Whether a part of the pose is from the surroundings, since the poles of no placement
    determine it."""
    return all(each.hypothesis.match.by_place for each in paired)


def has_no_poles(paired: Sequence[PairedPlacement]) -> bool:
    """Whether the whole pose is from the surroundings."""
    return not any(each.hypothesis.match.pairs for each in paired)


def leave_one_out(
    paired: Sequence[PairedPlacement],
    aligned: BeamAlignment,
    *,
    radius: float,
    radius_sigma: float,
) -> tuple[Placement, ...]:
    """For each of several placements: the change of the pose from the poles without it."""
    if len(paired) < 2:
        return tuple(each.placement for each in paired)
    T = aligned.pose.T_target_source
    found = []
    for one in paired:
        try:
            others = [each for each in paired if each is not one]
            without = align(others, T, radius=radius, radius_sigma=radius_sigma)
        except Refusal:
            found.append(one.placement)
            continue
        apart = se3.difference(T, without.pose.T_target_source)
        found.append(replace(one.placement, left_out=apart))
    return tuple(found)


def merge_clouds(clouds: Sequence[PointCloud]) -> PointCloud:
    """Merge the clouds of one LiDAR, to find the objects that are static in all clouds.

    Its sweeps are those of all; a cloud without any is one.
    """
    if len(clouds) == 1:
        return clouds[0]
    sweeps, first = [], 0
    for cloud in clouds:
        own = np.zeros(len(cloud), dtype=np.int64) if cloud.frame is None else cloud.frame
        sweeps.append(first + own)
        first = 1 + int(sweeps[-1].max(initial=first))
    rings = [cloud.ring for cloud in clouds if cloud.ring is not None]
    return PointCloud(
        np.concatenate([cloud.xyz for cloud in clouds]),
        ring=np.concatenate(rings) if len(rings) == len(clouds) else None,
        frame=np.concatenate(sweeps),
        origin=clouds[0].origin,
        axis=clouds[0].axis,
    )
