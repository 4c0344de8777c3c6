"""What the page's view draws: clouds, poles, poses and the ellipsoid, as the JSON of its code."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

import msgspec
import numpy as np
from msgspec import structs

from ..base import se3
from ..base.datatypes import Array, Scan
from ..base.errors import visible
from ..base.quantities import counted
from ..base.sensors import auto_threshold
from ..hypotheses.choice import hypothesis_name
from ..result import PoleDoc, ResultDoc, plain, pole_documents
from ..surfaces.consistency import contradicting_points, objects_in
from .page import Html
from .plan import Plan
from .points import MAX_SHOWN_RANGE, PackedCloud, PackedPoints, pack_cloud, pack_points
from .subject import COLOURS, Subject, pole_labels

MAX_CLOUD_POINTS = 100_000
"""Points of each cloud in the page, about 0.9 MB."""

MAX_PAIR_POINTS, MAX_SITE_POINTS = 600_000, 1_500_000
"""Points of all clouds together: the page of a pair stays under 8 MB, of a site under 20 MB."""

MAX_RECORDING_POINTS = 300_000
"""Points of each cloud in the page of recordings, about 3.6 MB."""

SEEN_SIGMA = 0.7
"""The ellipsoid is enlarged by a power of ten until its longest half axis is about this length,
metres.
"""

MAX_CONTRADICTING = 2000
"""Points of each cloud that are marked as contradicting a pose, of all placements together."""

SHOWN_RADIUS = (4.0, 60.0)
"""Least and largest radius of what the camera starts by looking at in a site, metres."""


class LidarView(msgspec.Struct, frozen=True):
    """A LiDAR: its name, the number of its colour, and its pose in the plan; null if refused."""

    name: str
    colour: int
    T: Array | None


class LineView(msgspec.Struct, frozen=True):
    """A pole of a placement: both ends (3,), metres, and its name."""

    placement: int
    a: Array
    b: Array
    label: str


class MarkView(msgspec.Struct, frozen=True):
    """A marked place (3,), metres, and what is written next to it."""

    at: Array
    label: str


class CloudView(msgspec.Struct, frozen=True):
    """One recording: whose and of which placement, and what is in it, in its LiDAR's frame.

    `contradicting` are the points where the other LiDAR looked through, by the id of
    the pose.
    """

    lidar: int
    placement: int
    points: PackedCloud
    poles: list[LineView]
    rejected: list[MarkView]
    contradicting: dict[str, PackedPoints]


class PoseView(msgspec.Struct, frozen=True):
    """A pose of the source of a pair: ``result``, or a hypothesis by its letter."""

    id: str
    label: str
    T: Array


class EllipsoidView(msgspec.Struct, frozen=True):
    """1 σ ellipsoid of the source's origin in the target frame.

    Attributes
    ----------
    centre, axes
        (3,) and (3, 3), its half axes row by row, enlarged; metres.
    factor
        By how much the axes are enlarged.
    """

    centre: Array
    axes: Array
    factor: float


class PageView(msgspec.Struct, frozen=True):
    """All that the code of the page is given.

    Attributes
    ----------
    kind
        ``pair``, ``site``; ``alone`` where a site has no poses and each LiDAR is shown by itself;
        or ``recordings``, which are shown so, too.
    poles
        Of the whole site, in the plan.
    poses, ellipsoid, places
        Of a pair; the places alone decide a direction of the pose, target frame.
    centre, radius
        Where the camera looks in a site, in the plan; metres.
    """

    kind: str
    status: str
    lidars: list[LidarView]
    placements: list[str]
    clouds: list[CloudView]
    poles: list[LineView]
    poses: list[PoseView]
    ellipsoid: EllipsoidView | None
    places: list[MarkView]
    centre: Array
    radius: float
    shown: str


def page_view(subject: Subject, plan: Plan, max_points: int = MAX_CLOUD_POINTS) -> PageView | None:
    """Pack what the view shows; None if nothing was recorded.

    Parameters
    ----------
    subject
        What the page is of.
    plan
        How the site is turned: the view's z axis points up.
    max_points
        At most this many points of each cloud.
    """
    subject, origin = _about_rough_place(subject)
    site, pair = subject.site, subject.pair
    recorded = [
        (k, j, scan)
        for k, of_lidar in enumerate(subject.scans)
        for j, scan in enumerate(of_lidar)
        if scan is not None
    ]
    if not recorded:
        return None
    most = MAX_SITE_POINTS if pair is None else MAX_PAIR_POINTS
    budget = min(max_points, most // len(recorded))
    T_plan_site = se3.from_rt(plan.R_plan_site, np.zeros(3))
    poses = [] if pair is None else _poses(pair)
    marked = _contradicting(subject, poses)
    origins = [origin, *np.zeros((len(site.lidars) - 1, 3))]
    clouds = [
        CloudView(
            k,
            j,
            pack_cloud(scan.cloud, scan.detection, max_points=budget),
            _lines(subject, k, j, scan, origins[k]),
            _marks(scan, origins[k]),
            marked.get((k, j), {}),
        )
        for k, j, scan in recorded
    ]
    lidars = [
        LidarView(
            each.name,
            k % COLOURS,
            None if each.T_site_lidar is None else T_plan_site @ each.T_site_lidar,
        )
        for k, each in enumerate(site.lidars)
    ]
    R = plan.R_plan_site
    poles = [
        _line(pole.placement, R @ pole.point, R @ pole.direction, pole.length, label)
        for pole, label in zip(site.poles, pole_labels(site), strict=True)
    ]
    places = [each.T[:3, 3] for each in lidars if each.T is not None]
    centre, radius = _look(places + [pole.a for pole in poles])
    return PageView(
        "pair" if pair is not None else "site" if subject.answered else "alone",
        site.status,
        lidars,
        subject.placements,
        clouds,
        poles,
        poses,
        None if pair is None else _ellipsoid(pair),
        [] if pair is None else _places(pair, origin),
        centre,
        radius,
        _shown(clouds),
    )


def _about_rough_place(subject: Subject) -> tuple[Subject, Array]:
    """Draw a map about the LiDAR's rough place (3,): large coordinates make no picture."""
    pair, scans = subject.pair, subject.scans
    first = next(iter(scans[0]), None) if scans else None
    if pair is None or first is None or not first.cloud.is_map:
        return subject, np.zeros(3)
    local = se3.from_rt(np.eye(3), -first.cloud.origin)
    T = pair.T_target_source
    of_map = [s and replace(s, cloud=s.cloud.transformed(local)) for s in scans[0]]
    near = structs.replace(
        pair,
        T_target_source=None if T is None else local @ T,
        hypotheses=[
            structs.replace(each, T_target_source=local @ each.T_target_source)
            for each in pair.hypotheses
        ],
    )
    return replace(subject, pair=near, scans=(of_map, *scans[1:])), first.cloud.origin


