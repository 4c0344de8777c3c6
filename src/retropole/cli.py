"""The command line: files and printing at the edge of the method."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from .errors import RetropoleError

if TYPE_CHECKING:
    from .datatypes import PointCloud
    from .result import InputDoc
    from .sensors import Sensor

EXIT_USAGE, EXIT_REFUSED, EXIT_INTERRUPTED = 2, 3, 130

CONTEXT = {"help_option_names": ["-h", "--help"], "max_content_width": 100}


@click.group(context_settings=CONTEXT)
@click.version_option(package_name="retropole")
def cli() -> None:
    """Calibrate LiDARs to each other with poles wrapped in retro-reflective tape.

    Put two (or more) taped poles, not parallel, about 5 m away where both LiDARs see them, record
    a moment on each, and run

    \b
        retropole calibrate target.pcd source.pcd

    The answer maps points of the source LiDAR into the frame of the target LiDAR.
    """


def main() -> None:
    """Run the command line; every error of retropole ends here."""
    try:
        code = cli.main(standalone_mode=False)
    except click.ClickException as error:
        error.show()
        code = EXIT_USAGE
    except RetropoleError as error:
        click.echo(f"retropole: {error}", err=True)
        code = EXIT_USAGE
    except (KeyboardInterrupt, click.Abort):
        click.echo("retropole: interrupted", err=True)
        code = EXIT_INTERRUPTED
    except OSError as error:
        click.echo(f"retropole: {error}", err=True)
        code = EXIT_USAGE
    sys.exit(code or 0)


@contextmanager
def _progress(quiet: bool) -> Iterator[Callable[[str], None]]:
    """Name the step under way on a terminal; say nothing in a pipe, where nobody waits."""
    if quiet or not sys.stderr.isatty():
        yield lambda step: None
        return
    from rich.console import Console

    with Console(stderr=True).status("starting") as status:
        yield lambda step: status.update(step)


def _read(path: Path, sensor_name: str, threshold: float | None) -> _Input:
    from .io import read_cloud, sha256_of
    from .result import InputDoc
    from .sensors import find_sensor

    sensor = None if sensor_name == "auto" else find_sensor(sensor_name)
    cloud = read_cloud(path)
    document = InputDoc(
        str(path), sha256_of(path), len(cloud), cloud.dropped, sensor_name, threshold
    )
    return cloud, sensor, document


_Input = tuple["PointCloud", "Sensor | None", "InputDoc"]

_CLOUD = click.Path(path_type=Path)
_OUT = click.Path(path_type=Path, file_okay=False)
_SENSOR_HELP = "Sensor's name (see 'retropole detect --help'), or auto."


@cli.command(context_settings=CONTEXT)
@click.argument("target", type=_CLOUD)
@click.argument("source", type=_CLOUD)
@click.option(
    "--out",
    type=_OUT,
    default=Path("retropole-out"),
    show_default=True,
    help="Folder for result.json and report.html.",
)
@click.option(
    "--radius",
    type=click.FloatRange(min=0, min_open=True),
    default=0.02,
    show_default=True,
    help="Radius of the poles, m.",
)
@click.option("--sensor-target", default="auto", show_default=True, help=_SENSOR_HELP)
@click.option("--sensor-source", default="auto", show_default=True, help="The same for SOURCE.")
@click.option(
    "--threshold-target",
    type=float,
    help="Intensity from which a return is retro-reflective, on the file's own scale.  "
    "[default: from the sensor or the cloud]",
)
@click.option("--threshold-source", type=float, help="The same for SOURCE.")
@click.option(
    "--poles",
    type=click.IntRange(min=2),
    help="Exact number of poles that both see.  [default: any, at least 2]",
)
@click.option("--no-refine", "refine", flag_value=False, default=True, help="Use the poles only.")
@click.option(
    "--seed",
    type=click.IntRange(min=0),
    default=0,
    show_default=True,
    help="Seed of whatever is drawn at random.",
)
@click.option("--json", "as_json", is_flag=True, help="Print the result document, and only that.")
@click.option("-q", "--quiet", is_flag=True, help="Print nothing but errors.")
def calibrate(
    target: Path,
    source: Path,
    out: Path,
    radius: float,
    sensor_target: str,
    sensor_source: str,
    threshold_target: float | None,
    threshold_source: float | None,
    poles: int | None,
    refine: bool,
    seed: int,
    as_json: bool,
    quiet: bool,
) -> int:
    """Find the transform that maps points of SOURCE into the frame of TARGET.

    TARGET and SOURCE are point cloud files with an intensity (PCD, PLY, LAS, LAZ, BIN, NPY, NPZ,
    CSV, XYZ), or folders of such files, one a sweep.

    \b
    Examples:
      retropole calibrate front.pcd rear.pcd
      retropole calibrate front.pcd rear.pcd --radius 0.03 --out today
      retropole calibrate front/ rear/ --sensor-target VLP-16 --threshold-source 150
      retropole calibrate front.pcd rear.pcd --json | jq .T_target_source

    \b
    Exit code:
      0    calibrated; the verdict is ok, or warn with what is weak
      2    a file or an option is wrong
      3    refused: the data carry no answer; the reason is printed and in result.json
      130  interrupted
    """
    import json
    import time

    from .files import write_atomically
    from .pipeline import calibrate as run
    from .report import render_report
    from .result import encode, result_document
    from .summary import describe_result

    with _progress(quiet) as progress:
        progress("read")
        start = time.perf_counter()
        target_cloud, target_sensor, target_document = _read(
            target, sensor_target, threshold_target
        )
        source_cloud, source_sensor, source_document = _read(
            source, sensor_source, threshold_source
        )
        seconds = {"read": time.perf_counter() - start}
        calibration = run(
            target_cloud,
            source_cloud,
            radius=radius,
            sensors=(target_sensor, source_sensor),
            thresholds=(threshold_target, threshold_source),
            poles=poles,
            progress=progress,
        )
    for document, detection in zip(
        (target_document, source_document), calibration.detections, strict=True
    ):
        if detection is not None:
            document.threshold = detection.threshold
    result = result_document(
        calibration,
        inputs=(target_document, source_document),
        config={
            "radius_m": radius,
            "poles": poles,
            "refine": refine,
            "seed": seed,
            "threshold_target": threshold_target,
            "threshold_source": threshold_source,
            "sensor_target": sensor_target,
            "sensor_source": sensor_source,
        },
        seconds={**seconds, **calibration.seconds},
    )
    written = [out / "result.json", out / "report.html"]
    data = encode(result)
    write_atomically(written[0], data)
    page = render_report(json.loads(data), target_cloud, source_cloud, calibration.detections)
    write_atomically(written[1], page.encode())
    if as_json:
        click.echo(data, nl=False)
    elif not quiet:
        click.echo(describe_result(result, [str(path) for path in written]))
    if calibration.status == "refused":
        for reason in calibration.reasons:
            click.echo(f"retropole: refused ({reason.code}): {reason.message}", err=True)
        return EXIT_REFUSED
    return 0


@cli.command(context_settings=CONTEXT)
@click.argument("file", type=_CLOUD)
@click.option(
    "--out",
    type=_OUT,
    default=Path("retropole-out"),
    show_default=True,
    help="Folder for detect.png.",
)
@click.option(
    "--radius",
    type=click.FloatRange(min=0, min_open=True),
    default=0.02,
    show_default=True,
    help="Radius of the poles, m.",
)
@click.option("--sensor", default="auto", show_default=True, help=_SENSOR_HELP)
@click.option("--threshold", type=float, help="Intensity from which a return is retro-reflective.")
@click.option("--json", "as_json", is_flag=True, help="Print the findings as JSON, and only that.")
@click.option("-q", "--quiet", is_flag=True, help="Print nothing but errors.")
def detect(
    file: Path,
    out: Path,
    radius: float,
    sensor: str,
    threshold: float | None,
    as_json: bool,
    quiet: bool,
) -> int:
    """Show the poles in FILE, and why every other retro-reflective thing is none.

    Writes a picture, detect.png (needs the optional part 'figures').

    \b
    Examples:
      retropole detect front.pcd
      retropole detect front.pcd --threshold 120 --out look
      retropole detect front.pcd --json | jq .poles

    \b
    Exit code:
      0    looked, and found poles or none
      2    the file or an option is wrong
      3    refused: the file has no intensity
    """
    from .errors import MissingExtraError, Refusal
    from .extraction import extract_poles
    from .result import detection_document, encode
    from .summary import describe_detection

    with _progress(quiet) as progress:
        progress("read")
        cloud, known_sensor, document = _read(file, sensor, threshold)
        progress("extract")
        try:
            found = extract_poles(cloud, sensor=known_sensor, threshold=threshold, radius=radius)
        except Refusal as refusal:
            click.echo(f"retropole: refused ({refusal.code}): {refusal}", err=True)
            return EXIT_REFUSED
        document.threshold = found.threshold
        written: list[str] = []
        progress("draw")
        try:
            from .figures import draw_detection

            draw_detection(cloud, found, out / "detect.png", title=file.name)
            written.append(str(out / "detect.png"))
        except MissingExtraError as error:
            click.echo(f"retropole: no picture: {error}", err=True)
    result = detection_document(found, document)
    if as_json:
        click.echo(encode(result), nl=False)
    elif not quiet:
        click.echo(describe_detection(result, written))
    return 0


@cli.command(context_settings=CONTEXT)
@click.argument("scene", type=click.Choice(["corridor", "street", "harbor", "paper", "bare"]))
@click.option(
    "--out",
    type=_OUT,
    default=Path("retropole-simulated"),
    show_default=True,
    help="Folder for lidar0.pcd (the target), lidar1.pcd (the source) and truth.json.",
)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
@click.option("--sensor-target", help="Sensor's name.  [default: as the scene has it]")
@click.option("--sensor-source", help="The same for the source.")
@click.option("--poles", type=click.IntRange(min=1), default=2, show_default=True)
@click.option(
    "--radius",
    type=click.FloatRange(min=0, min_open=True),
    default=0.02,
    show_default=True,
    help="Radius of the poles, m.",
)
@click.option("-q", "--quiet", is_flag=True, help="Print nothing but errors.")
def simulate(
    scene: str,
    out: Path,
    seed: int,
    sensor_target: str | None,
    sensor_source: str | None,
    poles: int,
    radius: float,
    quiet: bool,
) -> int:
    """Make two scans of taped poles whose true transform is known.

    \b
    Examples:
      retropole simulate street --seed 1 --out s
      retropole calibrate s/lidar0.pcd s/lidar1.pcd
      retropole simulate harbor --sensor-target VLP-16 --sensor-source VLP-16 --poles 3
    """
    import numpy as np

    from .simulation import simulate_pair, write_pair

    with _progress(quiet) as progress:
        progress("simulate")
        pair = simulate_pair(
            scene,
            np.random.default_rng(seed),
            sensor_target=sensor_target,
            sensor_source=sensor_source,
            poles=poles,
            radius=radius,
        )
        write_pair(pair, out)
    if not quiet:
        names = ", ".join(str(out / name) for name in ("lidar0.pcd", "lidar1.pcd", "truth.json"))
        click.echo(f"written: {names}")
    return 0
