"""Whether a cloud is mirrored or scaled: what a rigid motion cannot put right, named as such.

After a refusal the poles are matched again with one cloud mirrored, and with one cloud scaled. What
is found counts only where the scene then agrees well, and clearly better than under any rigid
motion: under those that the poles allow, and under those that come nearest to what was found, since
a place may be its own mirror image but for a few things in it. It never gives a pose.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from ..adjustment.refinement import Refinement
from ..base import se3
from ..base.datatypes import MAX_RADIUS, Array, Hypothesis, Placement, Scan
from ..base.errors import Refusal
from ..hypotheses.similar import Change, changed_cloud
from ..hypotheses.similarity_search import LEAST_CHANGE, Found, find_change, find_mirror
from ..io.coordinates import Oddity, oddity_of
from ..io.fields import METRES, NAMES, Unit
from ..surfaces.scans import find_poles
from .same_unit import InUnit, common_unit

EXPLAINED = {
    *("too_few_poles", "parallel_poles", "no_match", "pole_count", "ambiguous", "no_overlap"),
    *("placements_disagree", "poor_fit", "poles_inconsistent", "degenerate_poles"),
    *("poles_scene_contradict", "scene_contradicts", "prior_contradicted", "far_from_lidar"),
}
"""Refusals that a mirrored or scaled cloud may cause."""

SCALE_SIGMAS = 3.0
"""An answer's scale is contradicted where it is off by more than `LEAST_CHANGE` and so many σ."""

_LIKELY: tuple[Unit, ...] = ("ft", "in", "cm", "mm")

UNITS = {NAMES[unit]: METRES[unit] for unit in _LIKELY}
"""Units that clouds come in, metres."""

SAME_UNIT = 0.02
"""A factor is taken for that of a unit where it differs by no larger part."""

REACH_RATIO = 2.5
"""A unit is tried where it brings the median ranges of both clouds to within this factor."""

LEVEL = 0.5
"""Cosine between the LiDARs' axes from which both stand upright, or one is upside down."""


def explain(
    refusal: Refusal,
    placements: Sequence[Placement],
    hypotheses: Sequence[Hypothesis],
    *,
    radius: float,
    thresholds: tuple[float | None, float | None] = (None, None),
) -> Refusal:
    """Say of a refusal where a mirrored or scaled cloud is its cause.

    Parameters
    ----------
    refusal
        Why there is no answer.
    placements
        What was found.
    hypotheses
        Rigid poses from the source of the first placement; empty where the poles gave none.
    radius
        Of the poles, metres.
    thresholds
        Intensity from which a return counts as retro-reflective, in each cloud.

    Returns
    -------
    Refusal
        ``mirrored``, ``wrong_scale`` or ``wrong_unit``; the same as was given where none is found,
        with a hint where another unit, or other poles, would explain it.
    """
    if refusal.code not in EXPLAINED or not placements:
        return refusal
    first = placements[0]
    poles = min(len(first.target.poles), len(first.source.poles))
    if poles > 1:
        rigid = [each.match.T_target_source for each in hypotheses]
        found = find_change(first, rigid)
        if found is not None:
            return _refusal(*found, first)
    for factor, changed in _in_other_units(first, radius, thresholds):
        found = find_change(changed, (), is_changed=True)
        if found is not None:
            best, rival = found
            change = replace(best.change, factor=best.change.factor * factor)
            return _refusal(replace(best, change=change), rival, first)
    shown = common_unit(first, radius, thresholds) if poles < 2 else None
    odd = _in_no_metres(placements)
    if shown is None:
        return odd or refusal
    return _in_common_unit(shown, radius, refusal, odd)


