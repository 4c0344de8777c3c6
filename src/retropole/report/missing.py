"""What a LiDAR lacks that sees too few poles: each candidate, and how much is missing."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import permutations

import numpy as np

from ..base.datatypes import Array, Pole, RejectedCluster, Scan
from ..base.quantities import counted
from ..base.reasons import explain
from ..extraction.acceptance_shape import MIN_POLE_POINTS, MIN_POLE_RINGS
from .listings import rejected_mark
from .page import EMPTY, Html, fill, fill_each, inline, join
from .subject import LIDARS, Subject, pole_name

SAME_DISTANCE = 0.3
"""A cluster may be the missing pole where it stands as far beside a found one as the other LiDAR's
poles stand beside each other, within this, metres: two poles leaning by 15°, of which the LiDARs
see parts 0.5 m higher or lower, are 2 · 0.5 m · tan 15° = 0.27 m nearer or farther."""

TOO_LITTLE = ("too_few_points", "too_few_rows")
"""Codes of clusters of which too little was seen."""

NAMED = 3
"""So many candidates are named of each LiDAR; the page lists all clusters below."""

NEAREST = 2.0
"""No pole is asked to stand nearer than this, metres: what would have to is too little to go by."""


def missing_poles(subject: Subject) -> Html:
    """Say of each LiDAR of a refused pair that sees too few poles what it sees, and what lacks."""
    pair = subject.pair
    if pair is None or pair.status != "refused":
        return EMPTY
    needed = pair.config.poles or 2
    parts = []
    for j, both in enumerate(zip(*subject.scans, strict=True), 1):
        where = f" in placement {j}" if len(subject.scans[0]) > 1 else ""
        for k, lidar in enumerate(LIDARS):
            scan, other = both[k], both[1 - k]
            if scan is None or other is None or scan.detection is None:
                continue
            if len(scan.poles) < needed:
                title = f"The {lidar} sees {len(scan.poles)} of {needed} poles{where}"
                items = fill_each("li", _items(k, scan, other))
                parts.append(fill("lacking", title=title, items=items))
    return fill("missing", parts=join(parts)) if parts else EMPTY


def _items(lidar: int, scan: Scan, other: Scan) -> Iterator[str]:
    """Name the poles that one LiDAR sees, then what else may be one."""
    assert scan.detection is not None
    origin = scan.cloud.origin
    for k, pole in enumerate(scan.poles):
        yield (
            f"Pole {pole_name(LIDARS[lidar], k)}, {_place(pole.point - origin)}: "
            f"{counted(len(pole.index), 'return')} on {counted(pole.rings, 'ring')}."
        )
    rejected = list(enumerate(scan.detection.rejected))
    threshold = f"{scan.detection.threshold:g}"
    unseen = (
        f"its returns are below the threshold of {threshold}, or something hides it, or it stands "
        "outside of the field of view."
    )
    if not rejected:
        yield f"Nothing else is as bright as tape. If the pole is there, {unseen}"
        return
    distances = _distances(other.poles)
    if not scan.poles or not distances:
        # First those of which too little was seen: nearer, they may be poles.
        little = sorted(rejected, key=lambda each: each[1].code not in TOO_LITTLE)
        for k, cluster in little[:NAMED]:
            yield _candidate(lidar, k, cluster, scan)
        if len(rejected) > NAMED:
            yield f"{counted(len(rejected) - NAMED, 'more bright cluster')}, listed under Poles."
        return
    near = sorted(
        (abs(_beside(pole, cluster.centre) - distance), k, n)
        for k, cluster in rejected
        for n, pole in enumerate(scan.poles)
        for distance in distances
    )
    fitting = list(dict.fromkeys((k, n) for apart, k, n in near if apart <= SAME_DISTANCE))
    clusters = scan.detection.rejected
    for k, n in fitting[:NAMED]:
        beside = f"{_beside(scan.poles[n], clusters[k].centre):.1f} m beside"
        name = pole_name(LIDARS[lidar], n)
        yield _candidate(lidar, k, clusters[k], scan, f", {beside} {name}")
    told = " or ".join(dict.fromkeys(f"{distance:.1f}" for distance in distances))
    there = f"The other LiDAR sees poles {told} m beside each other"
    if fitting:
        yield f"{there}: what is named here fits that."
    else:
        yield (
            f"{there}. None of the {len(rejected)} rejected clusters fits that. If the pole is "
            f"there, {unseen}"
        )


def _candidate(lidar: int, k: int, cluster: RejectedCluster, scan: Scan, beside: str = "") -> Html:
    """Say of a rejected cluster where it is, and what it lacks of a pole."""
    away = cluster.centre - scan.cloud.origin
    name = f"Cluster {rejected_mark(lidar, k)}, {_place(away)}{beside}"
    return fill("candidate", name=name, lacks=_lacks(cluster, scan, float(np.linalg.norm(away))))


def _lacks(cluster: RejectedCluster, scan: Scan, distance: float) -> str:
    """Say how much is missing, in numbers where there are; else the reason and its advice."""
    returns, ring = len(cluster.index), scan.cloud.ring
    if cluster.code == "too_few_points" and returns < MIN_POLE_POINTS:
        count = f"{counted(returns, 'return')}, {MIN_POLE_POINTS} are needed"
        return f"{count}: {_nearer(distance, returns / MIN_POLE_POINTS)}"
    rings = 0 if ring is None else len(np.unique(ring[cluster.index]))
    if cluster.code == "too_few_rows" and 0 < rings < MIN_POLE_RINGS:
        count = f"on {counted(rings, 'ring')}, {MIN_POLE_RINGS} are needed"
        return f"{count}: {_nearer(distance, rings / MIN_POLE_RINGS)}"
    known = explain(cluster.code) if cluster.code != "too_few_points" else None
    advice = fill_each("sentence", map(inline, known.advice if known else ()))
    return fill("lacks", reason=cluster.reason, advice=advice)


def _nearer(distance: float, share: float) -> str:
    """Say how much nearer a pole has so many returns, or rings, as are needed.

    Rings on a pole are as the inverse of its distance, and returns on each ring grow towards the
    LiDAR, too: by this much nearer there are enough, on average at least.
    """
    enough = share * distance
    if enough < NEAREST:
        return "if it is your pole, stand it much nearer."
    return f"if it is your pole, stand it {math.ceil(10 * (distance - enough)) / 10:.1f} m nearer."


def _place(away: Array) -> str:
    """Say where something is as the LiDAR sees it: how far away, and at which azimuth."""
    azimuth = math.degrees(math.atan2(away[1], away[0]))
    return f"{float(np.linalg.norm(away)):.1f} m away at azimuth {azimuth:.0f}°"


def _distances(poles: Sequence[Pole]) -> list[float]:
    """How far each pole's centre is from the line of each other, metres, without repetition."""
    found = sorted(_beside(a, b.point) for a, b in permutations(poles, 2))
    return [d for k, d in enumerate(found) if k == 0 or d - found[k - 1] > 0.05]


def _beside(pole: Pole, point: Array) -> float:
    """Distance of a point from the line of a pole, metres."""
    return float(np.linalg.norm(np.cross(point - pole.point, pole.direction)))
