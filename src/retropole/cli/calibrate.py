"""The command ``retropole calibrate``."""

from __future__ import annotations

from pathlib import Path

import click

from ..result import InputDoc
from .common import (
    CLOUD,
    CONTEXT,
    EXIT_REFUSED,
    OUT,
    Input,
    frames_option,
    input_documents,
    progress_on_terminal,
    radius_option,
    read_input,
    sensor_options,
    topic_options,
)


@click.command(context_settings=CONTEXT)
@click.argument("target", type=CLOUD, required=False)
@click.argument("source", type=CLOUD, required=False)
@click.option(
    "--placement",
    "placements",
    type=(CLOUD, CLOUD),
    multiple=True,
    metavar="TARGET SOURCE",
    help="Instead of TARGET and SOURCE: one placement of the poles of several; repeat it.",
)
@click.option(
    "--out",
    type=OUT,
    default=Path("retropole-out"),
    show_default=True,
    help="Folder for result.json and report.html.",
)
@radius_option
@click.option(
    "--radius-sigma",
    type=click.FloatRange(min=0),
    default=0.0,
    show_default=True,
    help="1 sigma of the radius, m; above 0 the radius is estimated.",
)
@sensor_options
@topic_options
@frames_option
@click.option(
    "--poles",
    type=click.IntRange(min=2),
    help="Exact number of poles that both see.  [default: any, at least 2]",
)
@click.option("--up", is_flag=True, help="Both LiDARs stand roughly upright: choose by it.")
@click.option(
    "--prior-rpy-deg",
    type=(float, float, float),
    metavar="R P Y",
    help="Expected roll, pitch and yaw of the source in the target's frame: choose by it.",
)
@click.option(
    "--prior-sigma-deg",
    type=click.FloatRange(min=0, min_open=True),
    default=10.0,
    show_default=True,
    help="1 sigma of --up or --prior-rpy-deg.",
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
    target: Path | None,
    source: Path | None,
    placements: tuple[tuple[Path, Path], ...],
    out: Path,
    radius: float,
    radius_sigma: float,
    sensor_target: str,
    sensor_source: str,
    threshold_target: float | None,
    threshold_source: float | None,
    target_topic: str | None,
    source_topic: str | None,
    frames: slice | None,
    poles: int | None,
    up: bool,
    prior_rpy_deg: tuple[float, float, float] | None,
    prior_sigma_deg: float,
    refine: bool,
    seed: int,
    as_json: bool,
    quiet: bool,
) -> int:
    """Find the transform that maps points of SOURCE into the frame of TARGET.

    TARGET and SOURCE are point cloud files with an intensity (PCD, PLY, LAS, LAZ, BIN, NPY, NPZ,
    CSV, XYZ), folders of such files, one a sweep, ROS bags (.bag, .db3, .mcap, or the folder), or
    packets of a Velodyne or Ouster (.pcap). Both may be the same bag.

    \b
    Examples:
      retropole calibrate front.pcd rear.pcd
      retropole calibrate front.pcd rear.pcd --radius 0.03 --out today
      retropole calibrate front/ rear/ --sensor-target VLP-16 --threshold-source 150
      retropole calibrate front.pcd rear.pcd --json | jq .T_target_source
      retropole calibrate front.pcd rear.pcd --up
      retropole calibrate --placement f1.pcd r1.pcd --placement f2.pcd r2.pcd
      retropole calibrate drive.bag drive.bag --target-topic /front --source-topic /rear
      retropole calibrate front.pcap rear.pcap --frames 100:150

    \b
    Exit code:
      0    calibrated; the verdict is ok, or warn with what is weak
      2    a file or an option is wrong
      3    refused: the data carry no answer; the reason is printed and in result.json
      130  interrupted
    """
    import json
    import time
    from functools import partial

    from ..files import write_atomically
    from ..matching.prior import rotation_prior
    from ..pipeline import calibrate as run
    from ..report import render_report
    from ..report.text import describe_result
    from ..result import encode, result_document

    pairs = _pairs(target, source, placements)
    prior = rotation_prior(up, prior_rpy_deg, prior_sigma_deg)
    read = partial(read_input, frames=frames, quiet=quiet)
    with progress_on_terminal(quiet) as progress:
        progress("read")
        start = time.perf_counter()
        inputs = [
            given
            for of_target, of_source in pairs
            for given in (
                read(of_target, sensor_target, threshold_target, topic=target_topic),
                read(of_source, sensor_source, threshold_source, topic=source_topic),
            )
        ]
        documents = input_documents(inputs)
        _refuse_twins(inputs, documents)
        seconds = {"read": time.perf_counter() - start}
        calibration = run(
            [given.cloud for given in inputs[::2]],
            [given.cloud for given in inputs[1::2]],
            radius=radius,
            radius_sigma=radius_sigma,
            sensors=(inputs[0].sensor, inputs[1].sensor),
            thresholds=(threshold_target, threshold_source),
            poles=poles,
            scene=refine,
            prior=prior,
            progress=progress,
        )
    found = [detection for placement in calibration.placements for detection in placement.found]
    for document, detection in zip(documents, found, strict=False):
        if detection is not None:
            document.threshold = detection.threshold
    result = result_document(
        calibration,
        inputs=documents,
        config={
            "radius_m": radius,
            "radius_sigma_m": radius_sigma,
            "up": up,
            "prior_rpy_deg": prior_rpy_deg,
            "prior_sigma_deg": prior_sigma_deg,
            "poles": poles,
            "refine": refine,
            "seed": seed,
            "threshold_target": threshold_target,
            "threshold_source": threshold_source,
            "sensor_target": sensor_target,
            "sensor_source": sensor_source,
            "target_topic": target_topic,
            "source_topic": source_topic,
            "frames": None if frames is None else [frames.start, frames.stop, frames.step],
        },
        seconds={**seconds, **calibration.seconds},
    )
    written = [out / "result.json", out / "report.html"]
    data = encode(result)
    write_atomically(written[0], data)
    first = calibration.placements[0]
    page = render_report(
        json.loads(data), first.target, first.source, first.found, more=calibration.placements[1:]
    )
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


def _refuse_twins(inputs: list[Input], documents: list[InputDoc]) -> None:
    """Refuse one topic of one bag as both LiDARs: its transform would be the identity."""
    for k in range(0, len(inputs), 2):
        target, source = inputs[k : k + 2]
        same = target.topic is not None and target.topic == source.topic
        if same and documents[k].sha256 == documents[k + 1].sha256:
            raise click.UsageError(
                f"TARGET and SOURCE are both topic {target.topic} of {target.path}; "
                "--target-topic and --source-topic tell two LiDARs of one bag apart"
            )


def _pairs(
    target: Path | None, source: Path | None, placements: tuple[tuple[Path, Path], ...]
) -> list[tuple[Path, Path]]:
    """Take the two arguments, or the placements; never both, never none."""
    if placements and target is not None:
        raise click.UsageError("give TARGET and SOURCE, or --placement for each, not both")
    if placements:
        return list(placements)
    if target is None or source is None:
        raise click.UsageError("TARGET and SOURCE are needed, or --placement TARGET SOURCE")
    return [(target, source)]
