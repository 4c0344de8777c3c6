"""The command ``retropole simulate``."""

from __future__ import annotations

from pathlib import Path

import click

from .common import CONTEXT, OUT, progress_on_terminal, radius_option


@click.command(context_settings=CONTEXT)
@click.argument("scene", type=click.Choice(["corridor", "street", "harbor", "paper", "bare"]))
@click.option(
    "--out",
    type=OUT,
    default=Path("retropole-simulated"),
    show_default=True,
    help="Folder for lidar0.pcd (the target), lidar1.pcd (the source) and truth.json.",
)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
@click.option("--sensor-target", help="Sensor's name.  [default: the scene's]")
@click.option("--sensor-source", help="The same for the source.")
@click.option("--poles", type=click.IntRange(min=1), default=2, show_default=True)
@radius_option
@click.option(
    "--nuisances",
    type=click.Choice(["field", "typical", "none"]),
    help="Errors of the LiDARs and of the site: all that a real one has, noise and range errors, "
    "or none.  [default: typical; for paper the paper's noise]",
)
@click.option("-q", "--quiet", is_flag=True, help="Print nothing but errors.")
def simulate(
    scene: str,
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
    """
    from ..api.simulation import simulate as run
    from ..simulation import write_pair

    with progress_on_terminal(quiet) as progress:
        progress("simulate")
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
        click.echo(f"written: {names}")
    return 0
