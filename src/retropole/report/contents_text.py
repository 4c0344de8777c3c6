"""What a recording holds in words, for a terminal."""

from __future__ import annotations

import numpy as np

from ..base.quantities import counted
from ..result.contents import CloudDoc, InfoDoc, IntensityDoc
from .layout import legible, table

BAR = 40
"""Characters of the longest bar of a histogram."""


def describe_info(document: InfoDoc) -> str:
    """Write what is in a recording as a person reads it."""
    document = legible(document)
    parts = [document.path]
    if document.topics:
        rows = [[topic.name, topic.type, str(topic.messages)] for topic in document.topics]
        parts.append(table(("topic", "type", "messages"), rows))
    for cloud in document.clouds:
        parts += ["", *_cloud_lines(cloud)]
    return "\n".join(parts)


def describe_cloud(cloud: CloudDoc) -> str:
    """Write what is in the frames of a file, or of one topic of a bag."""
    return "\n".join(_cloud_lines(legible(cloud)))


def _cloud_lines(cloud: CloudDoc) -> list[str]:
    read = "" if cloud.frames_read == cloud.frames else f" ({cloud.frames_read} read"
    if read:
        read += f", every {cloud.step}th)" if cloud.step > 1 else ")"
    rate = "unknown" if cloud.rate_hz is None else f"{cloud.rate_hz:.2f} Hz"
    duration = "" if cloud.duration_s is None else f", {cloud.duration_s:.1f} s"
    fields = ", ".join(f"{name} {kind}" for name, kind in cloud.fields.items())
    near, middle, far = cloud.range_m
    lines = [
        *([f"topic      {cloud.topic}"] if cloud.topic else []),
        *([f"frame_id   {cloud.frame_id}"] if cloud.frame_id else []),
        f"frames     {cloud.frames}{read}",
        f"rate       {rate}{duration}",
        f"fields     {fields}",
        f"points     {cloud.points:,} ({cloud.dropped:,} dropped), "
        f"{cloud.points / cloud.frames_read:,.0f} a frame",
        *(f"note       {note}" for note in cloud.notes),
        f"rings      {'none' if cloud.rings is None else cloud.rings}"
        + (f", ignored: {cloud.rings_ignored}" if cloud.rings_ignored else ""),
        *([_beams_line(cloud.beam_origin_m)] if cloud.told_by_rings else []),
        f"range      {near:.2f} to {far:.2f} m, median {middle:.2f} m",
        *_odd_lines(cloud),
        f"sensor     {' or '.join(cloud.sensors) or 'unknown'}",
    ]
    if cloud.intensity is None:
        return [*lines, "intensity  none: tape cannot be told from the rest"]
    return lines + _intensity_lines(cloud.intensity)


def _odd_lines(cloud: CloudDoc) -> list[str]:
    """Say what is odd about the coordinates, and what to do about it."""
    if not cloud.odd_coordinates:
        return []
    options = " or ".join(f"--unit {unit}" for unit in cloud.units)
    advice = (
        f"read them with {options}, here and in every command"
        if options
        else "give the cloud in metres and in the LiDAR's own frame, or subtract the LiDAR's "
        "place from all points"
    )
    return [f"           {cloud.odd_coordinates}", f"           what to do: {advice}"]


def _beams_line(origin: list[float]) -> str:
    x, y, z = origin
    return f"beams      start at ({x:.3f}, {y:.3f}, {z:.3f}) m, as the rings tell"


def _intensity_lines(intensity: IntensityDoc) -> list[str]:
    values = f"median {intensity.median:.4g}, 95 % below {intensity.p95:.4g}"
    lines = [f"intensity  {values}, largest {intensity.max:.4g}"]
    if intensity.threshold is None:
        return [*lines, f"threshold  {intensity.threshold_source}; tape cannot be told"]
    lines += [
        f"threshold  {intensity.threshold:.4g} would be taken ({intensity.threshold_source}): "
        f"{counted(intensity.retro_points, 'point')}",
        "",
        "  intensity from     points  (bars on a logarithmic scale)",
    ]
    # Few returns are tape: on an even scale their bars would not be seen.
    longest = np.log1p(max(intensity.counts))
    edges = intensity.bin_edges
    marked = np.searchsorted(edges[1:-1], intensity.threshold, side="right")
    for k, count in enumerate(intensity.counts):
        bar = "█" * round(BAR * float(np.log1p(count) / longest))
        mark = "  ← threshold" if k == marked else ""
        lines.append(f"  {edges[k]:14.4g} {count:10,}  {bar}{mark}".rstrip())
    return lines
