"""Whether a cloud is mirrored, scaled or in another unit: reported, and never corrected.

After a refusal the poles are matched again with one cloud mirrored, and with one cloud scaled. A
result is used only if the scene then agrees well, and clearly better than under
any rigid motion: those that the poles allow, and those nearest to the result, since a
place may be its mirror image except for a few objects. It never gives a pose.

Then each cloud is read in other units. A cloud in feet looks like one in metres in which a
pole of 4 cm is 13 cm thick. So the given radius of the poles shows the unit: if a cloud read in
a unit shows poles of that width, and they and the scene fit the other cloud, it is in
that unit. If both clouds show such poles in one other unit and none in metres, the coordinates
are in that unit, or the poles are thicker than stated by the same factor. The clouds do not
show which of both is the case: everything is scaled equally.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..adjustment.refinement import Refinement
from ..alignment.certainty import MAX_NORMAL
from ..base import se3
from ..base.datatypes import MAX_RADIUS, Array, Hypothesis, Placement, PointCloud, Scan
from ..base.errors import Refusal
from ..base.sensors import SENSORS
from ..hypotheses.similarity import (
    LEAST_CHANGE,
    Found,
    changed_cloud,
    find_change,
    find_fit,
    find_mirror,
)
from ..io.beams import guess_sensors, with_beam_origin
from ..io.coordinates import FARTHEST_HALF, NEAREST_HALF, oddity_of
from ..io.fields import METRES, NAMES, Unit
from ..surfaces.scans import find_poles

EXPLAINED = {
    *("too_few_poles", "parallel_poles", "no_match", "pole_count", "ambiguous", "no_overlap"),
    *("placements_disagree", "poor_fit", "poles_inconsistent", "degenerate_poles"),
    *("poles_scene_contradict", "scene_contradicts", "prior_contradicted", "far_from_lidar"),
}
"""Refusals that a mirrored or scaled cloud may cause."""

UNITS: tuple[Unit, ...] = ("ft", "in", "cm", "mm")
"""Units that coordinates may be in."""

LEVEL = 0.5
"""Cosine between the LiDARs' axes from which both are upright, or one is upside down."""

WIDTHS = 0.75, 2.0
"""Half the width of the returns of a pole, across the beam, in units of the given radius. In the
right unit it was 0.81 to 1.68 of it in 98 simulated clouds, since beams are wide, in another up to
0.70, and 0.71 to 0.94 where poles of 50 mm in metres were read in feet as 20 mm (corridors, streets
and harbors of `benchmarks/units.py`, seeds 0 to 11, and the street that `simulate --seed 1` draws).
"""

WIDTH_QUANTILES = 0.05, 0.95
"""The width of a pole is taken between these quantiles of its returns, so that a single return next
to it has no effect."""

Thresholds = tuple[float | None, float | None]


class Reading(NamedTuple):
    """A cloud whose coordinates are multiplied, and the poles that it then shows.

    Attributes
    ----------
    scan
        With two poles or more, whose width agrees with their radius.
    radius_before
        Of these poles in the cloud as it was read before.
    """

    scan: Scan
    radius_before: float


def explain(
    refusal: Refusal,
    placements: Sequence[Placement],
    hypotheses: Sequence[Hypothesis],
    *,
    radius: float,
    thresholds: Thresholds = (None, None),
) -> Refusal:
    """Replace a refusal if a mirrored or scaled cloud is its cause.

    Parameters
    ----------
    refusal
        Why there is no answer.
    placements
        What was found.
    hypotheses
        Rigid poses from the source of the first placement; empty if the poles gave none.
    radius
        Of the poles, metres.
    thresholds
        Intensity from which a return is treated as retro-reflective, in each cloud.

    Returns
    -------
    Refusal
        ``mirrored``, ``wrong_scale`` or ``wrong_unit``; the given one if no such cause is found,
        with a hint if another unit, or other poles, would explain it.
    """
    if refusal.code not in EXPLAINED or not placements:
        return refusal
    first = placements[0]
    shows_poles = min(len(scan.poles) for scan in first.scans) > 1
    if shows_poles:
        found = find_change(first, [each.match.T_target_source for each in hypotheses])
        if found is not None:
            return _refusal(*found, first)
    sizes = [METRES[unit] for unit in UNITS]
    read = _read_in(first, [*sizes, *(1.0 / size for size in sizes)], radius, thresholds)
    for size, (target, source) in read.items():
        if source and (fit := find_fit(replace(first, source=source.scan))):
            return _refusal(replace(fit, factor=fit.factor * size), None, first)
        if target and (fit := find_fit(replace(first, target=target.scan))):
            return _refusal(replace(fit, factor=fit.factor / size), None, first)
    odd = _in_no_metres(first)
    common = None if shows_poles else _in_common_unit(first, read, radius, refusal, odd)
    return common or odd or refusal


