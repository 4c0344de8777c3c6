"""From a cloud to its taped poles: threshold, cluster, look for lines, test each (M2).

Nothing here asks which way is up or where the sensor stood: a cloud gives the same poles after any
rigid motion, and in whatever order its points come.

A vest beside a pole, or two crossing poles, are one cluster. So lines are looked for inside the
clusters, and what a line leaves is looked at again, until nothing long and thin is left.
"""

from __future__ import annotations

import numpy as np

from ..datatypes import Array, BoolArray, Detection, IntArray, PointCloud, Pole, RejectedCluster
from ..errors import Refusal
from ..sensors import Sensor, threshold_for
from .acceptance import (
    BESIDE,
    FEW_POLE_POINTS,
    MAX_LENGTH,
    MIN_LENGTH,
    MIN_POLE_POINTS,
    THICK,
    Failure,
    shape_failure,
    surroundings_failure,
)
from .clustering import (
    MAX_PROPOSING_POINTS,
    TUBE,
    Line,
    clusters,
    fit_line,
    in_canonical_order,
    on_surface,
    propose_lines,
)

SLACK = 0.04
"""Room about the pole's radius in which returns of noisy sensors are looked for, metres."""

MARGIN = 0.8
"""How far about a cluster its surroundings reach, metres."""

REGROUP = 0.4
"""Points of a large cluster that are on no surface are grouped again with this step, metres."""

SATURATED = 0.5
"""Where more of a large cluster is inside a bright surface, its brightness says nothing, and only
a line that is slim and has many points is a pole."""

MAX_LINES = 12
"""Poles taken out of one cluster at most."""


def extract_poles(
    cloud: PointCloud,
    *,
    sensor: Sensor | None = None,
    threshold: float | None = None,
    radius: float = 0.02,
) -> Detection:
    """Find the taped poles in a cloud, and say of every other bright thing why it is none.

    Parameters
    ----------
    cloud
        Points with intensity.
    sensor
        What recorded it; gives the threshold where none is given. None asks the cloud itself.
    threshold
        Intensity from which a return counts as retro-reflective.
    radius
        Of the poles, metres. Thicker posts, up to about 0.1 m, are found too.

    Returns
    -------
    Detection
        Poles with the most returns first; none at all is an answer.

    Raises
    ------
    Refusal
        ``no_intensity`` where the cloud has none, or the same one everywhere.
    """
    if cloud.intensity is None or len(cloud) == 0 or np.ptp(cloud.intensity) == 0:
        raise Refusal(
            "no_intensity",
            f"{cloud.source or 'the cloud'} has no intensity, or the same in all {len(cloud)} "
            "points: retro-reflective tape cannot be told from the rest; record it with intensity",
            {"points": len(cloud)},
        )
    chosen = threshold_for(cloud.intensity, sensor, threshold)
    is_retro = cloud.intensity >= chosen.value
    retro = np.flatnonzero(is_retro)
    free = is_retro.copy()
    columns = np.ascontiguousarray(cloud.xyz.T)
    lines: list[Line] = []
    failures: list[tuple[IntArray, str, str]] = []
    for group in clusters(cloud.xyz[retro]):
        cluster = retro[group]
        if len(cluster) < MIN_POLE_POINTS:
            reason = f"{len(cluster)} points, a pole needs {MIN_POLE_POINTS}"
            failures.append((cluster, "too_few_points", reason))
            continue
        found, failure = _search(cloud, columns, cluster, is_retro, free, radius)
        lines += found
        failures.append((cluster, *failure))
    poles = [_pole(cloud, line) for line in lines]
    poles.sort(key=lambda pole: (-len(pole.index), pole.rms))
    return Detection(
        tuple(poles),
        tuple(_rejected(cloud, free, failures)),
        chosen.value,
        chosen.found,
        len(retro),
    )


