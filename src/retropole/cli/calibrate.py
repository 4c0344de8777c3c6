"""The commands ``retropole calibrate`` and ``retropole site calibrate``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from ..result import REPORT_FILE, RESULT_FILE, SITE_REPORT_FILE, SITE_RESULT_FILE, RunConfig
from .common import BY_SITE_FILE, command_line, listening, report_result, say
from .level import LEVEL, write_level
from .options import (
    CLOUD,
    READING,
    SENSORS,
    TOPICS,
    Brief,
    more_option,
    placement_arguments,
    run_options,
    verdict_options,
)
from .out import out_folder


@click.command(cls=Brief)
@placement_arguments
@out_folder("Folder for result.json and report.html.", RESULT_FILE, REPORT_FILE)
@run_options("radius_m", "radius_sigma_m", *SENSORS, *TOPICS, "frames", "max_points")
@run_options(*READING)
@run_options("carried", "poles", "up", "prior_rpy_deg", "prior_sigma_deg")
@run_options("map", "map_sigma_m", "prior_xyz", "prior_sigma_m")
@run_options("hypothesis", "refine", "trust_poles", "deceiving_share", "need_m", "at_m")
@run_options("mast_sway_deg")
@more_option(
    "--plan", type=CLOUD, help="Plan of the poles, with which their positions are compared."
)
@LEVEL
@verdict_options("the hypotheses, the inputs and the time of each step")
def calibrate(
    target: Path | None,
    source: Path | None,
    placements: tuple[tuple[Path, Path], ...],
    out: Path,
    plan: Path | None,
    with_level: bool,
    strict: bool,
    as_json: bool,
    verbose: bool,
    quiet: bool,
    **options: Any,
) -> int:
    """Find the transform that maps points of SOURCE into the frame of TARGET.

    TARGET and SOURCE are point clouds with an intensity, folders with one for each sweep, ROS
    bags, or packets (.pcap). Both may be the same bag.

    \b
    Examples:
      retropole calibrate front.pcd rear.pcd
      retropole calibrate front.pcd rear.pcd --sensor VLP-16 --sensor XT32
      retropole calibrate drive.bag drive.bag --topic /front --topic /rear
      retropole calibrate --placement f1.pcd r1.pcd --placement f2.pcd r2.pcd
    \f
    \b
    More examples:
      retropole calibrate front/ rear/ --threshold auto --threshold 150 --out today
      retropole calibrate front.pcd rear.pcd --need-cm 2 --at-m 30 --strict
      retropole calibrate front.pcd rear.pcd --up --level
      retropole calibrate front.pcap rear.pcap --frames 100:150
      retropole calibrate map.laz mast.pcd --map --prior-xyz 412345 5654321 91
      retropole calibrate front.csv rear.csv --unit mm --plan retropole-plan
      retropole calibrate walk.mcap walk.mcap --topic /front --topic /rear --carried

    \b
    Exit code:
      0    calibrated: the verdict is ok or warn
      1    with --strict: the verdict is warn
      2    a file or an option is wrong; an older result in --out is renamed to older-result.json
      3    refused: no transform; the reason is printed and in result.json
    """
    from ..api.calibration import calibrate_with

    if options["carried"] and plan is not None:
        raise click.UsageError("--plan is for fixed poles, --carried for one that moves")
    # A plan that cannot be read is reported before the work.
    wanted = None
    if plan is not None:
        from ..api.plan_checking import cost_of, load_plan

        wanted = load_plan(plan, of_pair=True)
    if options["at_m"] is not None and options["need_m"] is None:
        raise click.UsageError("--at-m is the distance up to which --need-cm must hold: give both")
    targets, sources = placed(target, source, placements)
    config = RunConfig(**options)
    # Of a walk every sweep is searched, whatever the page shows.
    requested = config.frames or (config.carried or None)
    with listening(quiet, requested, units=False) as listener:
        result = calibrate_with(targets, sources, config, listener)
        written = result.save(out)
    following = {
        "next": command_line("export", out, "--to", "ros2"),
        "later, with new recordings": command_line("check", out, "TARGET", "SOURCE"),
    }
    code = report_result(
        result, written, following, as_json=as_json, verbose=verbose, quiet=quiet, strict=strict
    )
    if wanted is not None and not quiet:
        for line in cost_of(wanted, result):
            say(f"plan: {line}")
    if with_level and result.status != "refused":
        write_level(out, quiet or as_json)
    return code


def placed(
    target: Path | None, source: Path | None, placements: Sequence[tuple[Path, Path]]
) -> tuple[list[Path], list[Path]]:
    """Use the two arguments, or those of each --placement, never both: targets and sources."""
    if placements and target is not None:
        raise click.UsageError("give TARGET and SOURCE, or --placement for each, not both")
    if not placements:
        if target is None or source is None:
            raise click.UsageError("TARGET and SOURCE are needed, or --placement TARGET SOURCE")
        placements = [(target, source)]
    return [pair[0] for pair in placements], [pair[1] for pair in placements]


@click.command("calibrate", cls=Brief)
@click.argument("site_file", metavar="SITE.toml", type=CLOUD)
@out_folder("Folder for site-result.json and site-report.html.", SITE_RESULT_FILE, SITE_REPORT_FILE)
@LEVEL
@verdict_options("every pair and test, what was read and the time of each step")
def site_calibrate(
    site_file: Path,
    out: Path,
    with_level: bool,
    strict: bool,
    as_json: bool,
    verbose: bool,
    quiet: bool,
) -> int:
    """Find the poses of all LiDARs of a site in one frame.

    SITE.toml lists the LiDARs, their recordings in each placement of the poles, and surveyed
    points; 'retropole site init' writes one. SITE.toml may be its folder. With carried = true in
    it, one pole was carried through the view of all LiDARs.

    \b
    Examples:
      retropole site calibrate site.toml
      retropole site calibrate quay/site.toml --out today --strict
      retropole site calibrate site.toml --json | jq '.lidars[] | {name, T_site_lidar}'

    \b
    Exit code:
      0    calibrated: the verdict is ok or warn
      1    with --strict: the verdict is warn
      2    a file or an option is wrong; an older result in --out is renamed
      3    refused: no poses; the reason is printed and in site-result.json
    """
    from ..api.calibration import calibrate_site

    requested = "as in the site file"
    with listening(quiet, requested, BY_SITE_FILE) as listener:
        result = calibrate_site(site_file, **listener._asdict())
        listener.progress("report")
        written = result.save(out)
    field_test = {"field test of the LiDARs": command_line("certify", site_file, "--out", out)}
    following = {
        "next": command_line("export", written[0], "--to", "urdf", "--out", out / "site.urdf"),
        # A pole that was carried had no fixed place.
        **({} if result.document.config.carried else field_test),
        "later, with new recordings": command_line("site", "check", out, "SITE"),
    }
    code = report_result(
        result, written, following, as_json=as_json, verbose=verbose, quiet=quiet, strict=strict
    )
    if with_level and result.status != "refused":
        write_level(written[0], quiet or as_json)
    return code
