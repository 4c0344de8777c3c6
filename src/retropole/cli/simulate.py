"""The command ``retropole simulate``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from ..datatypes import MAX_POLES
from .common import CLOUD, CONTEXT, OUT, progress_on_terminal, radius_option, show
from .simulate_site import simulate_site


class _OrSite(click.Group):
    """The command for pairs, and ``simulate site`` behind the word that no scene has."""

    def make_context(
        self,
        info_name: str | None,
        args: list[str],
        parent: click.Context | None = None,
        **extra: Any,
    ) -> click.Context:
        """Read the words of either command."""
        if args[:1] == ["site"]:
            return simulate_site.make_context(f"{info_name} site", args[1:], parent, **extra)
        return super().make_context(info_name, args, parent, **extra)

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Read the words of a pair as a plain command does: a scene is no command."""
        return click.Command.parse_args(self, ctx, args)

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command whose words were read."""
        return click.Command.invoke(self if ctx.command is self else simulate_site, ctx)


@click.group(
    cls=_OrSite,
    commands={"site": simulate_site},
    invoke_without_command=True,
    subcommand_metavar="| site KIND",
    context_settings={**CONTEXT, "allow_extra_args": False, "allow_interspersed_args": True},
)
@click.argument(
    "scene",
    type=click.Choice(["corridor", "street", "harbor", "paper", "bare"]),
    required=False,
)
@click.option(
    "--into",
    type=(CLOUD, CLOUD),
    metavar="TARGET SOURCE",
    help="Instead of a scene, two recordings to put the poles into.",
)
@click.option(
    "--transform",
    type=CLOUD,
    help="With --into: T_target_source, as a result or in any format that export writes.",
)
@click.option(
    "--out",
    type=OUT,
    default=Path("retropole-simulated"),
    show_default=True,
    help="Folder for lidar0.pcd (the target), lidar1.pcd (the source) and truth.json.",
)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
@click.option("--sensor-target", help="Sensor's name.  [default: the scene's; auto]")
@click.option("--sensor-source", help="The same for the source.")
@click.option("--poles", type=click.IntRange(1, MAX_POLES), default=2, show_default=True)
@radius_option
@click.option(
    "--nuisances",
    type=click.Choice(["field", "typical", "none"]),
    help="Errors of the LiDARs and of the site: all that a real one has, noise and range errors, "
    "or none.  [default: typical; for paper the paper's noise]",
)
@click.option("-q", "--quiet", is_flag=True, help="Print nothing but errors.")
def simulate(
    scene: str | None,
    into: tuple[Path, Path] | None,
    transform: Path | None,
    out: Path,
    seed: int,
    sensor_target: str | None,
    sensor_source: str | None,
    poles: int,
    radius: float,
    nuisances: str | None,
    quiet: bool,
) -> int:
    """Make two scans of taped poles whose true transform is known.

    \b
    Examples:
      retropole simulate street --seed 1 --out s
      retropole calibrate s/lidar0.pcd s/lidar1.pcd
      retropole simulate street --nuisances field --seed 1 --out f
      retropole simulate harbor --sensor-target VLP-16 --sensor-source VLP-16 --poles 3
      retropole simulate --into front.pcd rear.pcd --transform retropole-out --out s
    """
    from ..api.simulation import insert
    from ..api.simulation import simulate as run
    from ..errors import printable
    from ..simulation import InsertedPair, SimulatedPair, write_pair

    if (scene is None) == (into is None):
        raise click.UsageError("give a SCENE, or --into with two recordings")
    if (into is None) != (transform is None):
        raise click.UsageError("--into and --transform need each other")
    pair: SimulatedPair | InsertedPair
    with progress_on_terminal(quiet) as progress:
        progress("simulate")
        if into is not None and transform is not None:
            pair = insert(
                *into,
                transform,
                seed,
                sensors=(sensor_target or "auto", sensor_source or "auto"),
                poles=poles,
                radius=radius,
            )
        else:
            assert scene is not None
            pair = run(
                scene,
                seed,
                sensor_target=sensor_target,
                sensor_source=sensor_source,
                poles=poles,
                radius=radius,
                nuisances=nuisances,
            )
        write_pair(pair, out)
    if not quiet:
        names = ", ".join(str(out / name) for name in ("lidar0.pcd", "lidar1.pcd", "truth.json"))
        show(f"written: {printable(names)}")
    return 0
