"""A network adjusted, as one Parquet file, schema ``retropole/network/1``; a graph as g2o.

A row for each pose, each relative pose, each control point, and each site or node that is not in
the network; its `kind` says which.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ..storage import absolute, write_bytes
from ..tables import arrow, parquet_of
from .adjustment import NetworkAdjustment, as_factors, engine, find_start
from .dataset import FleetNetwork

NETWORK_SCHEMA = "retropole/network/1"


def write_network(place: str, of: FleetNetwork, found: NetworkAdjustment) -> None:
    """Write an adjusted network, whole or not at all, to a path or URL.

    Raises
    ------
    MissingExtraError
        If the extra ``fleet`` is not installed.
    OSError
        If it cannot be written.
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
    write_bytes(absolute(place), parquet_of(_lines(of, found), pa.schema(columns, metadata)))


def write_g2o(place: str, of: FleetNetwork) -> None:
    """Write the relative poses of a network, and poses to start from, as g2o to a path or URL.

    Comments at its end say which vertex is which node. Control points have no form in g2o.

    Raises
    ------
    MissingExtraError
        If the extra ``network`` is not installed.
    OSError
        If it cannot be written.
    """
    factors = as_factors(of.graph)
    factors.resize(len(of.graph.edges))
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "network.g2o"
        engine().writeG2o(factors, find_start(of.graph), str(file))
        names = "".join(f"# {k} {name}\n" for k, name in enumerate(of.nodes))
        write_bytes(absolute(place), file.read_bytes() + names.encode())


def name_of(of: FleetNetwork, k: int) -> str:
    """Name an observation as the fleet knows it."""
    edges = of.graph.edges
    if k < len(edges):
        return f"{of.sites[k]} ({of.nodes[edges.i[k]]} to {of.nodes[edges.j[k]]})"
    return f"control point of {of.nodes[of.graph.points.node[k - len(edges)]]}"


def reason_of(of: FleetNetwork, found: NetworkAdjustment, k: int) -> str:
    """Describe how an observation does not fit, and which others may be wrong instead."""
    text = f"{name_of(of, k)}: w {found.w[k]:.1f} against all others"
    if rivals := ", ".join(name_of(of, rival) for rival in found.rivals.get(k, ())):
        text += f"; {rivals} may be the wrong one instead"
    return text


def _lines(of: FleetNetwork, found: NetworkAdjustment) -> Iterator[dict[str, Any]]:
    for number, each in enumerate(found.components):
        part = {"kind": "pose", "component": number, "datum": each.datum(of.nodes)}
        for k in each.nodes.tolist():
            yield {
                **part,
                "node": of.nodes[k],
                "T": found.T_world_node[k].ravel(),
                "covariance": found.covariance[k].ravel(),
                "doubtful": found.doubtful[k],
            }
    edges = len(of.sites)
    for k, (i, j) in enumerate(of.graph.ends.tolist()):
        edge = {"kind": "edge", "other": of.nodes[j], "site": of.sites[k]} if k < edges else {}
        rotation, translation = (x if np.isfinite(x) else None for x in found.detectable[k])
        yield {
            "kind": "control point",
            "node": of.nodes[i],
            **edge,
            "used": found.used[k],
            "chi2": found.chi2[k],
            "freedom": found.freedom[k],
            "w": found.w[k],
            "redundancy": found.redundancy[k],
            "detectable_rotation_rad": rotation,
            "detectable_translation_m": translation,
            "rivals": [name_of(of, rival) for rival in found.rivals.get(k, ())],
            "reason": None if found.used[k] else reason_of(of, found, k),
        }
    for one in of.not_used:
        yield {"kind": one.kind, one.kind: one.name, "used": False, "reason": one.reason}
