"""The commands ``retropole simulate`` and ``retropole simulate site``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from ..base.datatypes import MAX_POLES
from ..result.options import PAIRS
from .common import progress_on_terminal, show_written
from .options import SEED, Brief, Whole, run_option, run_options
from .out import out_folder

SWEEPS = click.option(
    "--sweeps",
    "frames",
    type=Whole(1, 200),
    default=1,
    help="Sweeps of each LiDAR, 0.1 s each; a recording of several sweeps is a folder.",
)
"""How long each LiDAR records."""


@click.command("site", cls=Brief)
@click.argument("kind", type=click.Choice(["posts", "crane", "truck", "ring"]))
@out_folder("Folder for the recordings, site.toml and truth.json.", default=Path("retropole-site"))
@click.option("--seed", type=SEED, default=0, help="Seed of all random numbers.")
@click.option("--lidars", type=Whole(2, 12), default=4, help="Number of LiDARs.")
@click.option(
    "--placements", type=Whole(1, 8), help="Of the poles.  [default: 2; ring: one a LiDAR]"
)
@click.option(
    "--poles",
    type=Whole(2, MAX_POLES),
    help="Number of poles in each placement.  [default: 3; ring: 2]",
)
@click.option("--sensor", "sensors", multiple=True, help="Sensor; several are used in turn.")
@run_options("radius_m")
@SWEEPS
@click.option(
    "--nuisances",
    type=click.Choice(["field", "typical", "none"]),
    default="typical",
    help="Errors of the LiDARs and of the site, as for pairs.",
)
@click.option(
    "--survey", is_flag=True, help="Survey the poles of placement 1 and four control points."
)
@click.option("-q", "--quiet", is_flag=True, help="Print nothing but errors.")
def simulate_site(kind: str, out: Path, radius_m: float, quiet: bool, **scene: Any) -> int:
    """Make the recordings of a site of several LiDARs whose true poses are known.

    KIND is where they are: on posts at a street or a crossing, at a harbour crane, on a truck; or
    in a ring where each pair alone is ambiguous. The folder gets a recording of each LiDAR and
    placement, site.toml and truth.json.

    \b
    Examples:
      retropole simulate site posts --lidars 4 --seed 1 --out s
      retropole simulate site crane --lidars 8 --placements 4 --survey --out s
    """
    from ..api.simulation import simulate_site as run
    from ..api.simulation import write_site

    with progress_on_terminal(quiet) as progress:
        progress("simulate")
        site = run(kind, radius=radius_m, **scene)
        write_site(site, out)
    if not quiet:
        files = sum(cloud is not None for own in site.clouds for cloud in own)
        show_written(out / "site.toml", "truth.json", f"{files} recordings")
    return 0


class _OrSite(Brief, click.Group):
    """The command for pairs, and ``simulate site`` behind the word that no scene has."""

    def make_context(
        self, info_name: str | None, args: list[str], *rest: Any, **extra: Any
    ) -> click.Context:
        """Read the arguments of either command."""
        if args[:1] == ["site"]:
            return simulate_site.make_context(f"{info_name} site", args[1:], *rest, **extra)
        return super().make_context(info_name, args, *rest, **extra)

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Read the arguments of a pair as a plain command does: a scene is not a command."""
        return click.Command.parse_args(self, ctx, args)


@click.group(
    cls=_OrSite,
    commands={"site": simulate_site},
    invoke_without_command=True,
    subcommand_metavar="| site KIND",
    context_settings={"allow_extra_args": False, "allow_interspersed_args": True},
)
@click.argument(
    "scene",
    type=click.Choice(
        ["corridor", "street", "harbor", "bare", "square", "camber", "kerb", "paper"]
    ),
)
@out_folder(
    "Folder for lidar0.pcd (the target), lidar1.pcd (the source) and truth.json.",
    default=Path("retropole-simulated"),
)
@click.option("--seed", type=SEED, default=0, help="Seed of all random numbers.")
@run_option(PAIRS["sensor"], help="Name of the sensor.  [default: the scene's]")
@click.option(
    "--poles",
    type=Whole(0, MAX_POLES),
    help="Number of poles in view of both; 0: the same place as with 2, without the poles.  "
    "[default: 2]",
)
@run_options("radius_m")
@click.option(
    "--carried", is_flag=True, help="A person carries one pole, and both LiDARs record the walk."
)
@click.option(
    "--lidars",
    type=Whole(2, 12),
    help="Number of LiDARs with --carried; further ones are of the second's model, and all are "
    "in site.toml.  [default: 2]",
)
@click.option(
    "--sweeps",
    "frames",
    type=Whole(1, 1200),
    help="Sweeps of each LiDAR, 0.1 s each, up to 200 for fixed poles; a recording of several "
    "sweeps is a folder.  [default: 1, of a walk 400]",
)
@click.option(
    "--nuisances",
    type=click.Choice(["field", "typical", "none"]),
    help="Errors of the LiDARs and of the site: all those of real ones, noise and range errors, "
    "or none.  [default: typical; for paper the paper's noise]",
)
@click.option("-q", "--quiet", is_flag=True, help="Print nothing but errors.")
def simulate(
    scene: str,
    out: Path,
    seed: int,
    radius_m: float,
    poles: int | None,
    carried: bool,
    frames: int | None,
    lidars: int | None,
    quiet: bool,
    **drawn: Any,
) -> int:
    """Make two scans of taped poles whose true transform is known.

    \b
    Examples:
      retropole simulate street --seed 1 --out s
      retropole calibrate s/lidar0.pcd s/lidar1.pcd
      retropole simulate harbor --sensor VLP-16 --poles 3
      retropole simulate street --sensor OS1 --sensor Mid-360 --sweeps 20 --seed 1 --out m
      retropole calibrate m/lidar0 m/lidar1
      retropole simulate street --seed 1 --poles 0 --out bare
      retropole plan bare/lidar0.pcd bare/lidar1.pcd
      retropole simulate street --carried --seed 1 --out w
      retropole calibrate w/lidar0 w/lidar1 --carried
      retropole simulate street --carried --lidars 3 --seed 1 --out w3
      retropole site calibrate w3/site.toml
    """
    most = 1200 if carried else 200
    if (frames or 1) > most:
        raise click.UsageError(f"--sweeps is {frames}, {most} at most without --carried")
    if carried and poles is not None:
        raise click.UsageError("--carried is for one pole, without --poles")
    if lidars is not None and not carried:
        raise click.UsageError("--lidars needs --carried; use 'simulate site' for fixed poles")
    from ..api.simulation import simulate as run
    from ..api.simulation import simulate_walk as run_walk
    from ..api.simulation import write_pair, write_walk

    with progress_on_terminal(quiet) as progress:
        progress("simulate")
        if carried:
            drawn |= {"frames": frames or 400, "lidars": lidars or 2}
            walk = run_walk(scene, seed, radius=radius_m, **drawn)
            recordings = write_walk(walk, out, seed)
        else:
            drawn |= {"poles": 2 if poles is None else poles, "frames": frames or 1}
            recordings = write_pair(run(scene, seed, radius=radius_m, **drawn), out)
    if not quiet:
        site = ["site.toml"] if len(recordings) > 2 else []
        show_written(*(out / name for name in (*recordings, "truth.json", *site)))
    return 0
