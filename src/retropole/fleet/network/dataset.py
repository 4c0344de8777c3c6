"""From the answers of a fleet to a network: sites that share LiDARs have nodes in common.

A list says which LiDAR of which site is which node, and where nodes were surveyed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta
from scipy.sparse.csgraph import minimum_spanning_tree

from ...api import se3
from ...base.errors import ReadError, UsageError, quoting, said
from ...base.se3 import RelativePose
from ...result.decoding import check_covariance
from ...result.site import SiteDoc
from ..dataset import AT_RANGE, Row, document_of, partitions_in, read_rows
from ..sites import ROLES
from ..storage import absolute
from ..tables import LISTS, lines_of
from .graph import ControlPoints, Edges, Graph

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
        If it cannot be read, or contradicts itself.
    MissingExtraError
        If the extra ``fleet`` is not installed.
    """
    if not place.endswith(LISTS):
        raise UsageError(f"{place}: expected a file {', '.join(LISTS)}")
    of_site: dict[str, dict[str, str]] = {}
    surveyed = []
    for number, node, line in lines_of(absolute(place), COLUMNS, "node"):
        here = f"{place}: row {number}"
        is_member, is_surveyed = bool({"site", "lidar"} & line.keys()), bool({*WORLD} & line.keys())
        if is_surveyed:
            surveyed.append(_surveyed(here, line))
        elif line.keys() & {"sigma_m", *SEEN} or not is_member:
            raise ReadError(f"{here}: expected site and lidar, or x_m, y_m, z_m and sigma_m")
        if is_member:
            if not {"site", "lidar"} <= line.keys():
                raise ReadError(f"{here}: site and lidar must be given together")
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
    """Read the control point of a row."""
    given = {key: value for key, value in line.items() if key not in ("site", "lidar")}
    try:
        point = msgspec.convert({**given, "node": str(given["node"])}, Surveyed, strict=False)
    except msgspec.ValidationError as error:
        raise ReadError(f"{here}: {quoting(said(error).replace('`$.', '`'))}") from None
    if not all(math.isfinite(each) for each in msgspec.structs.astuple(point)[1:]):
        raise ReadError(f"{here}: a number is not finite")
    return point


@dataclass(frozen=True)
class NotUsed:
    """A site, or a node without a site that was used, which is not in the network, and why."""

    kind: str
    name: str
    reason: str


@dataclass(frozen=True, eq=False)
class FleetNetwork:
    """The network of a fleet.

    Attributes
    ----------
    graph
        To adjust.
    nodes
        Names of its poses, in order.
    sites
        Of each edge, the id of the row that it was taken of.
    not_used
        Sites and nodes that are not in it.
    """

    graph: Graph
    nodes: tuple[str, ...]
    sites: tuple[str, ...]
    not_used: tuple[NotUsed, ...]


