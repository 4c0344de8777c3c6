"""From a cloud to its taped poles: threshold, cluster, look for lines, test each.

The first step of Xue et al. 2019, with rules for what else shines (docs/evidence/detection.md).
Nothing here asks which way is up or where the sensor stood: a cloud gives the same poles after any
rigid motion, and in whatever order its points come.

A vest beside a pole, or two crossing poles, are one cluster. So lines are looked for inside the
clusters, and what a line leaves is looked at again, until nothing long and thin is left.

What *Sensitivity* means beside a constant: docs/evidence/detection.md.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..base.datatypes import (
    DEFAULT_RADIUS,
    Array,
    BoolArray,
    Detection,
    IntArray,
    PointCloud,
    Pole,
    RejectedCluster,
)
from ..base.errors import Refusal
from ..base.quantities import counted
from ..base.se3 import lengths, principal_axes
from ..base.sensors import Sensor, threshold_for
from ..io.beams import MAX_RING_SPREAD, ring_spread, with_beam_origin, with_trusted_rings
from ..io.scan_lines import with_rings_shown
from .acceptance_shape import (
    FEW_POLE_POINTS,
    MAX_LENGTH,
    MIN_LENGTH,
    MIN_POLE_POINTS,
    THICK_RMS,
    Failure,
    shape_failure,
)
from .certainty import doubt_of
from .extent import check_coordinates
from .lines import (
    HALF,
    LINK,
    MANY,
    MIN_LINE_POINTS,
    SEARCH_ROOM,
    TUBE,
    Line,
    clusters,
    fit_line,
    fit_lines,
    in_canonical_order,
    on_surface,
    propose_lines,
)
from .sensor_pattern import DEPTH_PER_RADIUS, RMS_PER_RADIUS, Beams, beams_by, check_sensor
from .surroundings import MAX_BESIDE, SHORT_LENGTH, surroundings_failure

SURFACE_LINK = 0.4
"""Points of a large cluster that are on no surface are grouped again with this step, metres: a
third of `LINK`, so that stray points on bright ground do not connect. Sensitivity at 0.28: 7 fewer
false; at 0.56: 3 fewer false."""

MAX_BRIGHT = 20_000
"""More points than this, and more than half of the cloud, are not tape; time and memory grow faster
than their number. A cloud cropped to its poles has fewer points."""

MAX_POLES = 8
"""Poles taken out of one group at most, and candidates that are kept of a cloud, those with the
most returns; what is left then is rejected with a reason that says so. Sensitivity from 8 to 17: no
effect."""

ENOUGH_SHARE = 0.9
"""A pole with so much of a group's points is taken without trying the other proposals. Sensitivity
from 0.86 to 0.93: no effect."""


def extract_poles(
    cloud: PointCloud,
    *,
    sensor: Sensor | None = None,
    threshold: float | None = None,
    radius: float = DEFAULT_RADIUS,
    look_for_rings: bool = True,
) -> Detection:
    """Find the taped poles in a cloud, and say of every other bright thing why it is not one.

    Parameters
    ----------
    cloud
        Points with intensity.
    sensor
        What recorded it; gives the threshold where none is given. None asks the cloud itself.
    threshold
        Intensity from which a return counts as retro-reflective.
    radius
        Of the poles, metres. Thicker posts are doubtful: to about 0.07 m, and to 0.1 m where they
        are short.
    look_for_rings
        Whether points without rings are searched for them, which takes most of the time.

    Returns
    -------
    Detection
        Poles with the most returns first; none at all is an answer. Its `candidates` pass all
        rules but those of `certainty`; `candidates.with_candidates` adds others.

    Raises
    ------
    Refusal
        ``no_intensity`` where the cloud has none, or the same one everywhere,
        ``threshold_too_low`` where most of it passes the threshold, ``far_from_lidar``, and
        ``wrong_sensor`` where its rings are not those of the sensor.
    """
    if cloud.intensity is None or len(cloud) == 0 or np.ptp(cloud.intensity) == 0:
        raise _without_intensity(cloud)
    check_coordinates(cloud)
    cloud = with_beam_origin(with_trusted_rings(cloud))
    check_sensor(cloud, sensor)
    if look_for_rings and (sensor is None or sensor.rings):
        cloud = with_rings_shown(cloud)
    assert cloud.intensity is not None
    ranges = lengths(cloud.xyz - cloud.origin)
    chosen = threshold_for(cloud.intensity, ranges, sensor, threshold)
    if is_too_low(cloud.intensity, chosen.value):
        bright = int(np.count_nonzero(cloud.intensity >= chosen.value))
        raise Refusal(
            "threshold_too_low",
            f"{bright} of {len(cloud)} points pass the threshold {chosen.value:g}, tape is few of "
            f"them: give one above {np.quantile(cloud.intensity, 0.9):g}, that of the brightest "
            "tenth, or none",
            {"bright": bright, "points": len(cloud), "threshold": chosen.value},
        )
    knows_origin = ring_spread(cloud) <= MAX_RING_SPREAD
    free = cloud.intensity >= chosen.at(ranges)
    retro = np.flatnonzero(free)
    columns = np.ascontiguousarray(cloud.xyz.T)
    sure: list[Line] = []
    doubtful: list[tuple[Line, Failure]] = []
    failures: list[tuple[IntArray, Failure]] = []
    for group in clusters(cloud.xyz[retro], LINK):
        cluster = retro[group]
        found, failure = _search(cloud, columns, cluster, free, radius, beams_by(sensor))
        for line in found:
            free[line.index] = False
            doubt = doubt_of(cloud, line, radius, knows_origin)
            if doubt is None:
                sure.append(line)
            else:
                doubtful.append((line, doubt))
        failures.append((cluster, failure))
    rejected = _rejected(cloud, free, failures)
    rejected += [_rejected_cluster(cloud, np.sort(line.index), why) for line, why in doubtful]
    return Detection(
        _poles_on(cloud, sure),
        tuple(sorted(rejected, key=lambda cluster: -len(cluster.index))),
        chosen.value,
        chosen.found,
        len(retro),
        _poles_on(cloud, [line for line, _ in doubtful]),
        chosen.least,
    )


def _without_intensity(cloud: PointCloud) -> Refusal:
    """Refuse a cloud that has no intensity, or one for all points, and say which it is."""
    name = cloud.source or "the cloud"
    values: dict[str, float | int | str] = {"points": len(cloud)}
    if len(cloud) == 0:
        what = "has 0 points"
    elif cloud.intensity is None:
        what = f"has no intensity in any of its {len(cloud)} points"
    else:
        values["intensity"] = float(cloud.intensity[0])
        what = f"has the intensity {cloud.intensity[0]:g} in all of its {len(cloud)} points"
    return Refusal(
        "no_intensity",
        f"{name} {what}: retro-reflective tape cannot be told from the rest; record it with "
        "intensity",
        values,
    )


def is_too_low(intensity: Array, threshold: float) -> bool:
    """Whether most of a large cloud passes a threshold: all of it would be one cluster."""
    bright = int(np.count_nonzero(intensity >= threshold))
    return bright > max(MAX_BRIGHT, HALF * len(intensity))


def _search(
    cloud: PointCloud,
    columns: Array,
    cluster: IntArray,
    free: BoolArray,
    radius: float,
    beams: Beams,
) -> tuple[list[Line], Failure]:
    """Find the poles of one cluster, line by line, and say why the rest is not one.

    ``free`` (N,) marks the retro-reflective points that no pole has claimed yet.
    """
    if len(cluster) < MIN_POLE_POINTS:
        reason = f"{counted(len(cluster), 'point')}, a pole needs {MIN_POLE_POINTS}"
        return [], Failure("too_few_points", reason)
    near = near_box(columns, cluster)
    parts: list[IntArray] = [cluster]
    failure: Failure | None = None
    if len(cluster) > MANY:
        parts, failure = off_surfaces(cloud, cluster)
    is_saturated = failure is not None
    free = free.copy()
    found: list[Line] = []
    for part in parts:
        for _ in range(MAX_POLES):
            left = part[free[part]]
            if len(left) < MIN_POLE_POINTS:
                break
            left = in_canonical_order(cloud.xyz, left)
            best = _best_line(cloud, near, left, free, radius, beams, is_saturated)
            if isinstance(best, Failure):
                failure = failure or best
                break
            found.append(best)
            free[best.index] = False
    return found, failure or _left_over(free, parts)


def off_surfaces(cloud: PointCloud, cluster: IntArray) -> tuple[list[IntArray], Failure | None]:
    """Split a large cluster without the bright surfaces in it; say where these are most of it."""
    flat = on_surface(cloud.xyz[cluster])
    rest = cluster[~flat]
    parts = [rest[group] for group in clusters(cloud.xyz[rest], SURFACE_LINK)]
    share = np.count_nonzero(flat) / len(cluster)
    if share <= HALF:
        return parts, None
    reason = f"{share:.0%} of {len(cluster)} points are inside a bright surface"
    return parts, Failure("part_of_a_surface", reason)


def _left_over(free: BoolArray, parts: list[IntArray]) -> Failure:
    """Say why points are left where no line was tried and found wanting."""
    most = max((int(np.count_nonzero(free[part])) for part in parts), default=0)
    if most >= MIN_POLE_POINTS:
        reason = f"{most} points left after {MAX_POLES} poles, more are not looked for"
    else:
        reason = f"no {MIN_POLE_POINTS} points together off poles and surfaces, as a pole needs"
    return Failure("too_few_points", reason)


def near_box(columns: Array, cluster: IntArray) -> IntArray:
    """Index of all points in the box about a cluster and `SHORT_LENGTH` more; columns is (3, N)."""
    index: IntArray | None = None
    for column in columns:
        low, high = column[cluster].min() - SHORT_LENGTH, column[cluster].max() + SHORT_LENGTH
        values = column if index is None else column[index]
        inside = np.flatnonzero((values >= low) & (values <= high))
        index = inside if index is None else index[inside]
    assert index is not None
    return index


def _best_line(
    cloud: PointCloud,
    near: IntArray,
    left: IntArray,
    free: BoolArray,
    radius: float,
    beams: Beams,
    is_saturated: bool,
) -> Line | Failure:
    """Find the best supported pole among the points ``left``; if there is none, why."""
    tube, shell = radius + SEARCH_ROOM, (radius + TUBE, MAX_BESIDE)
    best: Line | None = None
    first: tuple[Line, Failure] | None = None
    guesses = propose_lines(cloud.xyz[left], MIN_LENGTH, MAX_LENGTH, tube, shell)
    for line in fit_lines(cloud, left, guesses, radius, beams):
        failure = shape_failure(cloud, line)
        if failure is None:
            # All that lies on it: a pole that something hides in part is two clusters.
            whole = fit_line(cloud, near[free[near]], line.point, line.direction, radius, beams)
            if len(whole.index) > len(line.index) and shape_failure(cloud, whole) is None:
                line = whole
            failure = surroundings_failure(cloud, near, free, line)
        if failure is None and is_saturated:
            failure = _candidate_in_brightness(line)
        if failure is not None:
            first = first or (line, failure)
        elif best is None or (len(line.index), -line.rms) > (len(best.index), -best.rms):
            best = line
            if len(line.index) >= ENOUGH_SHARE * len(left):
                break
    if best is not None:
        return best
    if first is None:
        nothing = f"no {MIN_LINE_POINTS} of its points lie in line over {MIN_LENGTH:g} m"
        return Failure("too_short", nothing)
    return _of_the_cluster(cloud, left, *first)


def _of_the_cluster(cloud: PointCloud, left: IntArray, line: Line, failure: Failure) -> Failure:
    """Say first what the points are of which only a part was tested as a line."""
    if len(line.index) >= ENOUGH_SHARE * len(left):
        return failure
    centre, axes = principal_axes(cloud.xyz[left])
    extent = np.ptp((cloud.xyz[left] - centre) @ axes, axis=0)
    size = f"{len(left)} points, {extent[2]:.2f} × {extent[1]:.2f} m"
    return Failure(failure.code, f"{size}; of {len(line.index)} of them in line: {failure.reason}")


def _candidate_in_brightness(line: Line) -> Failure | None:
    """Where a bright surface is most of the cluster, only a slim line of many points is a pole."""
    if line.rms <= line.with_beams(THICK_RMS) and len(line.index) >= FEW_POLE_POINTS:
        return None
    reason = f"{len(line.index)} points in line inside a bright surface"
    return Failure("part_of_a_surface", reason)


def _poles_on(cloud: PointCloud, lines: Sequence[Line]) -> tuple[Pole, ...]:
    poles = [pole_on(cloud, line) for line in lines]
    return tuple(sorted(poles, key=lambda pole: (-len(pole.index), pole.rms)))


def pole_on(cloud: PointCloud, line: Line) -> Pole:
    """Make a pole of a line."""
    index = np.sort(line.index)
    xyz = cloud.xyz[index]
    point = xyz.mean(axis=0)
    sight = point - cloud.origin
    sight -= (sight @ line.direction) * line.direction
    deeper = DEPTH_PER_RADIUS * line.thicker / RMS_PER_RADIUS
    to_axis = deeper * sight / (np.linalg.norm(sight) or 1.0)
    return Pole(point, line.direction, xyz, line.length, line.rms, line.rings, index, to_axis)


def _rejected(
    cloud: PointCloud, free: BoolArray, failures: list[tuple[IntArray, Failure]]
) -> list[RejectedCluster]:
    """Give what no line has claimed, cluster by cluster, with its reason."""
    rejected = []
    for cluster, failure in failures:
        left = np.sort(cluster[free[cluster]])
        if len(left) == 0 or (len(left) < len(cluster) and len(left) < MIN_POLE_POINTS):
            continue  # nothing, or the stray returns about a pole
        rejected.append(_rejected_cluster(cloud, left, failure))
    return rejected


def _rejected_cluster(cloud: PointCloud, index: IntArray, why: Failure) -> RejectedCluster:
    return RejectedCluster(index, cloud.xyz[index].mean(axis=0), why.code, why.reason)
