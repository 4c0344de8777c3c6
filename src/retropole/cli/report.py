"""The command ``retropole report``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from .common import CLOUD, CONTEXT, Input, input_documents, progress_on_terminal, read_input

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..datatypes import Array, Detection, Placement, PointCloud
    from ..result import ResultDoc

SAME_M = 1e-3
"""Poles found anew are those of the result where none lies further from it than this, metres."""


@click.command(context_settings=CONTEXT)
@click.argument("result", type=click.Path(path_type=Path))
@click.argument("clouds", type=CLOUD, nargs=-1, metavar="[TARGET SOURCE]...")
@click.option(
    "--out",
    type=click.Path(path_type=Path, dir_okay=False),
    help="File to write.  [default: report.html beside RESULT]",
)
@click.option("-q", "--quiet", is_flag=True, help="Print nothing but errors.")
def report(result: Path, clouds: tuple[Path, ...], out: Path | None, quiet: bool) -> int:
    """Make the report of RESULT, a result.json, anew.

    The page shows the clouds that the result names. They are looked for by their path, from here
    and from the folder of RESULT; give TARGET and SOURCE where they lie elsewhere now (and again
    for each further placement). Files that differ from those of the run are drawn, and both the
    page and this command say that they differ.

    \b
    Examples:
      retropole report retropole-out/result.json
      retropole report today/result.json front.pcd rear.pcd
      retropole report today/result.json --out share/monday.html

    \b
    Exit code:
      0    written
      2    RESULT or a cloud cannot be read
      130  interrupted
    """
    import msgspec

    from ..report import write_report

    document = _read_result(result)
    paths = _find_inputs(document, clouds, result)
    with progress_on_terminal(quiet) as progress:
        progress("read")
        inputs = _read_inputs(document, paths)
        notes = _differing(inputs, document)
        progress("extract")
        placements = [
            _placement(document, inputs[k : k + 2], k == 0) for k in range(0, len(inputs), 2)
        ]
        progress("write")
        page = out or result.with_name("report.html")
        first = placements[0]
        write_report(
            page,
            msgspec.to_builtins(document),
            first.target,
            first.source,
            first.found,
            more=placements[1:],
            notes=notes,
        )
    for note in notes:
        click.echo(f"retropole: {note}", err=True)
    if not quiet:
        click.echo(f"written: {page}")
    return 0


def _read_result(path: Path) -> ResultDoc:
    import msgspec

    from ..errors import ReadError
    from ..result import decode

    try:
        document = decode(path.read_bytes())
    except OSError as error:
        raise ReadError(f"{path}: cannot be read ({error.strerror or error})") from None
    except msgspec.MsgspecError as error:
        raise ReadError(f"{path}: no result of 'retropole calibrate' ({error})") from None
    if not document.inputs or len(document.inputs) % 2:
        raise ReadError(
            f"{path}: names {len(document.inputs)} inputs, expected a target and a source for "
            "each placement"
        )
    return document


def _find_inputs(document: ResultDoc, given: tuple[Path, ...], result: Path) -> list[Path]:
    """Take the clouds given, or look for those of the result, from here and beside it."""
    from ..errors import ReadError

    needed = len(document.inputs)
    if given and len(given) != needed:
        raise click.UsageError(
            f"{len(given)} clouds are given, the result has {needed}: TARGET and SOURCE of each "
            "placement, or none to look for them"
        )
    if given:
        return list(given)
    found = []
    for item in document.inputs:
        path = Path(item.path)
        places = list(dict.fromkeys([path, result.parent / path, result.parent / path.name]))
        here = next((place for place in places if place.exists()), None)
        if here is None:
            looked = ", ".join(str(place) for place in places)
            raise ReadError(f"{item.path}: not found (looked for {looked}); give TARGET and SOURCE")
        found.append(here)
    return found


def _read_inputs(document: ResultDoc, paths: list[Path]) -> list[Input]:
    """Read the clouds, of bags the topics and frames that the run read."""
    config = document.config
    frames = config.get("frames")
    topics = (config.get("target_topic"), config.get("source_topic"))
    return [
        read_input(
            path,
            item.sensor,
            item.threshold,
            topic=topics[k % 2],
            frames=None if frames is None else slice(*frames),
            quiet=True,
        )
        for k, (path, item) in enumerate(zip(paths, document.inputs, strict=True))
    ]


def _differing(inputs: list[Input], document: ResultDoc) -> list[str]:
    """Say which files are not those that the run read."""
    return [
        f"{now.path} is not the file that the run read ({then.path}): its SHA-256 begins "
        f"{now.sha256[:12]}, that of the run {then.sha256[:12]}; the picture may not be "
        "that of the figures"
        for now, then in zip(input_documents(inputs), document.inputs, strict=True)
        if now.sha256 != then.sha256
    ]


def _placement(document: ResultDoc, inputs: list[Input], is_first: bool) -> Placement:
    """Find the poles of one placement as the run did; other poles than its own are left out."""
    from ..datatypes import Placement
    from ..scene.static import remove_dynamic_points

    clouds = [remove_dynamic_points(given.cloud) for given in inputs]
    placement = Placement(clouds[0], clouds[1])
    expected = (document.poles.target, document.poles.source)
    for side, (cloud, given) in enumerate(zip(clouds, inputs, strict=True)):
        detection = _detection(cloud, given, document.config.get("radius_m"))
        if detection is None:
            continue
        points = [pole.point for pole in detection.poles]
        listed = [pole.point_m for pole in expected[side]]
        if not is_first or _same(points, listed):
            placement = placement.with_detection(side, detection)
    return placement


def _detection(cloud: PointCloud, given: Input, radius: object) -> Detection | None:
    """Find poles with the threshold and the sensor of the run; None where that is refused."""
    from ..errors import Refusal
    from ..extraction.poles import extract_poles

    size = {"radius": float(radius)} if isinstance(radius, int | float) else {}
    threshold = given.threshold
    try:
        return extract_poles(cloud, sensor=given.sensor, threshold=threshold, **size)
    except Refusal:
        return None


def _same(points: Sequence[Array], listed: Sequence[Sequence[float]]) -> bool:
    """Whether the poles found are those of the result, in its order."""
    import numpy as np

    return len(points) == len(listed) and all(
        float(np.linalg.norm(a - np.asarray(b))) < SAME_M
        for a, b in zip(points, listed, strict=True)
    )
