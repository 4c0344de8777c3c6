"""The command ``retropole fleet network``."""

import json
from pathlib import Path

import numpy as np
import pytest

from retropole.base import se3
from tests.cli.commands import retropole_here
from tests.fleet.answered import answered_pair, write_answers
from tests.fleet.network.made_up_fleet import WRONG, MadeUpFleet, write_made_up_fleet

pq = pytest.importorskip("pyarrow.parquet", reason="needs the extra fleet")
pytest.importorskip("fsspec", reason="needs the extra fleet")
pytest.importorskip("gtsam", reason="needs the extra network")


@pytest.fixture(scope="module")
def made_up(tmp_path_factory: pytest.TempPathFactory) -> MadeUpFleet:
    return write_made_up_fleet(tmp_path_factory.mktemp("network"))


def test_what_it_says_and_writes(made_up: MadeUpFleet, tmp_path: Path) -> None:
    out = tmp_path / "network.parquet"
    done = retropole_here(
        "fleet", "network", made_up.dataset, "--nodes", made_up.nodes, "--out", out
    )
    assert done.returncode == 4
    assert not done.stderr
    lines = done.stdout.splitlines()
    assert lines[0].startswith("6 poses, 9 relative poses, 3 control points; unit variance ")
    assert lines[1] == "6 poses: 3 controls"
    assert lines[2].startswith(f"left out: {WRONG} (p1 to p3): w ")
    assert lines[3:] == [
        "not used: 1 node (no relative pose leads to it)",
        "not used: 1 site (refused: few_poles)",
        f"written: {out}",
    ]
    rows = pq.read_table(out).to_pylist()
    poses = {row["node"]: row for row in rows if row["kind"] == "pose"}
    for name, T in made_up.truth.items():
        step = se3.local(np.array(poses[name]["T"]).reshape(4, 4), T)
        C = np.array(poses[name]["covariance"]).reshape(6, 6)
        assert step @ np.linalg.solve(C, step) < 30
    out_rows = {row["site"] or row["node"]: row for row in rows if row["used"] is False}
    assert set(out_rows) == {WRONG, "bad", "p9"}
    assert out_rows[WRONG]["w"] > 5
    assert out_rows["bad"]["reason"] == "refused: few_poles"
    assert sum(row["kind"] == "edge" for row in rows) == 9


def test_json(made_up: MadeUpFleet, tmp_path: Path) -> None:
    out = tmp_path / "network.parquet"
    options = ("--nodes", made_up.nodes, "--out", out, "--json")
    done = retropole_here("fleet", "network", made_up.dataset, *options)
    told = json.loads(done.stdout)
    assert done.returncode == 4
    assert told["schema"] == "retropole/fleet-network/1"
    assert [one["name"] for one in told["left_out"]] == [f"{WRONG} (p1 to p3)"]
    assert told["components"] == [{"poses": 6, "datum": "3 controls"}]
    assert len(told["not_used"]) == 2


def test_all_that_fits_ends_with_0(made_up: MadeUpFleet, tmp_path: Path) -> None:
    nodes, out = tmp_path / "nodes.csv", tmp_path / "network.parquet"
    kept = [line for line in made_up.nodes.read_text().splitlines() if WRONG not in line]
    nodes.write_text("\n".join(kept) + "\n")
    done = retropole_here("fleet", "network", made_up.dataset, "--nodes", nodes, "--out", out, "-q")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert out.is_file()


def test_components_that_are_many_are_counted(tmp_path: Path) -> None:
    names = [f"s{k}" for k in range(12)]
    out = write_answers(tmp_path / "fleet", [answered_pair(name, np.eye(4)) for name in names])
    nodes = tmp_path / "nodes.csv"
    rows = [f"{name}{role[0]},{name},{role}" for name in names for role in ("target", "source")]
    nodes.write_text("\n".join(["node,site,lidar", *rows]) + "\n")
    done = retropole_here(
        "fleet", "network", out, "--nodes", nodes, "--out", tmp_path / "network.parquet"
    )
    lines = done.stdout.splitlines()
    assert done.returncode == 0
    assert lines[1] == "2 poses: no control points: pose s0s is fixed"
    assert lines[-2] == "and 2 components more"
    assert len(lines) == 13


def test_a_slip_ends_with_2_and_writes_nothing(made_up: MadeUpFleet, tmp_path: Path) -> None:
    nodes, out = tmp_path / "nodes.csv", tmp_path / "network.parquet"
    nodes.write_text("node,site,lidar\na,gone,target\nb,gone,source\n")
    done = retropole_here("fleet", "network", made_up.dataset, "--nodes", nodes, "--out", out)
    assert done.returncode == 2
    assert "there is no site 'gone'" in done.stderr
    assert not out.exists()


def test_the_graph_is_exported(made_up: MadeUpFleet, tmp_path: Path) -> None:
    out = tmp_path / "network.g2o"
    options = ("--nodes", made_up.nodes, "--to", "g2o", "--out", out)
    done = retropole_here("fleet", "export", made_up.dataset, *options)
    assert (done.returncode, done.stdout) == (0, f"written: {out}\n")
    assert out.read_text().startswith("VERTEX_SE3:QUAT 0 ")
