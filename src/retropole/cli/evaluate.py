"""The command ``retropole evaluate``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .common import json_text, listening, show
from .options import CLOUD, METRES, TOPICS, run_options

if TYPE_CHECKING:
    from ..api.evaluation import Alignment, Errors

TRANSFORM = click.Path(path_type=Path)


@click.command()
@click.argument("target", type=CLOUD)
@click.argument("source", type=CLOUD)
@click.option(
    "--transform",
    type=TRANSFORM,
    required=True,
    help="The transform to score: result.json or its folder, or any format of `retropole export`.",
)
@click.option(
    "--truth", type=TRANSFORM, help="The true transform, in any of these: its error is given too."
)
@click.option("--parent", help="Where --transform is of a site: the name of the LiDAR of TARGET.")
@click.option("--child", help="The same of SOURCE.")
@click.option("--sigma", type=METRES, default=0.05, help="Kernel width of the entropy, m.")
@run_options(*TOPICS, "frames", "unit", "unit_source")
@click.option("--json", "as_json", is_flag=True, help="Print the figures as JSON, and only that.")
def evaluate(
    target: Path,
    source: Path,
    transform: Path,
    truth: Path | None,
    parent: str | None,
    child: str | None,
    sigma: float,
    as_json: bool,
    **options: Any,
) -> int:
    """Score a transform from SOURCE to TARGET, whatever tool found it, by the clouds it aligns.

    No truth is needed. Overlap is the share of points with a neighbour in the other cloud within
    0.5 m. The plane residual is the median distance from the other cloud's surfaces. The entropy is
    Renyi's quadratic entropy of both clouds together, downsampled to 0.1 m: the sharper they are,
    the larger is its sum and the smaller its -log. Sharp is not always right: a corridor rotated by
    180 deg lies on itself. In the scene check, patches (cubes of 1 m) agree with the
    transform, or contradict it: they stand where the other LiDAR looked through. Compare
    transforms of the same two clouds only; figures of other clouds are on another scale.

    \b
    Examples:
      retropole evaluate front.pcd rear.pcd --transform retropole-out
      retropole evaluate front.pcd rear.pcd --transform theirs.txt --json
      retropole evaluate s/lidar0.pcd s/lidar1.pcd --transform r --truth s/truth.json

    \b
    Exit code:
      0    scored
      2    a file or an option is wrong
      3    a cloud is too small to score by, or the transform is a refused result
    """
    import numpy as np

    from ..api.evaluation import errors_of
    from ..api.evaluation import evaluate as score
    from ..api.transforms import read_transform

    T = read_transform(transform, parent=parent, child=child).T_parent_child
    T_true = None if truth is None else read_transform(truth).T_parent_child
    with listening(False, options["frames"], hidden=as_json) as listener:
        given = transform if parent is None and child is None else T
        aligned = score(target, source, given, sigma=sigma, **listener._asdict(), **options)
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
        f"scene           {aligned.confirmation.words}",
    ]
    if errors is not None:
        lines.append(
            f"error           e_rt {100 * errors.e_rt:.2f} cm, "
            f"{np.degrees(errors.rotation):.3f} deg, {100 * errors.translation:.2f} cm"
        )
    show("\n".join(lines))
    return 0


def scores(aligned: Alignment | None) -> dict[str, Any]:
    """Name how clouds lie together under a transform; null where there is none."""
    return {
        "overlap": aligned and aligned.overlap,
        "plane_residual_m": aligned and aligned.plane_residual,
        "rqe_sum": aligned and aligned.entropy.sum,
        "rqe_log": aligned and aligned.entropy.log,
    }


def true_errors(errors: Errors | None) -> dict[str, Any]:
    """Name how far a transform is from the truth; null where either is not there."""
    return {
        "e_rt_m": errors and errors.e_rt,
        "rotation_error_rad": errors and errors.rotation,
        "translation_error_m": errors and errors.translation,
    }
