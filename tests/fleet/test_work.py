"""One site: files in, a row out, whatever the files are."""

from pathlib import Path

import fsspec
import msgspec
import pytest

from retropole.fleet import work
from retropole.fleet.dataset import Row
from retropole.fleet.sites import FleetSite, find_sites
from retropole.fleet.work import Hashed, Outcome, Task, answer, environment
from retropole.result.decoding import decode_site
from tests.api.site_files import write_site
from tests.io.packets.sending import datagram, pcap, turning


def task_of(site: FleetSite, **options: object) -> Task:
    task = Task(site=site, time_limit=60.0, environment=environment())
    return msgspec.structs.replace(task, **options)


def row_of(task: Task) -> Row:
    row = answer(task).row
    assert row is not None
    return row


@pytest.fixture
def sites(fleet: Path) -> dict[str, FleetSite]:
    return {site.id: site for site in find_sites([str(fleet)])}


@pytest.fixture
def far(fleet: Path) -> dict[str, FleetSite]:
    """The fleet in an object store."""
    memory = fsspec.filesystem("memory")
    memory.put(str(fleet.parent), "/far", recursive=True)
    return {site.id: site for site in find_sites(["memory://far/sites.csv"])}


def test_the_hashes_are_reported_before_anything_is_read(sites: dict[str, FleetSite]) -> None:
    told: list[Hashed] = []
    outcome = answer(task_of(sites["small/1"]), told.append)
    assert outcome.row is not None
    assert [each.key for each in told] == [outcome.row.key]
    assert [each.sha256 for each in told[0].inputs] == [each.sha256 for each in outcome.row.inputs]
    again = task_of(sites["small/1"], known=outcome.row.key)
    assert answer(again) == Outcome("small/1")


@pytest.mark.parametrize("name", ["small/1", "yard", "absent", "damaged"])
def test_of_urls_the_row_is_the_same_but_for_the_paths(
    name: str, sites: dict[str, FleetSite], far: dict[str, FleetSite], fleet: Path
) -> None:
    near, there = row_of(task_of(sites[name])), row_of(task_of(far[name]))
    assert (near.status, near.codes) == (there.status, there.codes)
    assert [each.sha256 for each in near.inputs] == [each.sha256 for each in there.inputs]
    for path in [each.path for each in there.inputs] + [there.site_file or "memory://far"]:
        assert path.startswith("memory://far")
    text = msgspec.json.encode(there).decode()
    assert "/tmp" not in text
    assert (there.document or "").count("memory://far") == (near.document or "").count(
        str(fleet.parent)
    )


def test_a_site_at_a_url_has_its_recordings_below(far: dict[str, FleetSite]) -> None:
    memory = fsspec.filesystem("memory")
    text = memory.cat_file("/far/yard/site.toml").replace(b"mast-a/1.pcd", b"../good/target.pcd")
    memory.pipe_file("/far/yard/site.toml", text)
    row = row_of(task_of(far["yard"]))
    assert (row.status, row.codes) == ("error", ["unreadable"])
    assert "must be in its folder or below" in row.messages[0]


def test_angles_that_a_site_file_names_are_brought_and_count(tmp_path: Path) -> None:
    path = write_site(tmp_path)
    text = path.read_text().replace('"mast-a/1.pcd", "mast-a/2.pcd"', '"a.pcap", ""')
    path.write_text(text.replace('name = "mast-a"', 'name = "mast-a"\nangles = "units/a.csv"'))
    (tmp_path / "a.pcap").write_bytes(pcap([datagram(each) for each in turning("XT16")]))
    memory = fsspec.filesystem("memory")
    memory.put(str(tmp_path), "/packets", recursive=True)
    site = FleetSite(id="packets", kind="site", site="memory://packets/site.toml")
    assert "units/a.csv" in row_of(task_of(site)).messages[0]
    lines = [f"{k + 1},{k - 5.5},0" for k in range(17)]
    rows = []
    for count in (16, 17):
        memory.pipe_file("/packets/units/a.csv", "\n".join(lines[:count]).encode())
        rows.append(row_of(task_of(site)))
    assert rows[0].key != rows[1].key
    document = decode_site((rows[0].document or "").encode())
    assert document.inputs[0].angles == "memory://packets/units/a.csv"
    assert "has angles of 17 channels" in rows[1].messages[0]


def test_reports_may_go_to_a_url(sites: dict[str, FleetSite]) -> None:
    task = task_of(sites["small/2"], reports="memory://reports")
    row = row_of(task)
    memory = fsspec.filesystem("memory")
    assert memory.exists("/reports/small/2/result.json")
    assert memory.exists("/reports/small/2/report.html")
    assert answer(msgspec.structs.replace(task, known=row.key)).row is None


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (ValueError("array is empty"), "internal"),
        (MemoryError("3 GiB"), "out_of_memory"),
        (OSError(28, "No space left on device"), "system"),
    ],
)
def test_any_error_is_a_row(
    error: Exception, code: str, sites: dict[str, FleetSite], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*given: object) -> None:
        raise error

    monkeypatch.setattr(work, "_result", fails)
    outcome = answer(task_of(sites["small/1"]))
    assert outcome.row is not None
    assert outcome.run is not None
    assert (outcome.row.status, outcome.row.codes) == ("error", [code])
    assert outcome.row.key is not None
    assert outcome.row.messages[0].startswith(type(error).__name__)


def test_what_changes_while_it_is_read_is_no_answer(
    sites: dict[str, FleetSite], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("retropole.fleet.work.hash_of", lambda path: "0" * 64)
    row = row_of(task_of(sites["small/1"]))
    assert (row.status, row.codes) == ("error", ["unreadable"])
    assert "changed while it was read" in row.messages[0]


def test_a_pipe_is_not_waited_for(tmp_path: Path, sites: dict[str, FleetSite]) -> None:
    import os

    os.mkfifo(tmp_path / "a.pcd")
    site = msgspec.structs.replace(sites["small/1"], target=str(tmp_path / "a.pcd"))
    row = row_of(task_of(site))
    assert (row.status, row.codes) == ("error", ["unreadable"])
    assert "is a named pipe, expected a file" in row.messages[0]