def check_similarity(refined: Refinement | None, placements: Sequence[Placement], T: Array) -> None:
    """Refuse an answer whose surfaces want another scale, or whose clouds fit better mirrored.

    Parameters
    ----------
    refined
        What the scene made of the pose.
    placements
        What was found; the first is tried mirrored.
    T
        (4, 4) the answer, target from source.

    Raises
    ------
    Refusal
        ``wrong_scale`` or ``mirrored``.
    """
    found = find_mirror(placements[0], T)
    if found is not None:
        raise _refusal(*found, placements[0])
    if refined is None or refined.scale is None:
        return
    factor, sigma = refined.scale
    if abs(factor - 1.0) <= max(LEAST_CHANGE, SCALE_SIGMAS * sigma):
        return
    raise Refusal(
        "wrong_scale",
        f"lengths in the source must be multiplied by {factor:.4f} (1 σ: {sigma:.4f}) to be those "
        f"in the target{_unit_words(factor)}: one of the two clouds is scaled, or the pose is "
        "wrong",
        {"factor": factor, "sigma": sigma, **_unit_values(factor)},
    )


def _in_other_units(
    placement: Placement, radius: float, thresholds: tuple[float | None, float | None]
) -> Iterator[tuple[float, Placement]]:
    """Find the poles again with one cloud brought to the other's unit; the source's factor first.

    In feet a pole of 4 cm is as thick as one of 13 cm, and is none.
    """
    clouds = placement.target.cloud, placement.source.cloud

    def searched(lidar: int, factor: float) -> Scan:
        return find_poles(
            changed_cloud(clouds[lidar], Change(factor)),
            sensor=placement.scans[lidar].sensor,
            threshold=thresholds[lidar],
            radius=radius,
        )

    if any(len(cloud) == 0 or np.abs(cloud.xyz).max() > se3.FARTHEST for cloud in clouds):
        return
    far = [float(np.median(np.linalg.norm(each.xyz - each.origin, axis=1))) for each in clouds]
    for unit in UNITS.values():
        for factor in (unit, 1.0 / unit):
            off = abs(np.log(far[0] / (factor * far[1])))
            is_near = off < min(np.log(REACH_RATIO), abs(np.log(far[0] / far[1])))
            if not is_near:
                continue
            source = searched(1, factor)
            if len(source.poles) > 1 and len(placement.target.poles) > 1:
                yield factor, replace(placement, source=source)
            target = searched(0, 1.0 / factor)
            if len(target.poles) > 1 and len(placement.source.poles) > 1:
                yield factor, replace(placement, target=target)


def _in_no_metres(placements: Sequence[Placement]) -> Refusal | None:
    """Say which clouds have ranges that are no metres; None where all may be metres."""
    odd: dict[str, Oddity] = {}
    for placement in placements:
        for name, scan in (("target", placement.target), ("source", placement.source)):
            found = None if name in odd else oddity_of(scan.cloud)
            if found is not None and found.is_tiny:
                return Refusal("wrong_unit", f"of the {name}, {found.words}", {"lidars": name})
            if found is not None and found.units:
                odd[name] = found
    if not odd:
        return None
    first, *others = odd.values()
    common = tuple(unit for unit in first.units if all(unit in each.units for each in others))
    told = replace(first, units=common or first.units)
    whose = "both clouds' points" if others else f"the {next(iter(odd))}'s points"
    options = " or ".join(_options(unit, list(odd)) for unit in told.units)
    return Refusal(
        "wrong_unit",
        f"half of {whose} are beyond {min(each.half for each in odd.values()):,.0f}, which no "
        f"LiDAR sees in metres: they look like {told.candidates}; if they are, read them with "
        f"{options}",
        {"lidars": " and ".join(odd), "half": told.half, "units": " or ".join(told.units)},
    )