def _search(
    cloud: PointCloud,
    columns: Array,
    cluster: IntArray,
    is_retro: BoolArray,
    free: BoolArray,
    radius: float,
) -> tuple[list[Line], tuple[str, str]]:
    """Take the poles out of one cluster, line by line, and say why the rest is none.

    ``free`` marks the retro-reflective points that no pole has claimed yet, and is updated.
    """
    near = _surroundings(columns, cluster)
    searched, saturated = [cluster], False
    failure = ("", "")
    if len(cluster) > MAX_PROPOSING_POINTS:
        flat = on_surface(cloud.xyz[cluster])
        rest = cluster[~flat]
        searched = [rest[group] for group in clusters(cloud.xyz[rest], REGROUP)]
        share = np.count_nonzero(flat) / len(cluster)
        saturated = bool(share > SATURATED)
        if saturated:
            reason = f"{share:.0%} of {len(cluster)} points are inside a bright surface"
            failure = ("part_of_a_surface", reason)
    found: list[Line] = []
    for part in searched:
        for _ in range(MAX_LINES):
            left = part[free[part]]
            if len(left) < MIN_POLE_POINTS:
                break
            line, why = _best_line(
                cloud, near, in_canonical_order(cloud.xyz, left), free, radius, saturated
            )
            if line is None:
                failure = failure if failure[0] else why
                break
            found.append(line)
            free[line.rows] = False
    return found, failure


def _surroundings(columns: Array, cluster: IntArray) -> IntArray:
    """Index of all points in the box about a cluster and `MARGIN` more; columns is (3, N)."""
    index: IntArray | None = None
    for column in columns:
        low, high = column[cluster].min() - MARGIN, column[cluster].max() + MARGIN
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
    saturated: bool,
) -> tuple[Line | None, tuple[str, str]]:
    """Find the best supported pole among some points; if there is none, why."""
    proposals = propose_lines(
        cloud.xyz[left], MIN_LENGTH, MAX_LENGTH, radius + SLACK, (radius + TUBE, BESIDE)
    )
    if not proposals:
        return None, ("too_short", f"no two of its points are {MIN_LENGTH:g} m apart")
    best: Line | None = None
    first: Failure | None = None
    for point, direction in proposals:
        line = fit_line(cloud, left, point, direction, radius)
        failure = shape_failure(cloud, line)
        if failure is None:
            # A pole that something hides in part is two clusters: take all that lies on its line.
            whole = fit_line(cloud, near[free[near]], line.point, line.direction, radius)
            if len(whole.rows) > len(line.rows) and shape_failure(cloud, whole) is None:
                line = whole
            failure = surroundings_failure(cloud, near, free, line)
        if failure is None and saturated and (line.rms > THICK or len(line.rows) < FEW_POLE_POINTS):
            failure = "part_of_a_surface", f"{len(line.rows)} points amid a bright surface"
        if failure is not None:
            first = first or failure
        elif best is None or (len(line.rows), -line.rms) > (len(best.rows), -best.rms):
            best = line
            if len(line.rows) >= 0.9 * len(left):
                break
    return best, first or ("", "")


def _pole(cloud: PointCloud, line: Line) -> Pole:
    rows = np.sort(line.rows)
    xyz = cloud.xyz[rows]
    return Pole(xyz.mean(axis=0), line.direction, xyz, line.length, line.rms, line.rings, rows)


def _rejected(
    cloud: PointCloud, free: BoolArray, failures: list[tuple[IntArray, str, str]]
) -> list[RejectedCluster]:
    """Give what no pole has claimed, cluster by cluster, with its reason; the largest first."""
    rejected = []
    for cluster, code, reason in failures:
        left = np.sort(cluster[free[cluster]])
        if len(left) == 0 or (len(left) < len(cluster) and len(left) < MIN_POLE_POINTS):
            continue  # nothing, or the stray returns about a pole
        if not code:
            code, reason = "too_few_points", f"{len(left)} points, a pole needs {MIN_POLE_POINTS}"
        rejected.append(RejectedCluster(left, cloud.xyz[left].mean(axis=0), code, reason))
    return sorted(rejected, key=lambda cluster: -len(cluster.index))
