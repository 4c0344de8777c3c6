"""What the page's view draws: clouds, poles, poses and the ellipsoid, as the JSON of its code."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np

from ..base.datatypes import Array, Placement, Scan
from ..result import PoleDoc, ResultDoc, plain, pole_documents
from ..scene.consistency import contradicting_points, standing_in
from .names import LIDARS, hypothesis_name, pole_name
from .points import MAX_SHOWN_RANGE, PackedCloud, PackedPoints, pack_cloud, pack_points

SEEN_SIGMA = 0.7
"""The ellipsoid is enlarged by a power of ten until its longest half axis is about so long, metres.
"""

MAX_CONTRADICTING = 2000
"""Points of each cloud that are marked as contradicting a pose, of all placements together."""


class LineView(msgspec.Struct, frozen=True):
    """A pole: both ends (3,), metres, in its LiDAR's frame, and its name."""

    a: list[float]
    b: list[float]
    label: str


class MarkView(msgspec.Struct, frozen=True):
    """A rejected cluster: its centre (3,), metres, in its LiDAR's frame, and its number."""

    at: list[float]
    label: str


class PlacementView(msgspec.Struct, frozen=True):
    """One placement: its files, how much of the clouds is shown, and for each LiDAR what is.

    `contradicting` are the points that stand where the other LiDAR looked through, by the id of
    the pose; each in its LiDAR's frame.
    """

    files: str
    shown: str
    clouds: list[PackedCloud]
    poles: list[list[LineView]]
    rejected: list[list[MarkView]]
    contradicting: dict[str, list[PackedPoints]]


class PoseView(msgspec.Struct, frozen=True):
    """A pose that the view can show, 4×4 row by row: ``result``, or a hypothesis by its letter."""

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

    centre: list[float]
    axes: Array
    factor: float


class PageView(msgspec.Struct, frozen=True):
    """All that the page's own code is given.

    `places` alone decide a direction of the pose, in the target's frame.
    """

    status: str
    placements: list[PlacementView]
    poses: list[PoseView]
    ellipsoid: EllipsoidView | None
    places: list[MarkView]


def page_view(
    result: ResultDoc, placements: Sequence[Placement], names: Sequence[str], max_points: int
) -> PageView:
    """Pack what the view shows.

    Parameters
    ----------
    result
        The result document.
    placements
        What was recorded and found, the first placement first.
    names
        Of the inputs, target and source of each placement.
    max_points
        At most this many points of each cloud.
    """
    views, poses = [], _poses(result)
    # As the run draws them: the same points, where the recordings are the same.
    rng = np.random.default_rng(0)
    for k, placement in enumerate(placements):
        # The poles of the first placement are those that the result lists, also where the cloud
        # that is shown is another.
        poles = (
            (result.poles.target, result.poles.source)
            if k == 0
            else (pole_documents(placement.target.poles), pole_documents(placement.source.poles))
        )
        contradicting = _contradicting(placement, poses, MAX_CONTRADICTING // len(placements), rng)
        files = names[2 * k : 2 * k + 2]
        views.append(_placement(placement, poles, contradicting, files, max_points))
    return PageView(result.status, views, poses, _ellipsoid(result), _places(result))


def embed_json(value: object) -> str:
    """Write JSON that no content can lead out of its script element; not-a-number becomes null."""
    text = msgspec.json.encode(value, enc_hook=plain).decode()
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text


def _placement(
    placement: Placement,
    poles: tuple[Sequence[PoleDoc], Sequence[PoleDoc]],
    contradicting: dict[str, list[PackedPoints]],
    names: Sequence[str],
    max_points: int,
) -> PlacementView:
    scans = (placement.target, placement.source)
    clouds = [pack_cloud(scan.cloud, scan.detection, max_points=max_points) for scan in scans]
    return PlacementView(
        files=" ← ".join(names),
        shown="; ".join(_shown(lidar, c) for lidar, c in zip(LIDARS, clouds, strict=True)),
        clouds=clouds,
        poles=[_lines(lidar, listed) for lidar, listed in zip(LIDARS, poles, strict=True)],
        rejected=[_marks(scan) for scan in scans],
        contradicting=contradicting,
    )


def _contradicting(
    placement: Placement, poses: Sequence[PoseView], max_points: int, rng: np.random.Generator
) -> dict[str, list[PackedPoints]]:
    """Pack the points that contradict each pose, at most so many of each cloud."""
    target, source = (standing_in(s.cloud, rng) for s in (placement.target, placement.source))
    found = {p.id: contradicting_points(target, source, p.T) for p in poses}
    return {
        name: [pack_points(points[:: 1 + len(points) // max_points]) for points in each]
        for name, each in found.items()
    }


def _shown(lidar: str, cloud: PackedCloud) -> str:
    text = f"{lidar}: showing {cloud.shown:,} of {cloud.total:,} points"
    return text + (f", {cloud.far:,} beyond {MAX_SHOWN_RANGE:g} m left out" if cloud.far else "")


def _lines(lidar: str, poles: Sequence[PoleDoc]) -> list[LineView]:
    lines = []
    for k, pole in enumerate(poles):
        point, half = pole.point_m, 0.5 * pole.length_m * pole.direction
        lines.append(
            LineView((point - half).tolist(), (point + half).tolist(), pole_name(lidar, k))
        )
    return lines


def _marks(scan: Scan) -> list[MarkView]:
    if scan.detection is None:
        return []
    rejected = scan.detection.rejected
    return [MarkView(cluster.centre.tolist(), str(k)) for k, cluster in enumerate(rejected)]


def _places(result: ResultDoc) -> list[MarkView]:
    """Places that alone decide a direction of the pose, each with the share that it holds."""
    return [
        MarkView([float(r.values[f"{axis}_m"]) for axis in "xyz"], f"{r.values['share']:.0%}")
        for r in result.reasons
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
    centre = [row[3] for row in result.T_target_source[:3]]
    return EllipsoidView(centre, (vectors * sigma * factor).T, factor)