def find_network(dataset: str, nodes: NodeList) -> FleetNetwork:
    """Make a network of the answers of a fleet.

    A pair is an edge. A site is a tree of edges between those of its LiDARs that are nodes: of all
    such trees the one whose edges are the most certain.

    Parameters
    ----------
    dataset
        Path or URL of what ``retropole fleet calibrate`` has written.
    nodes
        Which LiDAR of which site is which node, and control points.

    Raises
    ------
    ReadError
        If the dataset is damaged, or there is no such site or LiDAR in it, or no edge at all.
    """
    out = absolute(dataset)
    edges: list[tuple[str, str, str, RelativePose]] = []
    not_used: list[NotUsed] = []
    missing = set(nodes.of_site)
    if not (partitions := partitions_in(out)):
        raise ReadError(f"{dataset}: no answers of 'retropole fleet calibrate'")
    for partition in partitions:
        for row in read_rows(out, partition).values():
            missing.discard(row.id)
            lidars = nodes.of_site.get(row.id, {})
            if why := _why_not(row, lidars):
                not_used.append(NotUsed("site", row.id, why))
            else:
                edges += [(row.id, *edge) for edge in _edges_of(row, lidars, nodes.place)]
    if missing:
        name = min(missing)
        raise ReadError(f"{nodes.place}: there is no site {quoting(name)!r} in {dataset}")
    if not edges:
        raise ReadError(f"{dataset}: no answer has two LiDARs that are nodes of {nodes.place}")
    edges.sort(key=lambda edge: edge[:3])
    sites, first, second, poses = zip(*edges, strict=True)
    number = {name: k for k, name in enumerate(sorted({*first, *second}))}
    named = {each for lidars in nodes.of_site.values() for each in lidars.values()}
    named |= {point.node for point in nodes.surveyed}
    lone = sorted(named - number.keys())
    not_used += [NotUsed("node", name, "no relative pose leads to it") for name in lone]
    points = [point for point in nodes.surveyed if point.node in number]
    numbers = np.array([msgspec.structs.astuple(point)[1:] for point in points], dtype=float)
    world, sigma, seen = np.split(numbers.reshape(-1, 7), [3, 4], axis=1)
    graph = Graph(
        len(number),
        Edges(
            np.array([number[name] for name in first]),
            np.array([number[name] for name in second]),
            np.array([pose.T_i_j for pose in poses]),
            np.array([pose.covariance for pose in poses]),
        ),
        points=ControlPoints(
            np.array([number[point.node] for point in points], dtype=np.int64),
            world,
            np.eye(3) * sigma[:, :, None] ** 2,
            seen,
        ),
    )
    return FleetNetwork(graph, tuple(number), sites, tuple(not_used))


def _why_not(row: Row, lidars: Mapping[str, str]) -> str:
    """State why a row gives no edge; empty if it does."""
    if not row.lidars:
        return f"{row.status}: {', '.join(row.codes)}" if row.codes else row.status
    if len(lidars) < 2:
        return f"{'one' if lidars else 'none'} of its LiDARs is a node"
    return ""


def _edges_of(
    row: Row, lidars: Mapping[str, str], place: str
) -> Iterator[tuple[str, str, RelativePose]]:
    """Give the relative poses that a row has, by the nodes that they join."""
    document = document_of(row.document or "", "site") if row.kind == "site" else None
    have = [lidar.name for lidar in document.lidars] if isinstance(document, SiteDoc) else ROLES
    unknown = sorted(set(lidars) - set(have))
    if unknown:
        raise ReadError(
            f"{place}: the site {quoting(row.id)!r} has no LiDAR {quoting(unknown[0])!r}, "
            f"expected one of {', '.join(quoting(name) for name in have)}"
        )
    if isinstance(document, SiteDoc):
        yield from _tree(document, lidars)
    else:
        yield lidars[ROLES[0]], lidars[ROLES[1]], _pair(row)


def _pair(row: Row) -> RelativePose:
    """Compute the pose of the source in the frame of the target."""
    (source,) = row.lidars
    what = f"the answer of {quoting(row.id)!r}"
    try:
        T = se3.rigid(np.array(source.T).reshape(4, 4))
        C = np.array(source.covariance).reshape(6, 6)
    except (ReadError, ValueError) as error:
        raise ReadError(f"{what}: {said(error)}") from None
    check_covariance(what, C)
    return RelativePose(T, C)


def _tree(document: SiteDoc, lidars: Mapping[str, str]) -> Iterator[tuple[str, str, RelativePose]]:
    """Choose relative poses that join some LiDARs of a site without a loop, the most certain."""
    from ...api.result import SiteResult

    site = SiteResult(document)
    some = [name for name in site.lidars if name in lidars]
    found = {
        (i, j): RelativePose(site.T(a, b), site.covariance(a, b))
        for (i, a), (j, b) in combinations(enumerate(some), 2)
    }
    # The variance of a point at the range.
    each = np.repeat([AT_RANGE**2, 1.0], 3)
    weight = np.zeros((len(some), len(some)))
    for ends, pose in found.items():
        weight[ends] = each @ np.diag(pose.covariance)
    tree = minimum_spanning_tree(weight).tocoo()
    for i, j in sorted(zip(tree.row.tolist(), tree.col.tolist(), strict=True)):
        yield lidars[some[i]], lidars[some[j]], found[i, j]
