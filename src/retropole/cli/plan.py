"""The command ``retropole plan``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from ..result import PLAN_FILE, PLAN_PAGE, RunConfig
from ..result.options import PAIRS
from ..result.pole_plan import FEWEST_POLES, LONGEST, MOST_PLACEMENTS, MOST_POLES, SHORTEST
from .common import command_line, listening, show, show_written
from .options import CLOUD, METRES, READING, Brief, Number, Whole, more_option, run_options
from .out import out_folder

if TYPE_CHECKING:
    from ..api import Array
    from ..api.inputs import Listener
    from ..api.planning import PolePlan, Wish

COORDINATE = Number(min=-1000, max=1000)
ANGLE = Number(min=-360, max=360)
AREA: dict[str, Any] = {"type": (COORDINATE,) * 4, "multiple": True, "metavar": "X Y X Y"}


@click.command(cls=Brief)
@click.argument("target", type=CLOUD, required=False)
@click.argument("source", type=CLOUD, required=False)
@click.option(
    "--xyz", type=(COORDINATE,) * 3, metavar="X Y Z", help="SOURCE in TARGET's frame, to 1 m."
)
@click.option("--rpy-deg", type=(ANGLE,) * 3, metavar="R P Y", help="Its orientation, to 10°.")
@click.option(
    "--pose", type=CLOUD, help="Instead: a file written by export or a calibration, or a URDF."
)
@click.option(
    "--lidar",
    "lidars",
    type=(str, str, *(COORDINATE,) * 3, *(ANGLE,) * 3),
    multiple=True,
    metavar="NAME SENSOR X Y Z R P Y",
    help="Instead of recordings: a LiDAR over flat ground, z = 0; repeat it.",
)
@more_option(
    "--box",
    "boxes",
    type=(COORDINATE, COORDINATE, METRES, METRES, METRES),
    multiple=True,
    metavar="X Y LX LY LZ",
    help="With --lidar: a box on the ground, by its middle and its sides; repeat it.",
)
@click.option(
    "--poles", type=Whole(FEWEST_POLES, MOST_POLES), default=2, help="Number of poles you have."
)
@click.option(
    "--placements",
    type=Whole(1, MOST_PLACEMENTS),
    default=1,
    help="Number of placements: how often the poles are set up.",
)
@more_option(
    "--length", type=Number(min=SHORTEST, max=LONGEST), default=2.0, help="Of the poles, m."
)
@run_options("radius_m", more=True)
@run_options("need_m", "at_m")
@click.option(
    "--allow",
    "allowed",
    **AREA,
    help="Rectangle where poles may be, in the plan's frame; repeat it.",
)
@click.option("--forbid", "forbidden", **AREA, help="Rectangle where poles may not be; repeat it.")
@run_options(PAIRS["sensor"], PAIRS["topic"], "frames", "max_points", *READING, more=True)
@out_folder("Folder for the plan.", PLAN_FILE, PLAN_PAGE, default=Path("retropole-plan"))
@click.option("--json", "as_json", is_flag=True, help="Print the plan as JSON, and only that.")
@more_option("-q", "--quiet", is_flag=True, help="Print nothing but errors.")
def plan(
    target: Path | None,
    source: Path | None,
    xyz: tuple[float, float, float] | None,
    rpy_deg: tuple[float, float, float] | None,
    pose: Path | None,
    lidars: tuple[tuple[Any, ...], ...],
    boxes: tuple[tuple[float, ...], ...],
    poles: int,
    placements: int,
    length: float,
    allowed: tuple[tuple[float, float, float, float], ...],
    forbidden: tuple[tuple[float, float, float, float], ...],
    out: Path,
    as_json: bool,
    quiet: bool,
    **options: Any,
) -> int:
    """Plan where to set up the poles, before you drive out.

    TARGET and SOURCE are recordings of the site without poles, as calibrate reads them. Give the
    pose of SOURCE, to 10° and 1 m, by --xyz and --rpy-deg, or by --pose FILE; without these it is
    found from the surroundings. A site file (.toml) alone plans for all its LiDARs, by the first
    recording of each; --pose then names an older result of the site. With --lidar instead, nothing
    was recorded yet: LiDARs over flat ground.

    The folder gets plan.html, a page with a picture, the lengths to measure and a card to print,
    and plan.json, which 'calibrate --plan' and 'detect --plan' read.

    \b
    Examples:
      retropole plan front.pcd rear.pcd
      retropole plan front.pcd rear.pcd --xyz 4 0 0 --rpy-deg 0 0 180
      retropole plan front.pcd rear.pcd --pose old-result.json --poles 3 --need-cm 2
      retropole plan front.pcd rear.pcd --allow 0 -5 8 5 --length 3 --radius 0.03
      retropole plan site.toml --placements 3
      retropole plan --lidar a XT32 0 0 4 0 20 0 --lidar b XT32 9 0 4 0 20 180

    \b
    Exit code:
      0    planned
      2    a file or an option is wrong
      3    refused: no such plan; the reason is printed
    """
    from ..api.planning import Wish
    from ..report.pole_plan import describe_plan
    from ..result import encode

    config = RunConfig(**options)
    if options["at_m"] is not None and options["need_m"] is None:
        raise click.UsageError("--at-m is the distance at which --need-cm applies: give both")
    if (xyz is None) != (rpy_deg is None) or (xyz is not None and pose is not None):
        raise click.UsageError("give --xyz and --rpy-deg together, or --pose FILE, not both")
    wish = Wish(poles, placements, length, config.radius_m, config.need, allowed, forbidden)
    rough = pose if xyz is None or rpy_deg is None else transform(xyz, rpy_deg)
    with listening(quiet, config.frames, hidden=as_json) as listener:
        made = _made(target, source, rough, lidars, boxes, wish, config, listener)
        listener.progress("page")
        written = made.save(out)
    if as_json:
        show(encode(made.document))
    elif not quiet:
        show(describe_plan(made.document))
        show_written(*written)
        show(
            "when the poles are set up: "
            f"{command_line('calibrate', 'TARGET', 'SOURCE', '--plan', out)}"
        )
    return 0


def _made(
    target: Path | None,
    source: Path | None,
    pose: Array | Path | None,
    lidars: Sequence[tuple[Any, ...]],
    boxes: Sequence[tuple[float, ...]],
    wish: Wish,
    config: RunConfig,
    listener: Listener,
) -> PolePlan:
    """Plan for what was given: LiDARs that are drawn, a site, or two recordings."""
    from ..api import planning

    if boxes and not lidars:
        raise click.UsageError(
            "--box describes an object for --lidar; recordings show their objects"
        )
    if lidars:
        if target is not None or pose is not None:
            raise click.UsageError("--lidar describes the LiDARs: give no recordings and no pose")
        if len(lidars) < 2:
            raise click.UsageError("--lidar: at least two LiDARs are needed")
        drawn = [
            (name, sensor, transform(place, angles))
            for name, sensor, *numbers in lidars
            for place, angles in [(numbers[:3], numbers[3:])]
        ]
        return planning.plan_drawn(drawn, boxes, wish, listener)
    if target is None:
        raise click.UsageError("give TARGET and SOURCE, a site file, or --lidar for each LiDAR")
    if source is None:
        if target.suffix != ".toml" and not target.is_dir():
            raise click.UsageError("SOURCE is needed, unless TARGET is a site file (.toml)")
        if pose is not None and not isinstance(pose, Path):
            raise click.UsageError("for a site, --pose names an older result; --xyz is for a pair")
        return planning.plan_site(target, wish, pose, listener)
    return planning.plan_pair(target, source, wish, config, pose, listener)


def transform(xyz: Sequence[float], rpy_deg: Sequence[float]) -> Array:
    """Give the pose (4, 4) of a place, metres, and roll, pitch and yaw, degrees."""
    from ..base import se3

    return se3.from_rt(se3.rotation_from_rpy(np.radians(rpy_deg)), np.array(xyz, dtype=float))
