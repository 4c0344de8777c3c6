"""The commands ``retropole fleet network`` and ``retropole fleet export``."""

from __future__ import annotations

from collections import Counter
from itertools import compress
from typing import TYPE_CHECKING

import click

from .common import EXIT_MOVED, EXIT_REFUSED, json_text, progress_on_terminal, show, show_written
from .fleet_check import protocol_option
from .options import Brief

if TYPE_CHECKING:
    from ..fleet.network.adjustment import NetworkAdjustment
    from ..fleet.network.dataset import FleetNetwork

SCHEMA = "retropole/fleet-network/1"

MOST_COMPONENTS = 10
"""How many of the largest are printed, one per line."""


nodes_option = click.option(
    "--nodes",
    metavar="TABLE",
    required=True,
    help="Which LiDAR of which site is which node, and surveyed points; .csv or .parquet.",
)


@click.command("network", cls=Brief)
@click.argument("dataset")
@nodes_option
@click.option("--out", metavar="FILE", required=True, help="Parquet file to write, or its URL.")
@protocol_option
@click.option("--json", "as_json", is_flag=True, help="Print one line of JSON, and only that.")
@click.option("-q", "--quiet", is_flag=True, help="Print nothing but errors.")
def fleet_network(dataset: str, nodes: str, out: str, as_json: bool, quiet: bool) -> int:
    """Adjust sites that share LiDARs together, without what does not fit.

    DATASET is what 'retropole fleet calibrate' wrote. TABLE has a row for each LiDAR of each site:
    node (its name in the network, the same wherever the LiDAR was), site (the id in DATASET) and
    lidar (target or source of a pair, otherwise as the site file calls it). A row with x_m, y_m,
    z_m and sigma_m says where its node was surveyed; seen_x_m, seen_y_m and seen_z_m where the node
    sees that point, if it is not the node's origin. Without survey the first node of each component
    is its frame.

    FILE has the pose and covariance of every node, the test of every relative pose and control
    point, and what was left out and why.

    \b
    Examples:
      retropole fleet network fleet --nodes nodes.csv --out network.parquet
      retropole fleet network s3://city/fleet --nodes nodes.parquet --out network.parquet --json

    \b
    A table:
      node,site,lidar,x_m,y_m,z_m,sigma_m
      mast-1,quay-1,target,12.30,4.55,6.10,0.01
      mast-2,quay-1,source,,,,
      mast-2,quay-2,target,,,,
      mast-3,quay-2,source,,,,

    \b
    Exit code:
      0    everything fits
      2    a file or an option is wrong, or nothing joins two nodes
      3    the adjustment did not converge; nothing is written
      4    a relative pose or a control point does not fit and was left out
    """
    from ..fleet.network.adjustment import adjust_network
    from ..fleet.network.answer import write_network
    from ..fleet.network.dataset import find_network, read_nodes

    with progress_on_terminal(quiet or as_json) as progress:
        progress("read")
        network = find_network(dataset, read_nodes(nodes))
        found = adjust_network(network.graph, progress)
        if found.converged:
            progress("write")
            write_network(out, network, found)
    if as_json:
        show(json_line(network, found, out))
    elif not quiet:
        show(in_words(network, found, out))
    if not found.converged:
        return EXIT_REFUSED
    return 0 if found.used.all() else EXIT_MOVED


@click.command("export", cls=Brief)
@click.argument("dataset")
@nodes_option
@click.option("--to", type=click.Choice(["g2o"]), required=True, help="Format to write.")
@click.option("--out", metavar="FILE", required=True, help="File to write, or its URL.")
@protocol_option
@click.option("-q", "--quiet", is_flag=True, help="Print nothing but errors.")
def fleet_export(dataset: str, nodes: str, to: str, out: str, quiet: bool) -> int:
    """Write the network of DATASET, not adjusted, for another program.

    g2o has a vertex for each node, where an adjustment may start, and an edge for each relative
    pose with its information; comments name the nodes. It has no control points.

    \b
    Examples:
      retropole fleet export fleet --nodes nodes.csv --to g2o --out network.g2o

    \b
    Exit code:
      0    written
      2    a file or an option is wrong, or nothing joins two nodes
    """
    from ..fleet.network.answer import write_g2o
    from ..fleet.network.dataset import find_network, read_nodes

    write_g2o(out, find_network(dataset, read_nodes(nodes)))
    if not quiet:
        show_written(out)
    return 0


def json_line(network: FleetNetwork, found: NetworkAdjustment, out: str) -> str:
    """Write what was found as one line of JSON."""
    from ..fleet.network.answer import name_of

    edges = len(network.graph.edges)
    left_out = [
        {
            "kind": "edge" if k < edges else "control point",
            "name": name_of(network, k),
            "w": float(found.w[k]),
            "rivals": [name_of(network, rival) for rival in found.rivals.get(k, ())],
        }
        for k, is_used in enumerate(found.used)
        if not is_used
    ]
    components = [
        {"poses": len(each.nodes), "datum": each.datum(network.nodes)} for each in found.components
    ]
    return json_text(
        {
            "schema": SCHEMA,
            "out": out if found.converged else None,
            "settled": found.converged,
            "poses": len(network.nodes),
            "edges": edges,
            "control_points": len(network.graph.points),
            "components": components,
            "left_out": left_out,
            "doubtful": list(compress(network.nodes, found.doubtful)),
            "not_used": network.not_used,
            "unit_variance": found.unit_variance,
        }
    )


def in_words(network: FleetNetwork, found: NetworkAdjustment, out: str) -> str:
    """Write what was found as a person reads it."""
    from ..base.errors import printable
    from ..base.quantities import counted
    from ..fleet.network.answer import reason_of

    graph = network.graph
    lines = [
        f"{counted(graph.nodes, 'pose')}, {counted(len(graph.edges), 'relative pose')}, "
        f"{counted(len(graph.points), 'control point')}; "
        f"unit variance {found.unit_variance:.2f} (1 where the covariances are right)"
    ]
    by_size = sorted(found.components, key=lambda each: -len(each.nodes))
    lines += [
        f"{counted(len(each.nodes), 'pose')}: {each.datum(network.nodes)}"
        for each in by_size[:MOST_COMPONENTS]
    ]
    if len(by_size) > MOST_COMPONENTS:
        lines.append(f"and {counted(len(by_size) - MOST_COMPONENTS, 'component')} more")
    out_of = compress(range(len(found.used)), ~found.used)
    lines += [f"left out: {reason_of(network, found, k)}" for k in out_of]
    if doubtful := int(found.doubtful.sum()):
        lines.append(
            f"{counted(doubtful, 'pose')} doubtful: determined by other observations that may be "
            "the wrong ones"
        )
    kinds = Counter((one.kind, one.reason) for one in network.not_used)
    lines += [
        f"not used: {counted(count, kind)} ({reason})"
        for (kind, reason), count in sorted(kinds.items(), key=lambda each: (-each[1], each[0]))
    ]
    end = f"written: {out}" if found.converged else "not converged: nothing is written"
    return "\n".join(printable(line) for line in [*lines, end])
