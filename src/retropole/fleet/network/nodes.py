"""Which LiDAR of which site is which node, and where nodes were surveyed: a list."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from ...api import se3
from ...base.errors import ReadError, UsageError, quoting
from ..lists import LISTS, lines_of
from ..sites import id_fault
from ..storage import absolute

WORLD, SEEN = ("x_m", "y_m", "z_m"), ("seen_x_m", "seen_y_m", "seen_z_m")

COLUMNS = ("node", "site", "lidar", *WORLD, "sigma_m", *SEEN)
"""Every column that a list may have."""

Coordinate = Annotated[float, Meta(ge=-se3.FARTHEST, le=se3.FARTHEST)]


class Surveyed(msgspec.Struct, frozen=True, kw_only=True):
    """A control point of a node, metres: where it was surveyed, and where the node sees it."""

    node: str
    x_m: Coordinate
    y_m: Coordinate
    z_m: Coordinate
    sigma_m: Annotated[float, Meta(gt=0.0, le=se3.FARTHEST)]
    seen_x_m: Coordinate = 0.0
    seen_y_m: Coordinate = 0.0
    seen_z_m: Coordinate = 0.0


@dataclass(frozen=True)
class NodeList:
    """A list of nodes.

    Attributes
    ----------
    place
        Where it was read.
    of_site
        For each site the nodes of its LiDARs, by their names.
    surveyed
        Control points, in the order of the list.
    """

    place: str
    of_site: Mapping[str, Mapping[str, str]]
    surveyed: tuple[Surveyed, ...]


def read_nodes(place: str) -> NodeList:
    """Read which LiDAR of which site is which node.

    Parameters
    ----------
    place
        Path or URL of a list, ``.csv`` or ``.parquet``. Each row names a node and says, by site and
        lidar, which LiDAR it is there, or, by x_m, y_m, z_m and sigma_m, where a point of it was
        surveyed, or both. The point is the origin of the node, or what seen_x_m, seen_y_m and
        seen_z_m say.

    Raises
    ------
    UsageError
        For a file of another kind.
    ReadError
        Where it cannot be read, or contradicts itself.
    MissingExtraError
        Where the extra ``fleet`` is not installed.
    """
    if not place.endswith(LISTS):
        raise UsageError(f"{place}: expected a file {', '.join(LISTS)}")
    of_site: dict[str, dict[str, str]] = {}
    surveyed = []
    for number, line in enumerate(lines_of(absolute(place), COLUMNS, "node"), 1):
        here = f"{place}: row {number}"
        node = str(line.get("node", ""))
        if fault := id_fault(node):
            raise ReadError(f"{here}, node: {fault}")
        is_member, is_surveyed = bool({"site", "lidar"} & line.keys()), bool({*WORLD} & line.keys())
        if is_surveyed:
            surveyed.append(_surveyed(here, line))
        elif line.keys() & {"sigma_m", *SEEN} or not is_member:
            raise ReadError(f"{here}: expected site and lidar, or x_m, y_m, z_m and sigma_m")
        if is_member:
            if not {"site", "lidar"} <= line.keys():
                raise ReadError(f"{here}: site and lidar need each other")
            site, lidar = str(line["site"]), str(line["lidar"])
            lidars = of_site.setdefault(site, {})
            if lidar in lidars or node in lidars.values():
                raise ReadError(
                    f"{here}: {quoting(lidar)!r} of {quoting(site)!r} as {quoting(node)!r}, but a "
                    "row above has that LiDAR or that node of this site already"
                )
            lidars[lidar] = node
    if not of_site:
        raise ReadError(f"{place}: no row with a site and a lidar")
    return NodeList(place, of_site, tuple(surveyed))


def _surveyed(here: str, line: Mapping[str, Any]) -> Surveyed:
    """Take the control point of a row."""
    given = {key: value for key, value in line.items() if key not in ("site", "lidar")}
    try:
        point = msgspec.convert({**given, "node": str(given["node"])}, Surveyed, strict=False)
    except msgspec.ValidationError as error:
        raise ReadError(f"{here}: {quoting(str(error).replace('`$.', '`'))}") from None
    if not all(math.isfinite(each) for each in msgspec.structs.astuple(point)[1:]):
        raise ReadError(f"{here}: a number is not finite")
    return point