def check_unit(placement: Placement, *, radius: float, thresholds: Thresholds) -> None:
    """Refuse an answer without two confirmed poles if another unit shows poles that fit.

    Parameters
    ----------
    placement
        What was found.
    radius, thresholds
        As of `explain`.

    Raises
    ------
    Refusal
        ``wrong_unit``.
    """
    if min(len(scan.poles) for scan in placement.scans) > 1:
        return
    read = _read_in(placement, [METRES[unit] for unit in UNITS], radius, thresholds)
    doubt = Refusal(
        "wrong_unit", "in metres, the clouds do not show two poles that both LiDARs see", {}
    )
    found = _in_common_unit(placement, read, radius, doubt, _in_no_metres(placement))
    if found is not None:
        raise found


def _read_in(
    placement: Placement, sizes: Sequence[float], radius: float, thresholds: Thresholds
) -> dict[float, list[Reading | None]]:
    """Read both clouds in units of some sizes, metres."""
    given = list(zip(placement.scans, thresholds, strict=True))
    return {size: [_read_times(size, *each, radius) for each in given] for size in sizes}


def check_similarity(refined: Refinement | None, placements: Sequence[Placement], T: Array) -> None:
    """Refuse an answer whose surfaces need another scale, or whose clouds fit better mirrored.

    Parameters
    ----------
    refined
        The pose refined by the scene.
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
    factor, sigma = (1.0, 0.0) if refined is None or refined.scale is None else refined.scale
    if abs(factor - 1.0) > max(LEAST_CHANGE, MAX_NORMAL * sigma):
        because = "one of the two clouds is scaled, or the pose is wrong"
        raise _wrong_scale(factor, because, {"sigma": sigma}, f" (1 σ: {sigma:.4f})")


def unit_of_one(cloud: PointCloud, radius: float) -> tuple[Unit, Scan] | None:
    """Find the unit of one cloud whose ranges cannot be metres, by the poles that it shows in that
    unit.

    Poles alone do not show the unit of one cloud: in feet, bollards and signs are as thin as poles.
    Of 72 clouds in metres without poles, 4 showed two (`benchmarks/units.py`, seeds 1000 to 1035).

    Parameters
    ----------
    cloud
        As it was read.
    radius
        Of the poles, metres.

    Returns
    -------
    tuple of Unit and Scan, or None
        None if its ranges may be metres, if it shows poles in metres, or if no unit or several
        units show some.
    """
    if cloud.intensity is None or (oddity_of(cloud) is None and not beyond_sensors(cloud)):
        return None
    scan = find_poles(cloud, sensor=None, threshold=None, radius=radius)
    if len(scan.poles) > 1:
        return None
    read = [(unit, _read_times(METRES[unit], scan, None, radius)) for unit in UNITS]
    fitting = [(unit, each.scan) for unit, each in read if each is not None]
    return fitting[0] if len(fitting) == 1 else None


def beyond_sensors(cloud: PointCloud) -> float | None:
    """The longest range of all sensors that fit, if 1 % of a cloud is beyond it; else None."""
    sensors = guess_sensors(cloud)
    if not sensors:
        return None
    longest = max(SENSORS[name].max_range for name in sensors)
    ranges = se3.lengths(cloud.xyz - with_beam_origin(cloud).origin)
    return longest if float(np.quantile(ranges, 0.99)) > longest else None


def _read_times(size: float, scan: Scan, threshold: float | None, radius: float) -> Reading | None:
    """Multiply a cloud; None if the place or the poles then have no likely size."""
    cloud = scan.cloud
    if len(cloud) == 0 or np.abs(cloud.xyz).max() > se3.FARTHEST:
        return None
    half = size * float(np.median(se3.lengths(cloud.xyz - cloud.origin)))
    if not NEAREST_HALF <= half <= FARTHEST_HALF:
        return None
    cloud = changed_cloud(cloud, size)
    found = find_poles(cloud, sensor=scan.sensor, threshold=threshold, radius=radius)
    if len(found.poles) < 2:
        return None
    widths = []
    for pole in found.poles:
        side = np.cross(pole.direction, pole.point - found.cloud.origin)
        across = (pole.xyz - pole.point) @ (side / np.linalg.norm(side))
        widths.append(np.ptp(np.quantile(across, WIDTH_QUANTILES)) / 2)
    width = float(np.median(widths))
    is_likely = WIDTHS[0] <= width / radius <= WIDTHS[1]
    return Reading(found, width / size) if is_likely else None


def _in_no_metres(placement: Placement) -> Refusal | None:
    """Report which clouds have ranges that cannot be metres; None if both may be metres."""
    named = zip(("target", "source"), placement.scans, strict=True)
    odd = {name: found for name, scan in named if (found := oddity_of(scan.cloud))}
    for name, found in odd.items():
        if found.is_tiny:
            return Refusal("wrong_unit", f"of the {name}, {found.text}", {"lidars": name})
    odd = {name: found for name, found in odd.items() if found.units}
    if not odd:
        return None
    first, *others = odd.values()
    common = tuple(unit for unit in first.units if all(unit in each.units for each in others))
    likely = replace(first, units=common or first.units)
    whose = "both clouds' points" if others else f"the {next(iter(odd))}'s points"
    options = " or ".join(_options(unit, *odd) for unit in likely.units)
    return Refusal(
        "wrong_unit",
        f"half of {whose} are beyond {min(each.half for each in odd.values()):,.0f}, too far "
        f"for a LiDAR in metres: they look like {likely.candidates}; if they are, read them with "
        f"{options}",
        {"lidars": " and ".join(odd), "half": likely.half, "units": " or ".join(likely.units)},
    )


def _in_common_unit(
    placement: Placement,
    read: Mapping[float, Sequence[Reading | None]],
    radius: float,
    refusal: Refusal,
    odd: Refusal | None,
) -> Refusal | None:
    """Find the single unit in which both clouds show poles; only this distinguishes feet from
    thicker poles."""
    fitting = []
    for unit in UNITS:
        target, source = read[METRES[unit]]
        if target is None or source is None:
            continue
        fit = find_fit(replace(placement, target=target.scan, source=source.scan))
        # Clouds in two different units are recognised by the factor between them.
        if fit is not None and abs(np.log(fit.factor)) <= LEAST_CHANGE:
            fitting.append((unit, target, source, fit.agreed))
    if len(fitting) != 1:
        return None
    ((unit, target, source, agreed),) = fitting
    thicker = (target.radius_before + source.radius_before) / 2
    said = (
        f"read as {NAMES[unit]}, the target shows {len(target.scan.poles)} poles of radius "
        f"{radius:g} m and the source {len(source.scan.poles)}, which fit each other, and "
        f"{agreed.agreeing} of {agreed.total} patches above the ground agree"
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


def _options(unit: Unit, *lidars: str) -> str:
    if len(lidars) > 1:
        return f"--unit {unit}"
    return f"--unit m --unit {unit}" if lidars[0] == "source" else f"--unit {unit} --unit m"


def _refusal(found: Found, rigid: Found | None, placement: Placement) -> Refusal:
    agreed = found.agreed
    figures = {"agreeing": agreed.agreeing, "contradicting": agreed.contradicting}
    shown = f"{agreed.agreeing} of {agreed.total} patches above the ground then agree"
    if rigid is not None:
        figures["rigid_agreeing"] = rigid.agreed.agreeing
        figures["rigid_contradicting"] = rigid.agreed.contradicting
        shown += f", {rigid.agreed.agreeing} of {rigid.agreed.total} under the best rigid motion"
    if found.factor > 0:
        return _wrong_scale(found.factor, f"{shown}; convert both clouds to metres", figures)
    # As far as the LiDARs' axes show: two horizontal ones differ by a rotation.
    moved = found.T[:3, :3] @ changed_cloud(placement.source.cloud, found.factor).axis
    cosine = float(placement.target.cloud.axis @ moved)
    axis, description = (
        "vertical",
        "the vertical axis, or a horizontal one if a LiDAR is mounted upside down,",
    )
    if abs(cosine) < LEVEL:
        axis, description = "unknown", "one axis"
    elif cosine > 0:
        axis, description = "horizontal", "one horizontal axis"
    return Refusal(
        "mirrored",
        f"{description} of one of the two clouds is reversed: {shown}; check the driver's axes "
        "(left-handed?), and the program that converted the files",
        {"axis": axis, "lidar": "one of the two", **figures},
    )


def _wrong_scale(
    factor: float, because: str, figures: dict[str, float] | dict[str, int], error: str = ""
) -> Refusal:
    """Refuse because of a scale, and name the unit of one of two clouds if the scale is that of a
    unit."""
    unit = next(
        (u for u in UNITS if abs(abs(np.log(factor)) + np.log(METRES[u])) < LEAST_CHANGE), None
    )
    values: dict[str, float | int | str] = {"factor": factor, **figures}
    named = ""
    if unit is not None:
        lidar = "source" if factor < 1 else "target"
        values |= {"unit": NAMES[unit], "unit_m": METRES[unit]}
        named = f" ({METRES[unit]:g}: is the {lidar} in {NAMES[unit]}?"
        named += f" Then read it with {_options(unit, lidar)})"
    return Refusal(
        "wrong_scale",
        f"lengths in the source must be multiplied by {factor:.4f}{error} to be those in the "
        f"target{named}: {because}",
        values,
    )
