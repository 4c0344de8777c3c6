"""From the answers of a fleet to a network."""

from pathlib import Path

import msgspec
import numpy as np
import pytest

from retropole.api.result import SiteResult
from retropole.base import se3
from retropole.base.errors import ReadError
from retropole.fleet.dataset import LidarEntry, Row
from retropole.fleet.network.adjustment import adjust_network
from retropole.fleet.network.dataset import NotUsed, find_network, read_nodes
from retropole.result import encode
from tests.export.sites import free
from tests.fleet.answered import SIGMA, answered_pair, write_answers
from tests.fleet.network.made_up_fleet import WRONG, MadeUpFleet, write_made_up_fleet

pytest.importorskip("gtsam", reason="needs the extra network")

pytestmark = pytest.mark.full

HEAD = "node,site,lidar\n"


@pytest.fixture(scope="module")
def made_up(tmp_path_factory: pytest.TempPathFactory) -> MadeUpFleet:
    return write_made_up_fleet(tmp_path_factory.mktemp("network"))


def test_pairs_that_share_lidars_are_a_network(made_up: MadeUpFleet) -> None:
    network = find_network(made_up.dataset, read_nodes(str(made_up.nodes)))
    assert network.nodes == tuple(made_up.truth)
    assert network.not_used == (
        NotUsed("site", "bad", "refused: few_poles"),
        NotUsed("node", "p9", "no relative pose leads to it"),
    )
    found = adjust_network(network.graph)
    assert [network.sites[k] for k in np.flatnonzero(~found.used)] == [WRONG]
    for name, T, C in zip(network.nodes, found.T_world_node, found.covariance, strict=True):
        step = se3.local(T, made_up.truth[name])
        assert step @ np.linalg.solve(C, step) < 30


def site_row() -> Row:
    document = free()
    entries = [
        LidarEntry(name=each.name, sensor="", T=[], covariance=[], predicted_error=[], budget=[])
        for each in document.lidars
    ]
    return Row(
        id="yard",
        kind="site",
        status="ok",
        frame=document.frame.name,
        lidars=entries,
        document=encode(document).decode(),
        version="1",
        libraries="numpy 2",
    )


def test_a_site_is_a_tree_of_its_relative_poses(tmp_path: Path) -> None:
    result = SiteResult(free())
    names = [each.name for each in free().lidars]
    out = write_answers(tmp_path / "fleet", [site_row()])
    lines = "".join(f"n{k},yard,{name}\n" for k, name in enumerate(names))
    (tmp_path / "nodes.csv").write_text(HEAD + lines)
    network = find_network(out, read_nodes(str(tmp_path / "nodes.csv")))
    edges = network.graph.edges
    assert len(edges) == len(names) - 1
    for i, j, T, C in zip(edges.i, edges.j, edges.T_i_j, edges.covariance, strict=True):
        a, b = (names[int(network.nodes[k][1:])] for k in (i, j))
        np.testing.assert_allclose(T, result.T(a, b), atol=1e-12)
        np.testing.assert_allclose(C, result.covariance(a, b), atol=1e-15)
    found = adjust_network(network.graph)
    assert len(found.components) == 1
    own = found.T_world_node
    last = len(names) - 1
    np.testing.assert_allclose(
        se3.inverse(own[0]) @ own[last], result.T(names[0], names[last]), atol=1e-9
    )


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ("a,good,target\nb,good,source\na,gone,target\n", "there is no site 'gone'"),
        ("a,good,target\nb,good,sauce\n", "'good' has no LiDAR 'sauce', expected one of target"),
        ("a,good,target\n", "no answer has two LiDARs that are nodes"),
        ("a,long,target\nb,long,source\n", "the answer of 'long': "),
        ("a,bent,target\nb,bent,source\n", "the answer of 'bent': no rigid transform"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, lines: str, words: str) -> None:
    good = answered_pair("good", np.eye(4))
    long = msgspec.structs.replace(
        answered_pair("long", np.eye(3)), lidars=[msgspec.structs.replace(good.lidars[0], T=[1.0])]
    )
    bent = answered_pair("bent", 2 * np.eye(4), np.eye(6) * SIGMA**2)
    out = write_answers(tmp_path / "fleet", [good, long, bent])
    (tmp_path / "nodes.csv").write_text(HEAD + lines)
    with pytest.raises(ReadError, match=words):
        find_network(out, read_nodes(str(tmp_path / "nodes.csv")))
