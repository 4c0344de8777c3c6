"""Lists of nodes."""

from pathlib import Path

import pyarrow as pa
import pytest
from pyarrow import parquet as pq

from retropole.base.errors import ReadError, UsageError
from retropole.fleet.network.dataset import read_nodes

pytestmark = pytest.mark.full

HEAD = "node,site,lidar,x_m,y_m,z_m,sigma_m,seen_x_m\n"


def test_csv_and_parquet_say_the_same(tmp_path: Path) -> None:
    text = HEAD + "a,s,target,1,2,3,0.01,\nb,s,source,,,,,\na,,,4,5,6,0.02,0.5\n"
    (tmp_path / "nodes.csv").write_text(text)
    found = read_nodes(str(tmp_path / "nodes.csv"))
    assert found.of_site == {"s": {"target": "a", "source": "b"}}
    assert [(p.node, p.x_m, p.sigma_m, p.seen_x_m) for p in found.surveyed] == [
        ("a", 1.0, 0.01, 0.0),
        ("a", 4.0, 0.02, 0.5),
    ]
    table = pa.table(
        {
            "node": ["a", "b", "a"],
            "site": ["s", "s", None],
            "lidar": ["target", "source", None],
            "x_m": [1.0, None, 4.0],
            "y_m": [2.0, None, 5.0],
            "z_m": [3.0, None, 6.0],
            "sigma_m": [0.01, None, 0.02],
            "seen_x_m": [None, None, 0.5],
        }
    )
    pq.write_table(table, tmp_path / "nodes.parquet")
    other = read_nodes(str(tmp_path / "nodes.parquet"))
    assert (other.of_site, other.surveyed) == (found.of_site, found.surveyed)


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ("a,s,,,,,,\n", "row 1: site and lidar must be given together"),
        ("a,,,,,,,\n", "row 1: expected site and lidar"),
        ("a,s,target,,,,0.1,\n", "row 1: expected site and lidar"),
        (",s,target,,,,,\n", "row 1, node: ''"),
        ("a,s,target,1,2,,0.1,\n", "row 1: .*z_m"),
        ("a,s,target,1,2,three,0.1,\n", "row 1: .*z_m"),
        ("a,s,target,1,2,nan,0.1,\n", "row 1: "),
        ("a,s,target,1,2,3,0,\n", "row 1: .*sigma_m"),
        ("a,s,target,,,,,\nb,s,target,,,,,\n", "row 2: 'target' of 's'"),
        ("a,s,target,,,,,\na,s,source,,,,,\n", "row 2: 'source' of 's'"),
        ("a,,,1,2,3,0.1,\n", "no row with a site and a lidar"),
    ],
)
def test_a_slip_is_named(tmp_path: Path, lines: str, words: str) -> None:
    path = tmp_path / "nodes.csv"
    path.write_text(HEAD + lines)
    with pytest.raises(ReadError, match=words):
        read_nodes(str(path))


def test_other_files_and_columns_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"nodes\.txt: expected a file \.csv, \.parquet"):
        read_nodes(str(tmp_path / "nodes.txt"))
    (tmp_path / "nodes.csv").write_text("node,sight,lidar\n")
    with pytest.raises(ReadError, match="unknown column 'sight', expected site"):
        read_nodes(str(tmp_path / "nodes.csv"))
