"""The command ``retropole simulate site``."""

from __future__ import annotations

from pathlib import Path

import click

from ..datatypes import MAX_POLES
from .common import CONTEXT, OUT, progress_on_terminal, radius_option, show


@click.command("site", context_settings=CONTEXT)
@click.argument("kind", type=click.Choice(["posts", "crane", "truck", "ring"]))
@click.option("--out", type=OUT, default=Path("retropole-site"), show_default=True)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
@click.option("--lidars", type=click.IntRange(2, 12), default=4, show_default=True)
@click.option(
    "--placements", type=click.IntRange(1, 8), help="Of the poles.  [default: 2; ring: one a LiDAR]"
)
@click.option(
    "--poles", type=click.IntRange(2, MAX_POLES), help="In each placement.  [default: 3; ring: 2]"
)
@click.option("--sensor", "sensors", multiple=True, help="Name; several are taken in turn.")
@radius_option
@click.option(
    "--nuisances",
    type=click.Choice(["field", "typical", "none"]),
    default="typical",
    show_default=True,
    help="Errors of the LiDARs and of the site, as for pairs.",
)
@click.option(
    "--survey", is_flag=True, help="Survey the poles of placement 1 and four control points."
)
@click.option(
    "--blunder",
    type=click.Choice(["pole", "files", "control"]),
    help="Bump a pole between two recordings, exchange two files, or put a surveyed point 0.1 m "
    "off (with --survey). truth.json says which.",
)
@click.option("-q", "--quiet", is_flag=True, help="Print nothing but errors.")
def simulate_site(
    kind: str,
    out: Path,
    seed: int,
    lidars: int,
    placements: int | None,
    poles: int | None,
    sensors: tuple[str, ...],
    radius: float,
    nuisances: str,
    survey: bool,
    blunder: str | None,
    quiet: bool,
) -> int:
    """Make the recordings of a site of several LiDARs whose true poses are known.

    KIND is where they stand: on posts at a street or a crossing, at a harbour crane, on a truck; or
    in a ring where each pair alone is ambiguous. The folder gets a recording of each LiDAR and
    placement, site.toml and truth.json.

    \b
    Examples:
      retropole simulate site posts --lidars 4 --seed 1 --out s
      retropole simulate site crane --lidars 8 --placements 4 --survey --out s
      retropole simulate site truck --lidars 5 --nuisances field --blunder pole --out s
    """
    import numpy as np

    from ..errors import printable
    from ..simulation import NOISE_MODELS
    from ..simulation import simulate_site as run
    from ..simulation.site_survey import Survey
    from ..simulation.site_writing import write_site

    with progress_on_terminal(quiet) as progress:
        progress("simulate")
        site = run(
            kind,
            np.random.default_rng(seed),
            lidars=lidars,
            placements=placements,
            poles=poles,
            sensors=sensors or None,
            radius=radius,
            noise=NOISE_MODELS[nuisances],
            survey=Survey(placements=(0,), points=4) if survey else None,
            blunder=blunder,
        )
        write_site(site, out)
    if not quiet:
        files = sum(cloud is not None for own in site.clouds for cloud in own)
        show(f"written: {printable(str(out / 'site.toml'))}, truth.json, {files} recordings")
    return 0
