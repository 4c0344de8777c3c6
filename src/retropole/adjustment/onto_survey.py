"""How what the LiDARs see is laid on a survey: poles by their shape, control points by name."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from ..base import se3
from ..base.datatypes import Array, Pole
from ..base.description import Site, SurveyedPole
from ..base.errors import Refusal
from ..hypotheses.correspondence import match_poles
from .shared import SharedPole

NEAR_SURVEYED = 0.5
"""A surveyed end or control point lies so near what the LiDARs see of it, metres: the poses may be
off by as much before they are adjusted, and a blunder of a decimetre is to be found, not missed."""

BESIDE_END = 0.3
"""Returns on a pole of which one end was surveyed lie on one side of it, or so far beyond, metres:
a wrong end of the tape, and the poles' pose along the pole."""

ROUGH = 0.1
"""Poses may be off by as much before they are adjusted, metres: a survey that fits so well is laid
no better, and one that fits worse is no frame of its own."""

SAMPLES = 5
"""Points on a surveyed pole that stand for returns when it is matched."""

LEAST_BASE = 0.3
"""Control points nearer to one line than this fix no frame, metres."""

MOST_TRIPLES = 60
"""Triples of control points that are tried, evenly of all there are."""


@dataclass(frozen=True, eq=False)
class Fit:
    """A way of laying what the LiDARs see on the survey, and what of the survey is met under it.

    Attributes
    ----------
    T
        (4, 4) survey from the frame of the poses.
    poles, sightings
        Indices of the surveyed poles, and of the control points and their sightings.
    ends
        How many ends of poles and sightings are met.
    rms
        How far they are beside what is seen, metres.
    """

    T: Array
    poles: frozenset[int]
    sightings: frozenset[tuple[int, int]]
    ends: int
    rms: float

    @property
    def points(self) -> frozenset[int]:
        """Indices of the control points of which a sighting is met."""
        return frozenset(q for q, _ in self.sightings)


def every_fit(
    site: Site, origins: Array, poses: dict[int, Array], poles: Sequence[SharedPole]
) -> list[Fit]:
    """Find the ways of laying what the LiDARs see on the survey, the one that meets most first."""
    fits: list[Fit] = []
    for T in (*_by_poles(site, poles), *_by_points(site, origins, poses)):
        same = [k for k, other in enumerate(fits) if _same(T, other.T, poles)]
        if same and fits[same[0]].rms < ROUGH:
            continue
        fit = _fit(T, site, origins, poses, poles)
        if fit is None:
            continue
        if not same:
            fits.append(fit)
        elif order(fit) < order(fits[same[0]]):
            fits[same[0]] = fit
    return sorted(fits, key=order)


def order(fit: Fit) -> tuple[float, float]:
    """Those that meet most come first, each end by how well: the less the farther it is beside.

    A truncated quadratic (Torr and Zisserman 2000): one more that is met to half a metre, with
    all others pulled along, is no more than what fits to centimetres.
    """
    return -fit.ends * (1.0 - (fit.rms / NEAR_SURVEYED) ** 2), fit.rms


def fixes_frame(site: Site, poles: frozenset[int], points: frozenset[int]) -> bool:
    """Whether some of what was surveyed fixes a frame by itself."""
    return sum(_is_line(site.poles[k]) for k in poles) >= 2 or len(points) >= 3


def _is_line(each: SurveyedPole) -> bool:
    return each.foot is not None and each.top is not None


def _by_poles(site: Site, poles: Sequence[SharedPole]) -> Iterator[Array]:
    """Lay the axes that the LiDARs see on the surveyed ones: LiDARs and survey stand still, so that
    poles of all placements count together.
    """
    known = [each for each in site.poles if _is_line(each)]
    if len(known) < 2 or len(poles) < 2:
        return
    target = [_line(each.foot, each.top) for each in known]
    source = [_line(*pole.extent) for pole in poles]
    try:
        matches = match_poles(target, source, part=True)
    except Refusal:
        return
    for match in matches:
        if match.exact:
            yield match.T_target_source


def _line(foot: Array | None, top: Array | None) -> Pole:
    """Take two ends of an axis for a pole."""
    assert foot is not None
    assert top is not None
    along = np.linspace(0.0, 1.0, SAMPLES)[:, None]
    length = float(np.linalg.norm(top - foot))
    return Pole(
        point=(foot + top) / 2,
        direction=(top - foot) / max(length, 1e-9),
        xyz=foot + along * (top - foot),
        length=length,
        rms=0.0,
        rings=SAMPLES,
        index=np.arange(SAMPLES),
    )


