"""A network adjusted, as one Parquet file, schema ``retropole/network/1``.

A row for each pose, each relative pose, each control point, and each site or node that is not in
the network; its `kind` says which.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from typing import Any

from ...api import Array
from ..storage import absolute, write_bytes
from ..tables import arrow, parquet_of
from .dataset import FleetNetwork
from .network import Kind, LeftOut, NetworkAdjustment

NETWORK_SCHEMA = "retropole/network/1"


def write_network(place: str, of: FleetNetwork, found: NetworkAdjustment) -> None:
    """Write a network whole or not at all.

    Parameters
    ----------
    place
        Path or URL of the file.
    of
        The network.
    found
        Its adjustment.

    Raises
    ------
    MissingExtraError
        Where the extra ``fleet`` is not installed.
    OSError
        Where it cannot be written.
    """
    pa = arrow()
    text, real, whole, truth = pa.string(), pa.float64(), pa.int64(), pa.bool_()
    columns = {
        **dict.fromkeys(("kind", "node", "other", "site"), text),
        **{"T": pa.list_(real), "covariance": pa.list_(real), "component": whole, "datum": text},
        **{"doubtful": truth, "used": truth, "chi2": real, "freedom": whole, "w": real},
        **{"redundancy": real, "detectable_rotation_rad": real, "detectable_translation_m": real},
        **{"rivals": pa.list_(text), "reason": text},
    }
    metadata = {"schema": NETWORK_SCHEMA, "unit_variance": repr(found.unit_variance)}
    schema = pa.schema(columns, metadata)
    write_bytes(absolute(place), parquet_of(_lines(of, found), schema))


def name_of(of: FleetNetwork, kind: Kind, index: int) -> str:
    """Name an observation as the fleet knows it."""
    graph = of.graph
    if kind == "edge":
        i, j = of.nodes[graph.edges.i[index]], of.nodes[graph.edges.j[index]]
        return f"{of.sites[index]} ({i} to {j})"
    return f"control point of {of.nodes[graph.points.node[index]]}"


def reason_of(of: FleetNetwork, one: LeftOut) -> str:
    """Say what does not fit, and what may be wrong in its stead."""
    return one.reason_of(partial(name_of, of))


def _lines(of: FleetNetwork, found: NetworkAdjustment) -> Iterator[dict[str, Any]]:
    component: dict[int, int] = {
        node: k for k, each in enumerate(found.components) for node in each.nodes.tolist()
    }
    datums = [each.datum_of(of.nodes) for each in found.components]
    for k, name in enumerate(of.nodes):
        yield {
            "kind": "pose",
            "node": name,
            "T": found.T_world_node[k].ravel(),
            "covariance": found.covariance[k].ravel(),
            "component": component[k],
            "datum": datums[component[k]],
            "doubtful": found.doubtful[k],
        }
    out = {(one.kind, one.index): one for one in found.left_out}
    i, j = of.graph.edges.i.tolist(), of.graph.edges.j.tolist()
    for k, site in enumerate(of.sites):
        ends = {"node": of.nodes[i[k]], "other": of.nodes[j[k]], "site": site}
        yield {**ends, **_tested(of, found, "edge", k, out.get(("edge", k)))}
    for k, node in enumerate(of.graph.points.node.tolist()):
        point = _tested(of, found, "control point", k, out.get(("control point", k)))
        yield {"node": of.nodes[node], **point}
    for one in of.not_used:
        yield {"kind": one.kind, one.kind: one.name, "used": False, "reason": one.reason}


def _tested(
    of: FleetNetwork, found: NetworkAdjustment, kind: Kind, k: int, out: LeftOut | None
) -> dict[str, Any]:
    """Give the columns that an observation has."""
    tests = found.edges if kind == "edge" else found.points
    return {
        "kind": kind,
        "used": out is None,
        "chi2": float(tests.chi2[k]),
        "freedom": int(tests.freedom[k]),
        "w": float(tests.w[k]),
        "redundancy": float(tests.redundancy[k]),
        "detectable_rotation_rad": _finite(tests.detectable_rotation, k),
        "detectable_translation_m": _finite(tests.detectable_translation, k),
        "rivals": [] if out is None else [name_of(of, *rival) for rival in out.rivals],
        "reason": None if out is None else reason_of(of, out),
    }


def _finite(values: Array, k: int) -> float | None:
    return float(values[k]) if math.isfinite(values[k]) else None
