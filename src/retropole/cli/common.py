"""What the commands share: options, reading, progress."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
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


TOPIC_HELP = "Topic of the bag; needed where it has several of point clouds."


topic_option = click.option("--topic", metavar="NAME", help=TOPIC_HELP)


def sensor_options(command: Callable[..., int]) -> Callable[..., int]:
    """Give a command --sensor-* and --threshold-*, each for the target and the source."""
    same = "The same for SOURCE."
    for option in (
        click.option("--threshold-source", type=float, help=same),
        click.option(
            "--threshold-target",
            type=float,
            help="Intensity from which a return is retro-reflective, on the file's own scale.  "
            "[default: from the sensor or the cloud]",
        ),
        click.option("--sensor-source", default="auto", show_default=True, help=same),
        click.option("--sensor-target", default="auto", show_default=True, help=SENSOR_HELP),
    ):
        command = option(command)
    return command


def topic_options(command: Callable[..., int]) -> Callable[..., int]:
    """Give a command --target-topic and --source-topic."""
    of_target = click.option("--target-topic", metavar="NAME", help=TOPIC_HELP)
    of_source = click.option("--source-topic", metavar="NAME", help="The same for SOURCE.")
    return of_target(of_source(command))


def _slice(context: click.Context, option: click.Parameter, value: str | None) -> slice | None:
    """Turn ``A:B``, ``A:B:STEP`` or ``N`` into a slice."""
    if value is None:
        return None
    try:
        parts = [int(part) if part.strip() else None for part in value.split(":")]
    except ValueError:
        parts = []
    if len(parts) == 1 and parts[0] is not None:
        return slice(parts[0], parts[0] + 1 or None)
    step = parts[2] if len(parts) == 3 else None
    if len(parts) not in (2, 3) or (step is not None and step < 1):
        raise click.BadParameter(f"{value!r} is no A:B, no A:B:STEP and no frame's number")
    return slice(*parts)


frames_option = click.option(
    "--frames",
    callback=_slice,
    metavar="A:B",
    help="Frames of a recording to read, as Python slices: 0:20, -50:, ::10, 7.  "
    "[default: evenly spread, about a million points]",
)


@dataclass(frozen=True, eq=False)
class Input:
    """A cloud as read: where from, its topic, what recorded it, and the threshold asked for."""

    path: Path
    cloud: PointCloud
    topic: str | None
    sensor: Sensor | None
    threshold: float | None


def read_input(
    path: Path,
    sensor_name: str,
    threshold: float | None,
    *,
    topic: str | None = None,
    frames: slice | None = None,
    quiet: bool = False,
) -> Input:
    """Read a cloud and look up its sensor; say on stderr which frames were left out unasked."""
    from ..io import chosen_frames, joined, open_recording

    sensor = None if sensor_name == "auto" else find_sensor(sensor_name)
    recording = open_recording(path, topic=topic)
    numbers = chosen_frames(recording, frames)
    if frames is None and len(numbers) < recording.count and not quiet:
        click.echo(
            f"retropole: {path}: read {len(numbers)} of {recording.count} frames, every "
            f"{numbers.step}th; --frames A:B reads others",
            err=True,
        )
    cloud = joined(recording, list(recording.read(numbers)))
    return Input(path, cloud, recording.topic, sensor, threshold)


def input_documents(inputs: Sequence[Input]) -> list[InputDoc]:
    """Write the entries of clouds in the result document; each file is hashed once."""
    from ..io import sha256_of

    hashes = {path: sha256_of(path) for path in dict.fromkeys(given.path for given in inputs)}
    return [
        InputDoc(
            path=str(given.path),
            sha256=hashes[given.path],
            points=len(given.cloud),
            dropped=given.cloud.dropped,
            sensor="auto" if given.sensor is None else given.sensor.name,
            threshold=given.threshold,
        )
        for given in inputs
    ]


@contextmanager
def progress_on_terminal(quiet: bool) -> Iterator[Callable[[str], None]]:
    """Name the step under way on a terminal; say nothing in a pipe, where nobody waits."""
    if quiet or not sys.stderr.isatty():
        yield lambda step: None
        return
    from rich.console import Console

    with Console(stderr=True).status("starting") as status:
        yield lambda step: status.update(step)
