"""The command ``retropole calibrate``."""

from __future__ import annotations

from pathlib import Path

import click

from .common import (
    CLOUD,
    CONTEXT,
    EXIT_REFUSED,
    OUT,
    SENSOR_HELP,
    progress_on_terminal,
    radius_option,
    read_input,
)


@click.command(context_settings=CONTEXT)
@click.argument("target", type=CLOUD)
@click.argument("source", type=CLOUD)
@click.option(
    "--out",
    type=OUT,
    default=Path("retropole-out"),
    show_default=True,
    help="Folder for result.json and report.html.",
)
@radius_option
@click.option("--sensor-target", default="auto", show_default=True, help=SENSOR_HELP)
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

    from ..files import write_atomically
    from ..pipeline import calibrate as run
    from ..report import render_report
    from ..result import encode, result_document
    from ..summary import describe_result

    with progress_on_terminal(quiet) as progress:
        progress("read")
        start = time.perf_counter()
        inputs = (
            read_input(target, sensor_target, threshold_target),
            read_input(source, sensor_source, threshold_source),
        )
        seconds = {"read": time.perf_counter() - start}
        calibration = run(
            inputs[0].cloud,
            inputs[1].cloud,
            radius=radius,
            sensors=(inputs[0].sensor, inputs[1].sensor),
            thresholds=(threshold_target, threshold_source),
            poles=poles,
            scene=refine,
            progress=progress,
        )
    for given, detection in zip(inputs, calibration.detections, strict=True):
        if detection is not None:
            given.document.threshold = detection.threshold
    result = result_document(
        calibration,
        inputs=[given.document for given in inputs],
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
    page = render_report(json.loads(data), inputs[0].cloud, inputs[1].cloud, calibration.detections)
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
