"""Which sites a folder, a glob and a list stand for."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet as pq

from retropole.base.errors import ReadError, UsageError
from retropole.fleet.sites import COLUMNS, OPTIONS, find_sites
from retropole.result import RunConfig
from tests.fleet.fleets import ids_of


def touched(folder: Path, *names: str) -> Path:
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"")
    return folder


def written(folder: Path, *lines: str) -> str:
    path = folder / "list.csv"
    path.write_text("\n".join(lines))
    return str(path)


def test_a_folder_has_site_files_and_pairs_at_any_depth(tmp_path: Path) -> None:
    touched(tmp_path, "a/target.pcd", "a/source.las", "b/c/site.toml", "b/c/1.pcd", "d.toml")
    touched(tmp_path, "e/target/1.pcd", "e/source/1.pcd", "f/target.pcap", "f/target.json")
    touched(tmp_path, "f/source.pcap", "f/source.json", "notes.txt")
    sites = find_sites([str(tmp_path)])
    assert {site.id: site.kind for site in sites} == {
        **dict.fromkeys(("a", "e", "f"), "pair"),
        **dict.fromkeys(("b/c", "d"), "site"),
    }
    assert not any(site.fault for site in sites)
    assert sites[0].source == str(tmp_path / "a/source.las")
    assert sites[3].target == str(tmp_path / "e/target")


def test_of_a_pair_that_is_not_whole_the_row_tells(tmp_path: Path) -> None:
    touched(tmp_path, "a/target.pcd", "b/target.pcd", "b/target.ply", "b/source.pcd")
    faults = {site.id: site.fault for site in find_sites([str(tmp_path)])}
    assert faults["a"] == "there are 1 named target and 0 source, expected one each"
    assert "2 named target and 1 source" in faults["b"]


@pytest.mark.parametrize("pattern", ["*", "p?", "*/site.toml"])
def test_globs(tmp_path: Path, pattern: str) -> None:
    touched(tmp_path, "p1/site.toml", "p2/site.toml")
    assert ids_of(find_sites([str(tmp_path / pattern)])) == ["p1", "p2"]
    with pytest.raises(ReadError, match="nothing matches"):
        find_sites([str(tmp_path / "q*")])


def test_urls(tmp_path: Path) -> None:
    import fsspec

    memory = fsspec.filesystem("memory")
    for name in ("p1/target.pcd", "p1/source.pcd", "list.csv"):
        memory.pipe_file(f"/sites/{name}", b"id,site\nquay,quay/site.toml\n")
    (site,) = find_sites(["memory://sites/p*"])
    assert (site.id, site.target) == ("p1", "memory://sites/p1/target.pcd")
    (listed,) = find_sites(["memory://sites/list.csv"])
    assert listed.site == "memory://sites/quay/site.toml"
    with pytest.raises(UsageError, match="nowhere"):
        find_sites(["nowhere://sites"])


def test_a_list_has_options_of_pairs(tmp_path: Path) -> None:
    path = written(
        tmp_path,
        "id, target, source, radius_m, sensor_source, up, latitude_deg, longitude_deg",
        "b, x/1.pcd, s3://far/2.pcd, 0.03, OS1, true, 90, -180",
        "a, /y/1.pcd, 2.pcd,,,,,",
    )
    second, first = find_sites([path], RunConfig(sensor_source="VLP-16"))
    assert first.config == RunConfig(radius_m=0.03, sensor_source="OS1", up=True)
    assert (first.target, first.source) == (str(tmp_path / "x/1.pcd"), "s3://far/2.pcd")
    assert (first.latitude, first.longitude) == pytest.approx((np.pi / 2, -np.pi))
    assert second.config == RunConfig(sensor_source="VLP-16")
    assert (second.id, second.target, second.latitude) == ("a", "/y/1.pcd", None)


def test_pairs_before_which_a_pole_was_carried(tmp_path: Path) -> None:
    path = written(tmp_path, "id,target,source,carried", "1,a.mcap,b.mcap,true", "2,c,d,")
    walk, other = find_sites([path])
    assert walk.config == RunConfig(carried=True)
    assert other.config == RunConfig()


def test_parquet_says_the_same_as_csv(tmp_path: Path) -> None:
    path = written(tmp_path, "id,target,source,radius_m,up", "1,a,b,0.03,true", "2,c,d,,")
    table = {"id": [1, 2], "target": ["a", "c"], "source": ["b", "d"]}
    table |= {"radius_m": [0.03, None], "up": [True, None]}
    pq.write_table(pa.table(table), tmp_path / "list.parquet")
    assert find_sites([str(tmp_path / "list.parquet")]) == find_sites([path])


@pytest.mark.parametrize(
    ("line", "fault"),
    [
        ("a,t,s,,x,", "radius_m"),
        ("a,t,,,,", "expected target and source, or site alone"),
        ("a,t,s,site.toml,,", "expected target and source, or site alone"),
        ("a,,,site.toml,0.02,", "radius_m: for a site, these are given in its file"),
        ("a,t,s,,,91", "latitude_deg"),
        ("a,t,s,,,50", "must be given together"),
    ],
)
def test_what_is_wrong_with_a_row_is_its_own_matter(tmp_path: Path, line: str, fault: str) -> None:
    path = written(tmp_path, "id,target,source,site,radius_m,latitude_deg", line, "b,t,s,,,")
    wrong, right = find_sites([path])
    assert fault in wrong.fault
    assert not right.fault


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (("id,target,source,radius", "a,b,c,1"), "unknown column 'radius', expected radius_m"),
        (("target,source", "a,b"), "no column 'id'"),
        (("id,site,site", "a,b,c"), "appears twice"),
        (("id,site", "a,b", "a,c"), "the id 'a' appears twice"),
        (("id,site", ",b"), "row 1, id"),
        (("id,site", "../a,b"), "row 1, id"),
        (("id,site", "a,b,c"), "line 2 has not as many cells"),
        (("id,site", 'a,"b'), "unexpected end of data"),
    ],
)
def test_a_list_that_is_wrong_is_refused(
    tmp_path: Path, lines: tuple[str, ...], words: str
) -> None:
    with pytest.raises(ReadError, match=r"list\.csv: ") as caught:
        find_sites([written(tmp_path, *lines)])
    assert words in str(caught.value)


def test_other_files_are_refused(tmp_path: Path) -> None:
    touched(tmp_path, "a.pcd")
    with pytest.raises(UsageError, match=r"a\.pcd: expected a folder"):
        find_sites([str(tmp_path / "a.pcd")])
    with pytest.raises(ReadError, match="no such file"):
        find_sites([str(tmp_path / "b.csv")])
    (tmp_path / "b.parquet").write_bytes(b"PAR1")
    with pytest.raises(ReadError, match="is not Parquet"):
        find_sites([str(tmp_path / "b.parquet")])
    (tmp_path / "c.csv").write_bytes(b"id,site\n\xff,b\n")
    with pytest.raises(ReadError, match="is not UTF-8"):
        find_sites([str(tmp_path / "c.csv")])


def test_columns_are_options_of_a_run() -> None:
    assert set(OPTIONS) <= set(RunConfig.__struct_fields__)
    assert set(OPTIONS) < set(COLUMNS)
