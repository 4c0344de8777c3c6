"""How what the LiDARs see is laid on a survey: poles by their shape, control points by name."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..base import se3
from ..base.datatypes import Array, Pole
from ..base.errors import Refusal
from ..base.quantities import counted
from ..matching.correspondence import match_poles
from .description import Site, SurveyedPole
from .shared import SharedPole

NEAR = 0.5
"""A surveyed end or control point lies so near what the LiDARs see of it, metres: the poses may be
off by as much before they are adjusted, and a blunder of a decimetre is to be found, not missed."""

WITHIN = 0.3
"""Returns on a pole lie between its surveyed ends, or so far beyond them, metres: a wrong end of
the tape, and the poles' pose along the pole."""

SAMPLES = 5
"""Points on a surveyed pole that stand for returns when it is matched."""

LEAST_BASE = 0.3
"""Control points nearer to one line than this fix no frame, metres."""


@dataclass(frozen=True, eq=False)
class _Fit:
    """A way of laying what the LiDARs see on the survey: how much fits, and its rms, metres."""

    T: Array
    met: int
    rms: float


def on_survey(
    site: Site, origins: Array, poses: dict[int, Array], poles: Sequence[SharedPole]
) -> Array:
    """Find the pose (4, 4) of what the LiDARs see in the frame of the survey."""
    fits: list[_Fit] = []
    for T in (*_by_poles(site, poles), *_by_points(site, origins, poses)):
        fit = _fit(T, site, origins, poses, poles)
        if fit is not None and not any(_same(fit.T, other.T, poles) for other in fits):
            fits.append(fit)
    if not fits:
        raise Refusal(
            "survey_unmatched",
            f"nothing that was surveyed ({counted(len(site.poles), 'pole')}, "
            f"{counted(len(site.points), 'control point')}) fits what the LiDARs see: two poles "
            "with both ends, or three control points that are not in line, fix the frame; check "
            "placements, names and units",
            {"poles": len(site.poles), "points": len(site.points)},
        )
    fits.sort(key=lambda fit: (-fit.met, fit.rms))
    best, rivals = fits[0], [fit for fit in fits[1:] if fit.met == fits[0].met]
    if rivals and rivals[0].rms < 2.0 * max(best.rms, 0.02):
        raise Refusal(
            "survey_ambiguous",
            f"what was surveyed fits what the LiDARs see in {1 + len(rivals)} ways, to "
            f"{1000 * best.rms:.0f} and {1000 * rivals[0].rms:.0f} mm: survey a third pole, both "
            "ends of each, or a control point",
            {"ways": 1 + len(rivals), "rms_m": best.rms, "rival_rms_m": rivals[0].rms},
        )
    return best.T


def _by_poles(site: Site, poles: Sequence[SharedPole]) -> Iterator[Array]:
    """Lay the axes that the LiDARs see on the surveyed ones: LiDARs and survey stand still, so that
    poles of all placements count together.
    """
    known = [each for each in site.poles if each.foot is not None and each.top is not None]
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
    """Lay the control points that the LiDARs see on the surveyed ones (Kabsch 1976)."""
    known, seen = [], []
    for point in site.points:
        for sight in point.seen:
            if sight.lidar in poses:
                known.append(point.at)
                about = sight.at - origins[sight.lidar]
                seen.append(se3.apply(poses[sight.lidar], about[None])[0])
    if len(known) < 3:
        return
    a, b = np.array(known), np.array(seen)
    centred = a - a.mean(axis=0), b - b.mean(axis=0)
    if np.linalg.svd(centred[0])[1][1] < LEAST_BASE:
        return
    U, _, Vt = np.linalg.svd(centred[0].T @ centred[1])
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    yield se3.from_rt(R, a.mean(axis=0) - R @ b.mean(axis=0))


def _fit(
    T: Array, site: Site, origins: Array, poses: dict[int, Array], poles: Sequence[SharedPole]
) -> _Fit | None:
    """How much of the survey fits under a pose; None where it fixes no frame or does not fit."""
    gaps: list[float] = []
    lines = points = 0
    for each in site.poles:
        found = pole_at(each, [transformed(pole, T) for pole in poles])
        if found is not None:
            ends = [end for end in (each.foot, each.top) if end is not None]
            gaps += [_beside(end, found) for end in ends]
            lines += len(ends) == 2
    for point in site.points:
        for sight in point.seen:
            if sight.lidar in poses:
                about = (sight.at - origins[sight.lidar])[None]
                there = se3.apply(T @ poses[sight.lidar], about)[0]
                gap = float(np.linalg.norm(there - point.at))
                if gap < NEAR:
                    gaps.append(gap)
                    points += 1
    if lines < 2 and points < 3 and not (lines and points):
        return None
    return _Fit(T, len(gaps), float(np.sqrt(np.mean(np.square(gaps)))))


def pole_at(each: SurveyedPole, poles: Sequence[SharedPole]) -> SharedPole | None:
    """Find the pole that a surveyed one is, in the frame of the survey."""
    ends = [end for end in (each.foot, each.top) if end is not None]
    near = [
        pole
        for pole in poles
        if pole.placement == each.placement
        and max(_beside(end, pole) for end in ends) < NEAR
        and _is_between(each, pole)
    ]
    return min(near, key=lambda pole: max(_beside(end, pole) for end in ends), default=None)


def _beside(end: Array, pole: SharedPole) -> float:
    """How far a point is from the axis of a pole, metres."""
    return float(np.linalg.norm(np.cross(end - pole.point, pole.direction)))


def _is_between(each: SurveyedPole, pole: SharedPole) -> bool:
    """Whether the returns on a pole lie between its surveyed ends, as far as these are known."""
    if each.foot is None or each.top is None:
        end = each.foot if each.foot is not None else each.top
        assert end is not None
        along = (pole.extent - end) @ pole.direction
        # All on one side of it.
        return bool(min(along.max(), -along.min()) < WITHIN)
    length = float(np.linalg.norm(each.top - each.foot))
    along = (pole.extent - each.foot) @ (each.top - each.foot) / length
    return bool(along.min() > -WITHIN and along.max() < length + WITHIN)


def _same(T: Array, other: Array, poles: Sequence[SharedPole]) -> bool:
    at = np.array([pole.point for pole in poles]) if poles else np.zeros((1, 3))
    return se3.difference_at(T, other, at).translation < NEAR


def transformed(pole: SharedPole, T: Array) -> SharedPole:
    """Express a pole in another frame."""
    return replace(
        pole,
        point=se3.apply(T, pole.point[None])[0],
        direction=T[:3, :3] @ pole.direction,
        extent=se3.apply(T, pole.extent),
    )
