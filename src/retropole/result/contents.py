"""What a recording contains, as ``retropole info`` prints it."""

from __future__ import annotations

from typing import Literal

import msgspec


class TopicDoc(msgspec.Struct):
    """A topic of a bag."""

    name: str
    type: str
    messages: int


class IntensityDoc(msgspec.Struct):
    """Intensities: quantiles, a histogram over even bins, and where retro-reflectors may begin."""

    median: float
    p95: float
    max: float
    bin_edges: list[float]
    counts: list[int]
    threshold: float | None
    threshold_source: str
    retro_points: int


class CloudDoc(msgspec.Struct):
    """The frames of a file, or of one topic of a bag; why its rings are ignored, or nothing.

    `beam_origin_m` is where the beams start, and `told_by_rings` whether that is not from the file.
    `odd_coordinates` says why the coordinates cannot be metres about the LiDAR, and `units` which
    units would explain it.
    """

    topic: str | None
    frame_id: str | None
    frames: int
    frames_read: int
    step: int
    rate_hz: float | None
    duration_s: float | None
    fields: dict[str, str]
    points: int
    dropped: int
    notes: list[str]
    rings: int | None
    rings_ignored: str
    beam_origin_m: list[float]
    told_by_rings: bool
    range_m: list[float]
    intensity: IntensityDoc | None
    sensors: list[str]
    odd_coordinates: str
    units: list[str]


class InfoDoc(msgspec.Struct, kw_only=True):
    """What a recording contains, as ``retropole info`` prints it."""

    schema: Literal["retropole/info/1"] = "retropole/info/1"
    path: str
    topics: list[TopicDoc]
    clouds: list[CloudDoc]