def _in_common_unit(shown: InUnit, radius: float, refusal: Refusal, odd: Refusal | None) -> Refusal:
    """Say in which unit both clouds show poles; nothing else tells feet from thicker poles."""
    target, source, agreed = shown
    unit, thicker = target.unit, (target.radius_before + source.radius_before) / 2
    said = (
        f"read as {NAMES[unit]}, the target shows {len(target.scan.poles)} poles of radius "
        f"{radius:g} m and the source {len(source.scan.poles)}, which fit each other, and "
        f"{agreed.agreeing} of {agreed.total} voxels off the ground agree"
    )
    values = {"unit": unit, "unit_m": METRES[unit], "agreeing": agreed.agreeing}
    if odd is not None or thicker > MAX_RADIUS:
        message = f"the coordinates look like {NAMES[unit]}: {said}; read them with --unit {unit}"
        return Refusal("wrong_unit", message, {"lidars": "target and source", **values})
    hint = (
        f"{said}: either the coordinates are in {NAMES[unit]} (--unit {unit}), or the poles are "
        f"{thicker / radius:.2g} times as thick as given (--radius {thicker:.2g})"
    )
    return Refusal(refusal.code, f"{refusal.message}; {hint}", {**refusal.values, **values})


def _options(unit: Unit, lidars: Sequence[str]) -> str:
    if len(lidars) > 1:
        return f"--unit {unit}"
    return f"--unit-source {unit}" if lidars[0] == "source" else f"--unit {unit} --unit-source m"


def _refusal(found: Found, rigid: Found | None, placement: Placement) -> Refusal:
    agreed = found.agreed
    figures = {
        "agreeing": agreed.agreeing,
        "contradicting": agreed.contradicting,
        **({} if rigid is None else {"rigid_agreeing": rigid.agreed.agreeing}),
        **({} if rigid is None else {"rigid_contradicting": rigid.agreed.contradicting}),
    }
    shown = f"{agreed.agreeing} of {agreed.total} voxels off the ground then agree"
    if rigid is not None:
        shown += f", {rigid.agreed.agreeing} of {rigid.agreed.total} under the best rigid motion"
    if not found.change.mirrored:
        factor = found.change.factor
        return Refusal(
            "wrong_scale",
            f"lengths in the source must be multiplied by {factor:.4f} to be those in the target"
            f"{_unit_words(factor)}: {shown}; bring both clouds to metres",
            {"factor": factor, **_unit_values(factor), **figures},
        )
    axis = _mirrored_axis(found, placement)
    words = {
        "horizontal": "one horizontal axis",
        "vertical": "the vertical axis, or a horizontal one where a LiDAR hangs upside down,",
        "unknown": "one axis",
    }[axis]
    return Refusal(
        "mirrored",
        f"{words} of one of the two clouds is reversed: {shown}; look at the driver's axes "
        "(left-handed?), and at what converted the files",
        {"axis": axis, "lidar": "one of the two", **figures},
    )


def _mirrored_axis(found: Found, placement: Placement) -> str:
    """Which axis is reversed, as far as the LiDARs' own axes tell under the pose.

    Two horizontal ones differ by a rotation about the vertical one.
    """
    moved = found.T[:3, :3] @ changed_cloud(placement.source.cloud, found.change).axis
    cosine = float(placement.target.cloud.axis @ moved)
    if abs(cosine) < LEVEL:
        return "unknown"
    return "horizontal" if cosine > 0 else "vertical"


def _unit_of(factor: float) -> str | None:
    """Name the unit that one of two clouds is in, where a factor is that of one to metres."""
    for name, size in UNITS.items():
        if abs(abs(np.log(factor)) + np.log(size)) < SAME_UNIT:
            return name
    return None


def _unit_words(factor: float) -> str:
    name = _unit_of(factor)
    if name is None:
        return ""
    lidar = "source" if factor < 1 else "target"
    unit = next((unit for unit, known in NAMES.items() if known == name), None)
    option = "" if unit is None else f" Then read it with {_options(unit, [lidar])}"
    return f" ({UNITS[name]:g}: is the {lidar} in {name}?{option})"


def _unit_values(factor: float) -> dict[str, float | int | str]:
    name = _unit_of(factor)
    return {} if name is None else {"unit": name, "unit_m": UNITS[name]}