def recordings_view(names: Sequence[str], scans: Sequence[Scan]) -> PageView:
    """Pack recordings, each in its frame and with a threshold to move where it has tape."""
    budget = min(MAX_RECORDING_POINTS, MAX_SITE_POINTS // len(scans))
    clouds = []
    for k, scan in enumerate(scans):
        packed = pack_cloud(
            scan.cloud, scan.detection, max_points=budget, threshold=_threshold(scan)
        )
        ends = [(pole.point, pole.direction, pole.length) for pole in scan.poles]
        lines = [_line(0, *each, f"pole {i}") for i, each in enumerate(ends)]
        clouds.append(CloudView(k, 0, packed, lines, _marks(scan, np.zeros(3)), {}))
    return PageView(
        kind="recordings",
        status="",
        lidars=[LidarView(name, 0, None) for name in names],
        placements=[""],
        clouds=clouds,
        poles=[],
        poses=[],
        ellipsoid=None,
        places=[],
        centre=np.zeros(3),
        radius=SHOWN_RADIUS[0],
        shown=_shown(clouds),
    )


def _threshold(scan: Scan) -> float | None:
    """Intensity from which poles were searched for, or would be; None if there is none."""
    level = scan.cloud.intensity
    if level is None or not np.ptp(level) > 0:
        return None
    return auto_threshold(level).value if scan.detection is None else scan.detection.threshold


ESCAPES = re.compile(r"\\(?:([uUx][0-9a-f]{2,8})|.)")
"""What replaces one sign in JSON and in what is visible; the first for one that is not shown."""


def embed_json(value: object) -> Html:
    """Write JSON that no content can lead out of its script element; not-a-number becomes null.

    What is not `visible` in a text is escaped in the text itself: the page shows the escape.
    """
    text = visible(msgspec.json.encode(value, enc_hook=plain).decode())
    text = ESCAPES.sub(lambda found: rf"\{found[0]}" if found[1] else found[0], text)
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return Html(text)


def _contradicting(
    subject: Subject, poses: Sequence[PoseView]
) -> dict[tuple[int, int], dict[str, PackedPoints]]:
    """Pack the points of each cloud of a pair that contradict each pose."""
    if not poses:
        return {}
    # As the run draws them: the same points, where the recordings are the same.
    rng, packed = np.random.default_rng(0), {}
    limit = MAX_CONTRADICTING // len(subject.scans[0])
    for j, both in enumerate(zip(*subject.scans, strict=True)):
        target, source = (objects_in(scan.cloud, rng) for scan in both if scan is not None)
        found = {pose.id: contradicting_points(target, source, pose.T) for pose in poses}
        for k in range(2):
            packed[k, j] = {
                name: pack_points(points[k][:: 1 + len(points[k]) // limit])
                for name, points in found.items()
            }
    return packed


def _shown(clouds: Sequence[CloudView]) -> str:
    shown, total, far = (
        sum(getattr(each.points, name) for each in clouds) for name in ("shown", "total", "far")
    )
    text = f"{counted(len(clouds), 'cloud')}; the page shows {shown:,} of {total:,} points"
    return text + (f", {far:,} beyond {MAX_SHOWN_RANGE:g} m left out" if far else "")


def _lines(subject: Subject, k: int, j: int, scan: Scan, origin: Array) -> list[LineView]:
    """Draw the poles of a recording; of a pair's first placement, those that its result lists."""
    listed: Sequence[PoleDoc] = pole_documents(scan.poles)
    if subject.pair is not None and j == 0:
        listed = (subject.pair.poles.target, subject.pair.poles.source)[k]
    return [
        _line(j, pole.point_m - origin, pole.direction, pole.length_m, subject.pole(k, i))
        for i, pole in enumerate(listed)
    ]


def _line(placement: int, point: Array, direction: Array, length: float, label: str) -> LineView:
    half = 0.5 * length * direction
    return LineView(placement, point - half, point + half, label)


def _marks(scan: Scan, origin: Array) -> list[MarkView]:
    rejected = () if scan.detection is None else scan.detection.rejected
    return [MarkView(cluster.centre - origin, str(k)) for k, cluster in enumerate(rejected)]


def _places(result: ResultDoc, origin: Array) -> list[MarkView]:
    """Places about an origin (3,) that alone decide a direction of the pose, with their shares."""
    return [
        MarkView(
            np.array([r.values[f"{axis}_m"] for axis in "xyz"]) - origin, f"{r.values['share']:.0%}"
        )
        for r in (*result.reasons, *result.notes)
        if r.code == "one_place_decides"
    ]


def _poses(result: ResultDoc) -> list[PoseView]:
    """Every pose the view can show: the result, and the hypotheses it was chosen from."""
    poses = []
    if result.T_target_source is not None:
        poses.append(PoseView("result", "result", result.T_target_source))
    for k, hypothesis in enumerate(result.hypotheses):
        name = hypothesis_name(k)
        label = f"hypothesis {name}" + (" (chosen, poles only)" if hypothesis.chosen else "")
        poses.append(PoseView(name, label, hypothesis.T_target_source))
    return poses


def _ellipsoid(result: ResultDoc) -> EllipsoidView | None:
    if result.covariance is None or result.T_target_source is None:
        return None
    values, vectors = np.linalg.eigh(result.covariance[3:, 3:])
    sigma = np.sqrt(np.maximum(values, 0.0))
    if not sigma[-1] > 0:
        return None
    factor = 10.0 ** max(0, round(float(np.log10(SEEN_SIGMA / sigma[-1]))))
    axes = (vectors * sigma * factor).T
    return EllipsoidView(result.T_target_source[:3, 3], axes, factor)


def _look(points: Sequence[Array]) -> tuple[Array, float]:
    """Choose where the camera looks: the middle of all that is there, and how far around."""
    if not points:
        return np.zeros(3), SHOWN_RADIUS[0]
    stacked = np.array(points)
    centre = (stacked.min(axis=0) + stacked.max(axis=0)) / 2
    reach = float(np.linalg.norm(stacked - centre, axis=1).max())
    return centre, float(np.clip(1.5 * reach, *SHOWN_RADIUS))
