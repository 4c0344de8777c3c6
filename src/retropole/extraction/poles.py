"""From a cloud to its taped poles: threshold, cluster, look for lines, test each.

The first step of Xue et al. 2019, with rules for what else shines (docs/evidence/detection.md).
Nothing here depends on the vertical or on where the sensor was: a cloud gives the same poles after
any rigid motion, and in whatever order its points come.

A vest next to a pole, or two crossing poles, are one cluster. So lines are looked for inside the
clusters, and what a line leaves is looked at again, until nothing long and thin is left.

What *Sensitivity* means at a constant: docs/evidence/detection.md.
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
from ..base.se3 import lengths
from ..base.sensors import Sensor, threshold_for
from ..io.beams import MAX_RING_SPREAD, ring_spread, with_beam_origin, with_trusted_rings
from ..io.scan_lines import with_rings
from .acceptance_shape import MIN_LENGTH, Failure
from .certainty import doubt_of
from .extent import check_coordinates
from .line_search import Judged, LineSearch, find_lines, near_box, parts_of, why_left
from .lines import HALF, LINK, MAX_NEIGHBOUR_DISTANCE, MIN_POLE_POINTS, PROPOSALS, TUBE, clusters
from .sensor_pattern import DEPTH_PER_RADIUS, RMS_PER_RADIUS, Beams, beams_by, check_sensor
from .surroundings import surroundings_failure

MAX_BRIGHT = 20_000
"""More points than this, and more than half of the cloud, are not tape; time and memory grow faster
than their number. A cloud cropped to its poles has fewer points."""


def extract_poles(
    cloud: PointCloud,
    *,
    sensor: Sensor | None = None,
    threshold: float | None = None,
    radius: float = DEFAULT_RADIUS,
    is_part: bool = False,
) -> Detection:
    """Find the taped poles in a cloud, and state why every other bright object is not one.

    Parameters
    ----------
    cloud
        Points with intensity.
    sensor
        What recorded it; gives the threshold where none is given. None takes that of the cloud.
    threshold
        Intensity from which a return is retro-reflective.
    radius
        Of the poles, metres. Thicker posts are doubtful: to about 0.07 m, and to 0.1 m where they
        are short.
    is_part
        Whether it is a part of a cloud whose beams and rings are known, as its origin, axis and
        rings: none of them is looked at again, which takes more time than the poles.

    Returns
    -------
    Detection
        Poles with the most returns first; none at all is an answer. Its `candidates` pass all
        rules but those of `certainty`; `candidates.with_candidates` adds others.

    Raises
    ------
    Refusal
        ``no_intensity`` if the cloud has none, or the same one everywhere, ``threshold_too_low`` if
        most of it passes the threshold, ``far_from_lidar``, and ``wrong_sensor`` if its rings are
        not those of the sensor.
    """
    if cloud.intensity is None or len(cloud) == 0 or np.ptp(cloud.intensity) == 0:
        raise _without_intensity(cloud)
    check_coordinates(cloud)
    if not is_part:
        cloud = with_beam_origin(with_trusted_rings(cloud))
        check_sensor(cloud, sensor)
        cloud = with_rings(cloud, sensor)
    assert cloud.intensity is not None
    ranges = lengths(cloud.xyz - cloud.origin)
    chosen = threshold_for(cloud.intensity, ranges, sensor, threshold)
    if is_too_low(cloud.intensity, chosen.value):
        bright = int(np.count_nonzero(cloud.intensity >= chosen.value))
        raise Refusal(
            "threshold_too_low",
            f"{bright} of {len(cloud)} points pass the threshold {chosen.value:g}, tape gives "
            f"only a few: give a threshold above {np.quantile(cloud.intensity, 0.9):g}, that of "
            "the brightest tenth, or none",
            {"bright": bright, "points": len(cloud), "threshold": chosen.value},
        )
    free = cloud.intensity >= chosen.at(ranges)
    retro = np.flatnonzero(free)
    columns = np.ascontiguousarray(cloud.xyz.T)
    accepted: list[Judged] = []
    doubtful: list[tuple[Judged, Failure]] = []
    failures: list[tuple[IntArray, Failure]] = []
    search = confirmed(radius, beams_by(sensor))
    for group in clusters(cloud.xyz[retro], LINK):
        cluster = retro[group]
        found, failure = _search(cloud, columns, cluster, free, search)
        for each in found:
            doubt = doubt_of(cloud, each.line, radius, knows_origin=True)
            if doubt and doubt.code == "end_on" and ring_spread(cloud) > MAX_RING_SPREAD:
                doubt = doubt_of(cloud, each.line, radius, knows_origin=False)
            if doubt is None:
                accepted.append(each)
            else:
                doubtful.append((each, doubt))
        failures.append((cluster, failure))
    rejected = _rejected(cloud, free, failures)
    rejected += [_rejected_cluster(cloud, np.sort(each.line.index), why) for each, why in doubtful]
    return Detection(
        _poles_on(cloud, accepted),
        tuple(sorted(rejected, key=lambda cluster: -len(cluster.index))),
        chosen.value,
        chosen.found,
        len(retro),
        _poles_on(cloud, [each for each, _ in doubtful]),
        chosen.least,
    )


def confirmed(radius: float, beams: Beams) -> LineSearch:
    """What passes all rules, of poles of a radius, metres."""
    return LineSearch(
        radius,
        beams,
        surroundings_failure,
        fewest=MIN_POLE_POINTS,
        shortest=MIN_LENGTH,
        least_odds=-np.inf,
        proposals=PROPOSALS,
        rooms=(TUBE,),
        shell=(radius + TUBE, MAX_NEIGHBOUR_DISTANCE),
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
        f"{name} {what}: retro-reflective tape cannot be distinguished from the rest; record it "
        "with intensity",
        values,
    )


def is_too_low(intensity: Array, threshold: float) -> bool:
    """Whether most of a large cloud passes a threshold: all of it would be one cluster."""
    bright = int(np.count_nonzero(intensity >= threshold))
    return bright > max(MAX_BRIGHT, HALF * len(intensity))


def _search(
    cloud: PointCloud, columns: Array, cluster: IntArray, free: BoolArray, search: LineSearch
) -> tuple[list[Judged], Failure]:
    """Find the poles of one cluster, line by line, and say why the rest is not one.

    ``free`` (N,) marks the retro-reflective points that no pole has claimed yet.
    """
    if len(cluster) < MIN_POLE_POINTS:
        reason = f"{counted(len(cluster), 'point')}, a pole needs {MIN_POLE_POINTS}"
        return [], Failure("too_few_points", reason)
    near = near_box(columns, cluster)
    parts, failure = parts_of(cloud, cluster)
    is_saturated = failure is not None
    found: list[Judged] = []
    for part in parts:
        lines, why = find_lines(cloud, near, part, free, free, search, is_saturated)
        found += lines
        failure = failure or why
    return found, failure or why_left(free, parts)


def _poles_on(cloud: PointCloud, found: Sequence[Judged]) -> tuple[Pole, ...]:
    poles = [pole_on(cloud, each) for each in found]
    return tuple(sorted(poles, key=lambda pole: (-len(pole.index), pole.rms)))


def pole_on(cloud: PointCloud, found: Judged) -> Pole:
    """Make a pole of a line."""
    line = found.line
    index = np.sort(line.index)
    xyz = cloud.xyz[index]
    point = xyz.mean(axis=0)
    sight = point - cloud.origin
    sight -= (sight @ line.direction) * line.direction
    deeper = DEPTH_PER_RADIUS * line.thicker / RMS_PER_RADIUS
    to_axis = deeper * sight / (np.linalg.norm(sight) or 1.0)
    return Pole(
        point,
        line.direction,
        xyz,
        line.length,
        line.rms,
        line.rings,
        index,
        to_axis,
        found.log_odds,
    )


def _rejected(
    cloud: PointCloud, free: BoolArray, failures: list[tuple[IntArray, Failure]]
) -> list[RejectedCluster]:
    """Give the points that belong to no line, cluster by cluster, with the reason."""
    rejected = []
    for cluster, failure in failures:
        left = np.sort(cluster[free[cluster]])
        if len(left) == 0 or (len(left) < len(cluster) and len(left) < MIN_POLE_POINTS):
            continue  # nothing, or the stray returns about a pole
        rejected.append(_rejected_cluster(cloud, left, failure))
    return rejected


def _rejected_cluster(cloud: PointCloud, index: IntArray, why: Failure) -> RejectedCluster:
    return RejectedCluster(index, cloud.xyz[index].mean(axis=0), why.code, why.reason)
