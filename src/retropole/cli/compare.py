"""The command ``retropole compare``."""

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
from .evaluate import scores, true_errors
from .options import CLOUD, SEED, SENSORS, TOPICS, run_options

if TYPE_CHECKING:
    from ..api.evaluation import Compared
    from ..base.datatypes import Array

COMPARE_SCHEMA = "retropole/compare/1"


TITLES = OURS | {
    name: rival.title + (f"; needs the extra {rival.extra.name!r}" if rival.extra else "")
    for name, rival in RIVALS.items()
}
"""Every method, and the extra that it needs."""


@click.command()
@click.argument("target", type=CLOUD)
@click.argument("source", type=CLOUD)
@click.option(
    "--truth",
    type=CLOUD,
    help="Known transform: truth.json of 'retropole simulate', a result.json, or as export writes.",
)
@click.option(
    "--methods",
    metavar="NAMES",
    help=f"Names between commas: {', '.join(ALL_METHODS)}.  [default: all]",
)
@run_options("radius_m", *SENSORS, *TOPICS, "frames", "unit", "unit_source")
@click.option(
    "--seed",
    type=SEED,
    default=0,
    help="Seed of what methods draw, and of the points that they are scored on.",
)
@click.option("--json", "as_json", is_flag=True, help="Print the findings as JSON, and only that.")
@click.option("-q", "--quiet", is_flag=True, help="Show no progress.")
def compare(
    target: Path,
    source: Path,
    truth: Path | None,
    methods: str | None,
    seed: int,
    as_json: bool,
    quiet: bool,
    **options: Any,
) -> int:
    """Compare retropole with other methods on one pair of clouds.

    \b
    Methods:
      METHODS

    The others use the surroundings and no poles. Their ok is not checked: only the errors
    against a truth tell whether they are right.

    \b
    Examples:
      retropole compare front.pcd rear.pcd
      retropole simulate corridor --seed 4 --out s
      retropole compare s/lidar0.pcd s/lidar1.pcd --truth s/truth.json
      retropole compare front.pcd rear.pcd --methods poles+scene,kiss
      retropole compare drive.bag drive.bag --target-topic /front --source-topic /rear
      retropole compare front.pcd rear.pcd --json | jq '.methods[].rqe_sum'

    \b
    Exit code:
      0    at least one method answered
      2    a file or an option is wrong, or no method that was asked for is installed
      3    all refused
      130  interrupted
    """
    from ..api.evaluation import compare as run
    from ..api.transforms import read_transform

    names = list(ALL_METHODS) if methods is None else [name.strip() for name in methods.split(",")]
    for name in names:
        if name not in ALL_METHODS:
            raise click.UsageError(
                f"no method is called {name!r}; there are {', '.join(ALL_METHODS)}"
            )
    config = RunConfig(**options)
    T_true = None if truth is None else read_transform(truth).T_parent_child
    with listening(quiet, config.frames) as listener, _libraries_print_to_stderr():
        found = run(target, source, config, names, T_true, listener, seed=seed)
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
    for each in found:
        if each.status == "refused" and as_json:
            say(f"retropole: {each.method}: refused ({each.codes[0]}): {each.message}")
        elif each.status == "missing":
            say(f"retropole: {each.method}: not installed: {each.message}")
    if any(each.T_target_source is not None for each in found):
        return 0
    return EXIT_USAGE if all(each.status == "missing" for each in found) else EXIT_REFUSED


fill_in(compare, "METHODS", TITLES, width=max(map(len, ALL_METHODS)))


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
    from ..report.layout import table, wrapped

    verdicts, poses, errors = [], [], []
    for each in found:
        verdict = "not installed" if each.status == "missing" else each.status
        seconds = "" if each.seconds is None else f"{each.seconds:.2f}"
        scores = [""] * 4
        if each.T_target_source is not None and each.alignment is not None:
            scene = each.alignment.confirmation
            scores = [f"{each.alignment.overlap:.3f}", f"{each.alignment.entropy.sum:.4f}"]
            scores += [f"{scene.agreeing}", f"{scene.contradicting}"]
            pose = (*each.T_target_source[:3, 3], *_angles_deg(each.T_target_source))
            poses.append([each.method, *(f"{value:.3f}" for value in pose)])
        verdicts.append([each.method, verdict, *scores, seconds])
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
    said: dict[str, list[str]] = {}
    for each in found:
        if each.status in ("warn", "refused"):
            words = f"{each.status} ({', '.join(each.codes)}): {each.message}"
            said.setdefault(words, []).append(each.method)
    for words, names in said.items():
        parts += ["", *wrapped(f"{' and '.join(names)}: {words}", "  ")]
    return "\n".join(parts)
