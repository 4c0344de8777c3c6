"""A network as a file."""

from pathlib import Path

import numpy as np
import pytest
from pyarrow import parquet as pq

from retropole.fleet.network.adjustment import adjust_network
from retropole.fleet.network.answer import name_of, write_g2o, write_network
from retropole.fleet.network.dataset import find_network, read_nodes
from tests.fleet.network.made_up_fleet import write_made_up_fleet

gtsam = pytest.importorskip("gtsam", reason="needs the extra network")

pytestmark = pytest.mark.full


def test_the_same_network_is_the_same_file(tmp_path: Path) -> None:
    made_up = write_made_up_fleet(tmp_path)
    network = find_network(made_up.dataset, read_nodes(str(made_up.nodes)))
    found = adjust_network(network.graph)
    one, two = tmp_path / "one.parquet", tmp_path / "deep/two.parquet"
    write_network(str(one), network, found)
    write_network(str(two), network, found)
    assert one.read_bytes() == two.read_bytes()
    metadata = pq.read_schema(one).metadata
    assert metadata[b"schema"] == b"retropole/network/1"
    assert float(metadata[b"unit_variance"]) == found.unit_variance
    tests = [row for row in pq.read_table(one).to_pylist() if row["chi2"] is not None]
    assert len(tests) == len(network.graph.ends)
    assert all(0 <= row["redundancy"] <= 1 for row in tests)
    assert name_of(network, len(network.sites) + 2) == "control point of p5"


def test_g2o_has_the_graph_and_the_names(tmp_path: Path) -> None:
    made_up = write_made_up_fleet(tmp_path)
    network = find_network(made_up.dataset, read_nodes(str(made_up.nodes)))
    write_g2o(str(tmp_path / "network.g2o"), network)
    lines = (tmp_path / "network.g2o").read_text().splitlines()
    count = [
        sum(line.startswith(f"{word} ") for line in lines)
        for word in ("VERTEX_SE3:QUAT", "EDGE_SE3:QUAT", "#")
    ]
    assert count == [6, 9, 6]
    assert lines[-1] == "# 5 p5"
    graph, values = gtsam.readG2o(str(tmp_path / "network.g2o"), True)
    for k, T in enumerate(network.graph.edges.T_i_j):
        np.testing.assert_allclose(graph.at(k).measured().matrix(), T, atol=1e-4)
        root, theirs = network.graph.roots[k], graph.at(k).noiseModel().R()
        np.testing.assert_allclose(theirs.T @ theirs, root.T @ root, rtol=1e-3, atol=1e-3)
    assert values.size() == 6
