"""The command ``retropole evaluate``."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from ..api.choices import ALL_METHODS, OURS, RIVALS
from ..base.files import path_in_text
from ..result import RunConfig
from .common import EXIT_REFUSED, EXIT_USAGE, fill_in, json_text, listening, say, show
from .options import CLOUD, METRES, READING, SEED, SENSORS, TOPICS, Brief, more_option, run_options

if TYPE_CHECKING:
    from ..api.evaluation import Alignment, Compared, Errors
    from ..base.datatypes import Array

TRANSFORM = click.Path(path_type=Path)

COMPARE_SCHEMA = "retropole/compare/1"

TITLES = OURS | {
    name: rival.title + (f"; needs the extra {rival.extra!r}" if rival.extra else "")
    for name, rival in RIVALS.items()
}
"""Every method, and the extra that it needs."""


def _names(context: click.Context, option: click.Parameter, value: str | None) -> list[str]:
    """Parse the names of methods between commas."""
    names = [] if value is None else [name.strip() for name in value.split(",")]
    for name in names:
        if name not in ALL_METHODS:
            raise click.BadParameter(
                f"no method is named {name!r}; there are {', '.join(ALL_METHODS)}"
            )
    return names


@click.command(cls=Brief)
@click.argument("target", type=CLOUD)
@click.argument("source", type=CLOUD)
@click.option(
    "--transform",
    type=TRANSFORM,
    help="The transform to score: result.json or its folder, or any format of `retropole export`.",
)
@click.option(
    "--methods",
    metavar="NAMES",
    callback=_names,
    help="Instead of --transform: methods to run on both clouds, names between commas: "
    f"{', '.join(ALL_METHODS)}.",
)
@click.option(
    "--truth",
    type=TRANSFORM,
    help="The true transform, in any of these formats, to compute the error.",
)
@more_option("--parent", help="If --transform is of a site: the name of the LiDAR of TARGET.")
@more_option("--child", help="The same for SOURCE.")
@more_option("--sigma", type=METRES, default=0.05, help="Kernel width of the entropy, m.")
@run_options("radius_m", *SENSORS, *TOPICS, "frames", *READING)
@more_option(
    "--seed",
    type=SEED,
    default=0,
    help="Seed of random draws by methods, and of the points scored.",
)
@click.option("--json", "as_json", is_flag=True, help="Print the figures as JSON, and only that.")
@click.option("-q", "--quiet", is_flag=True, help="Show no progress.")
def evaluate(
    target: Path,
    source: Path,
    transform: Path | None,
    methods: list[str],
    truth: Path | None,
    parent: str | None,
    child: str | None,
    sigma: float,
    seed: int,
    as_json: bool,
    quiet: bool,
    **options: Any,
) -> int:
    """Score a transform from SOURCE to TARGET by the clouds it aligns, or compare methods.

    With --transform, whatever tool found it. No truth is needed. Overlap is the share of points
    with a neighbour in the other cloud within 0.5 m. The plane residual is the median distance from
    the other cloud's surfaces. The entropy is Renyi's quadratic entropy of both clouds together,
    downsampled to 0.1 m: the sharper they are, the larger is its sum and the smaller its -log.
    Sharp is not always right: a corridor rotated by 180 deg lies on itself. In the scene check,
    patches (cubes of 1 m) agree with the transform, or contradict it: they are where the other
    LiDAR looked through. Compare transforms of the same two clouds only; figures of other clouds
    are on another scale.

    With --methods, each is run on both clouds, and its answer scored the same way:

    \b
      METHODS

    The methods of others use the surroundings and no poles. Their ok is not checked:
    only the errors against a truth show whether they are right. --radius and the options of
    sensors are for retropole.

    \b
    Examples:
      retropole evaluate front.pcd rear.pcd --transform retropole-out
      retropole evaluate front.pcd rear.pcd --transform theirs.txt --json
      retropole evaluate s/lidar0.pcd s/lidar1.pcd --transform r --truth s/truth.json
      retropole evaluate front.pcd rear.pcd --methods poles+scene,gicp,kiss

    \b
    Exit code:
      0    scored; of methods, at least one answered
      2    a file or an option is wrong, or no method that was named is installed
      3    a cloud is too small to score by, the transform is a refused result, or all methods
           refused
    """
    if (transform is None) == (not methods):
        raise click.UsageError("give either --transform or --methods")
    if methods and not (parent is None and child is None):
        raise click.UsageError(
            "--parent and --child select a transform of a site; give --transform too"
        )
    from ..api.evaluation import compare, errors_of
    from ..api.evaluation import evaluate as score
    from ..api.transforms import read_transform

    config = RunConfig(**options)
    T_true = None if truth is None else read_transform(truth).T_parent_child
    if transform is None:
        with listening(quiet, config.frames) as listener, _libraries_print_to_stderr():
            found = compare(
                target, source, config, methods, T_true, listener, sigma=sigma, seed=seed
            )
        if as_json:
            document = {
                "schema": COMPARE_SCHEMA,
                "inputs": [path_in_text(target), path_in_text(source)],
                "truth": None if truth is None else path_in_text(truth),
                "seed": seed,
                "methods": [_document(each) for each in found],
            }
            show(json_text(document, indent=1))
        else:
            show(in_words(found, target, source))
        return _exit_code(found, as_json=as_json)
    T = read_transform(transform, parent=parent, child=child).T_parent_child
    with listening(quiet, config.frames, hidden=as_json) as listener:
        given = transform if parent is None and child is None else T
        how = {"sigma": sigma, "seed": seed, "options": config, **listener._asdict()}
        aligned = score(target, source, given, **how)
    errors = None if T_true is None else errors_of(T, T_true)
    if as_json:
        figures = {
            **scores(aligned),
            "rqe_relative_error": aligned.entropy.error,
            "rqe_points": aligned.entropy.points,
            "rqe_sigma_m": sigma,
            "confirmation": aligned.confirmation,
        }
        show(json_text(figures if errors is None else figures | true_errors(errors)))
        return 0
    residual = aligned.plane_residual
    lines = [
        f"overlap         {100 * aligned.overlap:.1f} %",
        "plane residual  "
        + ("nothing overlaps" if residual is None else f"{100 * residual:.2f} cm"),
        f"entropy         sum {aligned.entropy.sum:.5g} 1/m3, -log {aligned.entropy.log:.4f} "
        f"({aligned.entropy.points:,} points, kernel {sigma:g} m)",
        f"scene           {aligned.confirmation.text}",
    ]
    if errors is not None:
        lines.append(
            f"error           e_rt {100 * errors.e_rt:.2f} cm, "
            f"{np.degrees(errors.rotation):.3f} deg, {100 * errors.translation:.2f} cm"
        )
    show("\n".join(lines))
    return 0


fill_in(evaluate, "METHODS", TITLES, width=max(map(len, ALL_METHODS)))


def _exit_code(found: Sequence[Compared], *, as_json: bool) -> int:
    """Print on stderr which methods did not run, or refused, and give the exit code."""
    for each in found:
        if each.status == "refused" and as_json:
            say(f"retropole: {each.method}: refused ({each.codes[0]}): {each.message}")
        elif each.status == "missing":
            say(f"retropole: {each.method}: not installed: {each.message}")
    if any(each.T_target_source is not None for each in found):
        return 0
    return EXIT_USAGE if all(each.status == "missing" for each in found) else EXIT_REFUSED


def scores(aligned: Alignment | None) -> dict[str, Any]:
    """Name how clouds lie together under a transform; null if there is none."""
    return {
        "overlap": aligned and aligned.overlap,
        "plane_residual_m": aligned and aligned.plane_residual,
        "rqe_sum": aligned and aligned.entropy.sum,
        "rqe_log": aligned and aligned.entropy.log,
    }


def true_errors(errors: Errors | None) -> dict[str, Any]:
    """Name how far a transform is from the truth; null if either is not there."""
    return {
        "e_rt_m": errors and errors.e_rt,
        "rotation_error_rad": errors and errors.rotation,
        "translation_error_m": errors and errors.translation,
    }


@contextmanager
def _libraries_print_to_stderr() -> Iterator[None]:
    """Send what compiled libraries print to stderr: stdout is for the findings alone."""
    sys.stdout.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)


def _angles_deg(T: Array) -> list[float]:
    """Roll, pitch and yaw of a pose (4, 4), degrees; see `se3.rpy_from_rotation`."""
    from ..base.se3 import rpy_from_rotation

    return [float(angle) for angle in np.degrees(rpy_from_rotation(T[:3, :3]))]


def _document(each: Compared) -> dict[str, Any]:
    T, alignment = each.T_target_source, each.alignment
    return {
        "method": each.method,
        "status": each.status,
        "codes": each.codes,
        "message": each.message,
        "T_target_source": T,
        "rpy_deg": None if T is None else _angles_deg(T),
        **scores(alignment),
        "confirmation": alignment and alignment.confirmation,
        "seconds": each.seconds,
        **true_errors(each.errors),
    }


def in_words(found: Sequence[Compared], target: Path, source: Path) -> str:
    """Write the findings as tables no wider than a screen, and why a method does not answer."""
    from ..base.errors import printable
    from ..report.text import table, wrapped

    verdicts, poses, errors = [], [], []
    for each in found:
        verdict = "not installed" if each.status == "missing" else each.status
        seconds = "" if each.seconds is None else f"{each.seconds:.2f}"
        figures = [""] * 4
        if each.T_target_source is not None and each.alignment is not None:
            scene = each.alignment.confirmation
            figures = [f"{each.alignment.overlap:.3f}", f"{each.alignment.entropy.sum:.4f}"]
            figures += [f"{scene.agreeing}", f"{scene.contradicting}"]
            pose = (*each.T_target_source[:3, 3], *_angles_deg(each.T_target_source))
            poses.append([each.method, *(f"{value:.3f}" for value in pose)])
        verdicts.append([each.method, verdict, *figures, seconds])
        if each.errors is not None:
            off = f"{np.degrees(each.errors.rotation):.3f}", f"{each.errors.translation:.4f}"
            errors.append([each.method, f"{each.errors.e_rt:.4f}", *off])
    header = ("method", "verdict", "overlap", "RQE 1/m³", "agree", "conflict", "time s")
    parts = [table(header, verdicts)]
    if errors:
        parts += ["", "Error against the truth"]
        parts.append(table(("method", "e_rt m", "rotation °", "translation m"), errors))
    if poses:
        maps = f"T_target_source maps points of {source} into the frame of {target}"
        parts += ["", *wrapped(printable(maps), "  ")]
        parts.append(table(("method", "x m", "y m", "z m", "roll °", "pitch °", "yaw °"), poses))
    by_reason: dict[str, list[str]] = {}
    for each in found:
        if each.status in ("warn", "refused"):
            reason = f"{each.status} ({', '.join(each.codes)}): {each.message}"
            by_reason.setdefault(reason, []).append(each.method)
    for reason, names in by_reason.items():
        parts += ["", *wrapped(f"{' and '.join(names)}: {reason}", "  ")]
    return "\n".join(parts)
