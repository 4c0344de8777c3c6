"""The same on every file system: what is written is read, listed, matched, copied and removed."""

import uuid
from pathlib import Path

import pytest

from retropole.base.errors import ReadError
from retropole.fleet import storage
from retropole.fleet.dataset import partition_of, read_rows
from retropole.fleet.sites import find_sites
from tests.fleet.made_up import made_up_row, write_made_up


@pytest.fixture(params=["path", "file", "memory"])
def root(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """Name a folder that is not there yet."""
    places = {
        "path": str(tmp_path / "root"),
        "file": (tmp_path / "root").as_uri(),
        "memory": f"memory://{uuid.uuid4().hex}/root",
    }
    return places[request.param]


def test_what_is_written_is_found(root: str, tmp_path: Path) -> None:
    root = storage.absolute(root)
    place = storage.below(root, "a/b.txt")
    assert not storage.exists(place)
    assert storage.names_in(storage.below(root, "a")) == []
    for data in (b"old", b"new"):
        storage.write_bytes(place, data)
        assert storage.read_bytes(place) == data
    assert storage.names_in(storage.folder_of(place)) == ["b.txt"]
    assert storage.is_folder(storage.folder_of(place))
    assert storage.found_below(root) == ["a", "a/b.txt"]
    assert storage.matching(storage.below(root, "*/b.*")) == [place]
    assert storage.fetch(place, tmp_path / "copy").read_bytes() == b"new"
    with pytest.raises(ReadError, match="more than 2 bytes"):
        storage.read_bytes(place, 2)
    storage.remove(place)
    assert not storage.exists(place)
    with pytest.raises(ReadError, match="cannot be read"):
        storage.read_bytes(place)


def test_pairs_and_site_files_are_found_in_a_folder(root: str) -> None:
    for name in ("p/target.pcd", "p/source.pcd", "q/r/site.toml"):
        storage.write_bytes(storage.below(storage.absolute(root), name), b"")
    assert [(site.id, site.kind) for site in find_sites([root])] == [("p", "pair"), ("q/r", "site")]


def test_a_dataset_has_the_same_bytes_everywhere(root: str, tmp_path: Path) -> None:
    import numpy as np

    from retropole.fleet.dataset import ANSWERS, write_partition

    row = made_up_row("post", np.random.default_rng(0))
    part = partition_of(row.id)
    write_made_up(tmp_path / "here", [row])
    write_partition(storage.absolute(root), part, [row], [])
    there = storage.below(storage.absolute(root), f"{ANSWERS}/{part}")
    assert storage.read_bytes(there) == (tmp_path / "here" / ANSWERS / part).read_bytes()
    assert read_rows(root, part) == {row.id: row}
