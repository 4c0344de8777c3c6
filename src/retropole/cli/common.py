"""What the commands share: options, reading, progress."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import click

from ..datatypes import PointCloud
from ..result import InputDoc
from ..sensors import SENSORS, Sensor, find_sensor

EXIT_USAGE, EXIT_REFUSED, EXIT_INTERRUPTED = 2, 3, 130

CONTEXT = {"help_option_names": ["-h", "--help"], "max_content_width": 100}

CLOUD = click.Path(path_type=Path)
OUT = click.Path(path_type=Path, file_okay=False)
SENSOR_HELP = f"Sensor's name ({', '.join(SENSORS)}), or auto."

radius_option = click.option(
    "--radius",
    type=click.FloatRange(min=0, min_open=True),
    default=0.02,
    show_default=True,
    help="Radius of the poles, m.",
)


@dataclass(frozen=True, eq=False)
class Input:
    """A cloud as read, what recorded it, and its entry in the result document."""

    cloud: PointCloud
    sensor: Sensor | None
    document: InputDoc


def read_input(path: Path, sensor_name: str, threshold: float | None) -> Input:
    """Read a cloud and look up its sensor."""
    from ..io import read_cloud, sha256_of

    sensor = None if sensor_name == "auto" else find_sensor(sensor_name)
    cloud = read_cloud(path)
    document = InputDoc(
        path=str(path),
        sha256=sha256_of(path),
        points=len(cloud),
        dropped=cloud.dropped,
        sensor="auto" if sensor is None else sensor.name,
        threshold=threshold,
    )
    return Input(cloud, sensor, document)


@contextmanager
def progress_on_terminal(quiet: bool) -> Iterator[Callable[[str], None]]:
    """Name the step under way on a terminal; say nothing in a pipe, where nobody waits."""
    if quiet or not sys.stderr.isatty():
        yield lambda step: None
        return
    from rich.console import Console

    with Console(stderr=True).status("starting") as status:
        yield lambda step: status.update(step)
