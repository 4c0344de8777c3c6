"""The command ``retropole calibrate``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ..base.datatypes import MAX_RADIUS
from ..base.uncertainty.purpose import DEFAULT_AT, LARGEST_NEED
from ..result import DEFAULT_CONFIG
from .common import (
    ANGLE,
    CLOUD,
    CONTEXT,
    DEGREES,
    EXIT_REFUSED,
    EXIT_WARNED,
    METRES,
    OUT,
    Number,
    command_line,
    echo_left_out,
    echo_refusal,
    echo_sensor_doubt,
    echo_warning,
    frames_option,
    in_colour,
    max_points_option,
    progress_on_terminal,
    radius_option,
    sensor_options,
    show,
    topic_options,
    unit_options,
)
from .older import DEFAULT_OUT, SettingAside, older_set_aside

if TYPE_CHECKING:
    from ..api.inputs import Input
    from ..io.units import Unit

CENTIMETRES = Number(min=0, min_open=True, max=100 * LARGEST_NEED)


@click.command(cls=SettingAside, context_settings=CONTEXT)
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
    default=DEFAULT_OUT,
    show_default=True,
    help="Folder for result.json and report.html.",
)
@radius_option
@click.option(
    "--radius-sigma",
    type=Number(min=0, max=MAX_RADIUS),
    default=DEFAULT_CONFIG.radius_sigma_m,
    show_default=True,
    help="1 sigma of the radius, m; at least 2 % of it is taken.",
)
@sensor_options
@topic_options
@frames_option
@max_points_option
@unit_options
@click.option(
    "--poles",
    type=click.IntRange(min=2),
    help="Exact number of poles that both see.  [default: any, at least 2]",
)
@click.option("--up", is_flag=True, help="Both LiDARs stand roughly upright: choose by it.")
@click.option(
    "--prior-rpy-deg",
    type=(ANGLE, ANGLE, ANGLE),
    metavar="R P Y",
    help="Expected roll, pitch and yaw of the source in the target's frame: choose by it.",
)
@click.option(
    "--prior-sigma-deg",
    type=DEGREES,
    default=DEFAULT_CONFIG.prior_sigma_deg,
    show_default=True,
    help="1 sigma of --up or --prior-rpy-deg.",
)
@click.option(
    "--hypothesis",
    metavar="LETTER",
    help="Take the hypothesis of this letter in the list that the same run prints without: warn at "
    "best, and refused where the scene denies it.",
)
@click.option("--no-refine", "refine", flag_value=False, default=True, help="Use the poles only.")
@click.option(
    "--trust-poles",
    is_flag=True,
    help="Vouch for two poles where the scene has too little to confirm them.",
)
@click.option(
    "--need-cm",
    type=CENTIMETRES,
    help="Accuracy that is needed, cm: the verdict says whether no point up to --at-m away is off "
    "by more, 95 % sure.",
)
@click.option(
    "--at-m",
    type=METRES,
    help=f"Distance up to which --need-cm must hold, m.  [default: {DEFAULT_AT:g}]",
)
@click.option("--strict", is_flag=True, help="Exit with 1 where the verdict is warn.")
@click.option(
    "--seed",
    type=click.IntRange(min=0),
    default=DEFAULT_CONFIG.seed,
    show_default=True,
    help="Seed of whatever is drawn at random.",
)
@click.option("--json", "as_json", is_flag=True, help="Print the result document, and only that.")
@click.option(
    "-v",
    "--verbose",
    is_flag=True,
    help="Print the hypotheses, the inputs and the time of each step as well.",
)
@click.option("-q", "--quiet", is_flag=True, help="Print nothing but warnings and errors.")
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
    max_points: int,
    unit: Unit,
    unit_source: Unit | None,
    poles: int | None,
    up: bool,
    prior_rpy_deg: tuple[float, float, float] | None,
    prior_sigma_deg: float,
    hypothesis: str | None,
    refine: bool,
    trust_poles: bool,
    need_cm: float | None,
    at_m: float | None,
    strict: bool,
    seed: int,
    as_json: bool,
    verbose: bool,
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
      retropole calibrate front.pcd rear.pcd --need-cm 2 --at-m 30 --strict
      retropole calibrate front.pcd rear.pcd --up
      retropole calibrate front.pcd rear.pcd --hypothesis b
      retropole calibrate --placement f1.pcd r1.pcd --placement f2.pcd r2.pcd
      retropole calibrate drive.bag drive.bag --target-topic /front --source-topic /rear
      retropole calibrate front.pcap rear.pcap --frames 100:150
      retropole calibrate front.csv rear.csv --unit mm

    \b
    Exit code:
      0    calibrated; the verdict is ok, or warn with what is weak
      1    with --strict: the verdict is warn
      2    a file or an option is wrong; an older result in --out is renamed to older-result.json
      3    refused: the data carry no answer; the reason is printed and in result.json
      130  interrupted
    """
    from ..api.calibration import calibrate_with
    from ..report.text import describe_result
    from ..result import RunConfig, encode

    with older_set_aside(out):
        if at_m is not None and need_cm is None:
            raise click.UsageError("--at-m says how far away --need-cm must hold: give both")
        pairs = placed_pairs(target, source, placements)
    targets, sources = ([pair[lidar] for pair in pairs] for lidar in (0, 1))
    config = RunConfig(
        radius_m=radius,
        radius_sigma_m=radius_sigma,
        up=up,
        prior_rpy_deg=prior_rpy_deg,
        prior_sigma_deg=prior_sigma_deg,
        hypothesis=hypothesis,
        poles=poles,
        refine=refine,
        trust_poles=trust_poles,
        need_m=None if need_cm is None else need_cm / 100,
        at_m=at_m,
        seed=seed,
        threshold_target=threshold_target,
        threshold_source=threshold_source,
        sensor_target=sensor_target,
        sensor_source=sensor_source,
        target_topic=target_topic,
        source_topic=source_topic,
        frames=None if frames is None else (frames.start, frames.stop, frames.step),
        max_points=max_points,
        unit=unit,
        unit_source=unit_source,
    )

    def tell(given: Input) -> None:
        if not quiet:
            echo_left_out(given, frames)
            echo_sensor_doubt(given)

    with older_set_aside(out), progress_on_terminal(quiet) as progress:
        result = calibrate_with(targets, sources, config, progress=progress, on_read=tell)
        written = result.save(out)
    if as_json:
        show(encode(result.document))
    elif not quiet:
        following = {
            "next": command_line("export", out, "--to", "ros2"),
            "later, with new recordings": command_line("check", out, targets[0], sources[0]),
        }
        paths = [str(path) for path in written]
        words = describe_result(result.document, paths, following, verbose=verbose)
        show(in_colour(words, result.status))
    if result.status == "refused":
        # Who sees stdout has read it there.
        unseen = quiet or as_json
        for reason in result.reasons if unseen or not sys.stdout.isatty() else ():
            echo_refusal(reason.code, reason.message, advise=unseen)
        return EXIT_REFUSED
    if quiet or as_json:
        for reason in result.reasons:
            echo_warning(reason.code, reason.message)
    return EXIT_WARNED if strict and result.status == "warn" else 0


def placed_pairs(
    target: Path | None, source: Path | None, placements: Sequence[tuple[Path, Path]]
) -> list[tuple[Path, Path]]:
    """Take the two arguments, or those of each --placement; never both."""
    if placements and target is not None:
        raise click.UsageError("give TARGET and SOURCE, or --placement for each, not both")
    if placements:
        return list(placements)
    if target is None or source is None:
        raise click.UsageError("TARGET and SOURCE are needed, or --placement TARGET SOURCE")
    return [(target, source)]