def _by_points(site: Site, origins: Array, poses: dict[int, Array]) -> Iterator[Array]:
    """Lay the control points that the LiDARs see on the surveyed ones, and every three of them."""
    known, seen = [], []
    for q, point in enumerate(site.points):
        at = [there for _, there in sightings_of(site, q, origins, poses)]
        if at:
            known.append(point.at)
            seen.append(np.median(at, axis=0))
    a, b = np.array(known), np.array(seen)
    every = list(combinations(range(len(known)), 3))
    triples = every[:: 1 + len(every) // MOST_TRIPLES]
    for some in ([tuple(range(len(known)))] if len(known) > 3 else []) + triples:
        own = list(some)
        T = _onto(a[own], b[own])
        # Triangles of another shape are none of the same points.
        if T is not None and se3.lengths(se3.apply(T, b[own]) - a[own]).max() < NEAR_SURVEYED:
            yield T


def sightings_of(
    site: Site, point: int, origins: Array, poses: dict[int, Array]
) -> Iterator[tuple[int, Array]]:
    """Index of each sighting of a control point, and (3,) where it lies in the poses' frame."""
    for k, sight in enumerate(site.points[point].seen):
        if sight.lidar in poses:
            about = (sight.at - origins[sight.lidar])[None]
            yield k, se3.apply(poses[sight.lidar], about)[0]


def _onto(a: Array, b: Array) -> Array | None:
    """(4, 4) that lays points b (N, 3) on points a (Kabsch 1976); None where they are in line."""
    centred = a - a.mean(axis=0), b - b.mean(axis=0)
    if np.linalg.svd(centred[0])[1][1] < LEAST_BASE:
        return None
    U, _, Vt = np.linalg.svd(centred[0].T @ centred[1])
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return se3.from_rt(R, a.mean(axis=0) - R @ b.mean(axis=0))


def _fit(
    T: Array, site: Site, origins: Array, poses: dict[int, Array], poles: Sequence[SharedPole]
) -> Fit | None:
    """Tell what of the survey is met under a pose; None where it fixes no frame or is not met."""
    gaps: list[float] = []
    met: set[int] = set()
    sightings: set[tuple[int, int]] = set()
    there = [transformed(pole, T) for pole in poles]
    for k, each in enumerate(site.poles):
        found = pole_at(each, there)
        if found is not None:
            gaps += [beside(end, found) for end in ends_of(each)]
            met.add(k)
    for q, point in enumerate(site.points):
        for k, seen in sightings_of(site, q, origins, poses):
            gap = float(np.linalg.norm(se3.apply(T, seen[None])[0] - point.at))
            if gap < NEAR_SURVEYED:
                gaps.append(gap)
                sightings.add((q, k))
    lines = sum(_is_line(site.poles[k]) for k in met)
    if lines < 2 and len(sightings) < 3 and not (lines and sightings):
        return None
    rms = float(np.sqrt(np.mean(np.square(gaps))))
    return Fit(T, frozenset(met), frozenset(sightings), len(gaps), rms)


def ends_of(each: SurveyedPole) -> list[Array]:
    """(3,) each, the ends of a pole that were surveyed."""
    return [end for end in (each.foot, each.top) if end is not None]


def pole_at(each: SurveyedPole, poles: Sequence[SharedPole]) -> SharedPole | None:
    """Find the pole that a surveyed one is, in the frame of the survey."""
    near = [
        pole
        for pole in poles
        if pole.placement == each.placement
        and farthest_beside(each, pole) < NEAR_SURVEYED
        and _is_between(each, pole)
    ]
    return min(near, key=lambda pole: farthest_beside(each, pole), default=None)


def farthest_beside(each: SurveyedPole, pole: SharedPole) -> float:
    """How far the worse end of a surveyed pole is from the axis of one that is seen, metres."""
    return max(beside(end, pole) for end in ends_of(each))


def beside(end: Array, pole: SharedPole) -> float:
    """How far a point is from the axis of a pole, metres."""
    return float(np.linalg.norm(np.cross(end - pole.point, pole.direction)))


def _is_between(each: SurveyedPole, pole: SharedPole) -> bool:
    """Whether the returns on a pole lie between its surveyed ends, most of them, as far as known.

    Not all: height is what rough poses know least, and something bright on a pole makes it longer.
    """
    if each.foot is None or each.top is None:
        (end,) = ends_of(each)
        along = (pole.extent - end) @ pole.direction
        # All on one side of it.
        return bool(min(along.max(), -along.min()) < BESIDE_END)
    length = float(np.linalg.norm(each.top - each.foot))
    along = (pole.extent - each.foot) @ (each.top - each.foot) / length
    between = min(along.max(), length) - max(along.min(), 0.0)
    return bool(between > np.ptp(along) / 2)


def _same(T: Array, other: Array, poles: Sequence[SharedPole]) -> bool:
    at = np.array([pole.point for pole in poles]) if poles else np.zeros((1, 3))
    return se3.difference_at(T, other, at).translation < NEAR_SURVEYED


def transformed(pole: SharedPole, T: Array) -> SharedPole:
    """Express a pole in another frame."""
    return replace(
        pole,
        point=se3.apply(T, pole.point[None])[0],
        direction=T[:3, :3] @ pole.direction,
        extent=se3.apply(T, pole.extent),
    )
