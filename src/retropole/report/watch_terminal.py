"""What a watch sees and reports, drawn on a terminal."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from ..base.errors import printable
from ..base.quantities import at_most
from ..base.uncertainty.purpose import whole_percent
from ..result.watching import ChartNow, LidarNow, WalkNow, WatchDoc

COLUMNS, ROWS = 64, 18
"""Of the way of a pole that is carried."""


def drawn(said: WatchDoc) -> RenderableType:
    """Draw the next thing to do, and below it what is seen; all words are shown as they are."""
    colour = "green" if said.is_good else "red"
    if said.status == "warn" and said.phase == "done":
        colour = "yellow"
    field = Panel(
        Text(printable(said.next), style=f"bold {colour}"),
        title=said.phase,
        title_align="left",
        border_style=colour,
        padding=(1, 2),
    )
    return Group(field, *_below(said))


def _below(said: WatchDoc) -> Iterator[RenderableType]:
    if said.wanted:
        yield ProgressBar(said.wanted, min(said.captured, said.wanted), width=60)
    if said.walk is not None:
        yield from _walk(said.walk)
    yield _table(said.lidars)
    for lidar in said.lidars:
        if lidar.skipped:
            yield Text(printable(lidar.skipped))
    parts = []
    if said.angle_rad is not None:
        parts.append(f"angle between the poles {math.degrees(said.angle_rad):.0f}°")
    if said.placements:
        parts.append(f"placements kept {said.placements}")
    if said.need is not None:
        now = ""
        if said.bound_m is not None and said.probability is not None:
            now = f", now {at_most(said.bound_m)}, {whole_percent(said.probability)}"
        parts.append(f"needed {said.need.text}{now}")
    yield Text("; ".join(parts))
    for line in said.words[-6:]:
        yield Text(printable(line), style="dim")


def _walk(walk: WalkNow) -> Iterator[RenderableType]:
    """Draw the way of the pole from above, and how the error falls."""
    for chart in walk.charts:
        yield _from_above(chart)
    if walk.bounds:
        falls = ", ".join(at_most(bound) for _, bound in walk.bounds[-5:])
        yield Text(
            f"both saw the pole for {walk.seconds:.0f} s; no point up to {walk.at_m:g} m away is "
            f"off by more than {falls}, 95 % sure"
        )


def _from_above(chart: ChartNow) -> Text:
    """Draw a chart in characters, which are twice as high as wide: LiDARs as L, ways as dots."""
    ways = [np.reshape(path, (-1, 2)) for path in chart.paths]
    low, high = (
        each(np.concatenate([np.reshape(chart.lidars, (-1, 2)), *ways]), axis=0)
        for each in (np.min, np.max)
    )
    scale = min((COLUMNS - 1) / 2, ROWS - 1) / max(float((high - low).max()), 1.0)
    cells: dict[tuple[int, int], tuple[str, str]] = {}
    for k, (lidar, way) in enumerate(zip(chart.lidars, ways, strict=True)):
        marks = [(point, "·") for point in way] + [(np.array(lidar), "L")]
        if len(way):
            marks.append((way[-1], "o"))
        for point, mark in marks:
            across, up = np.round((point - low) * scale * [2, 1]).astype(int).tolist()
            cells[up, across] = mark, ("cyan", "magenta")[k % 2]
    text = Text()
    height, width = (max(own) for own in zip(*cells, strict=True))
    for up in range(height, -1, -1):
        for across in range(width + 1):
            text.append(*cells.get((up, across), (" ", "")))
        text.append("\n")
    for k, name in enumerate(chart.names):
        text.append(printable(f"L {name}  "), ("cyan", "magenta")[k % 2])
    return text.append(f"· path of the pole, o now; 1 m is {2 * scale:.1f} columns")


def _table(lidars: list[LidarNow]) -> Table:
    table = Table(box=None, pad_edge=False)
    for title in ("LiDAR", "sweeps/s", "age", "points", "pole", "away", "returns", "rings", ""):
        table.add_column(title, justify="left" if title in ("LiDAR", "") else "right")
    for lidar in lidars:
        age = "–" if lidar.age_s is None else f"{lidar.age_s:.1f} s"
        own = [lidar.name, f"{lidar.sweeps_per_s:.1f}", age, f"{lidar.points:,}"]
        rows = [
            (
                pole.name,
                f"{pole.distance_m:.1f} m",
                str(pole.returns),
                "–" if pole.rings is None else str(pole.rings),
                Text(pole.word or "good", style="green" if pole.is_good else "red"),
            )
            for pole in lidar.poles
        ]
        rows = rows or [("–", "", "", "", Text(printable(lidar.word), style="red"))]
        for k, row in enumerate(rows):
            table.add_row(*(map(printable, own) if k == 0 else [""] * len(own)), *row)
    return table
