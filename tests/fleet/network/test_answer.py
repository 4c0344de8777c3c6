"""A network as a file."""

from pathlib import Path

import pytest
from pyarrow import parquet as pq

from retropole.fleet.network.answer import name_of, write_network
from retropole.fleet.network.dataset import find_network, read_nodes
from retropole.fleet.network.network import adjust_network
from tests.fleet.network.made_up_fleet import write_made_up_fleet

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
    assert len(tests) == len(network.graph.observed)
    assert all(0 <= row["redundancy"] <= 1 for row in tests)
    assert name_of(network, "control point", 2) == "control point of p5"
