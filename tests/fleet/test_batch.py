"""What a dataset is follows from its sites alone, and nothing is done twice."""

import errno
import os
import shutil
from collections import Counter
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import msgspec
import numpy as np
import pytest

from retropole.base.files import write_atomically
from retropole.fleet import batch, storage
from retropole.fleet.batch import calibrate_fleet, whole_groups
from retropole.fleet.dataset import Row, known_answers, partitions_in, read_rows, read_runs
from retropole.fleet.sites import find_sites
from retropole.fleet.work import Outcome, Task, answer
from retropole.result.decoding import decode
from tests.fleet.fleets import ENDS, bytes_of, here, in_disorder, shuffled

pytestmark = pytest.mark.full


@pytest.fixture(scope="module")
def out(fleet: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Dataset of the fleet; whoever changes it takes a copy."""
    out = tmp_path_factory.mktemp("dataset") / "fleet"
    summary = calibrate_fleet(find_sites([str(fleet)]), str(out), here)
    assert summary.statuses == {status: len(ids) for status, ids in ENDS.items()}
    assert (summary.sites, summary.done, summary.others) == (8, 7, 0)
    return out


def copied(folder: Path, to: Path) -> Path:
    shutil.copytree(folder, to / folder.name)
    return to / folder.name


def rows_of(out: Path) -> dict[str, Row]:
    found: dict[str, Row] = {}
    for part in partitions_in(str(out)):
        found |= read_rows(str(out), part)
    return found


def never(tasks: Iterator[Task]) -> Iterator[Outcome]:
    raise AssertionError(list(tasks))


@pytest.mark.parametrize("at_url", [False, True])
def test_a_second_run_into_a_dataset_is_informed_of_the_first(
    at_url: bool, fleet: Path, tmp_path: Path
) -> None:
    if os.name == "nt" and not at_url:
        pytest.skip("the system has no such locks")
    out = f"memory://{tmp_path.name}/out" if at_url else str(tmp_path / "out")
    sites, met = find_sites([str(fleet)]), []

    def second_first(tasks: Iterator[Task]) -> Iterator[Outcome]:
        before = storage.found_below(out)
        with pytest.raises(OSError, match=rf"another run .* \(process {os.getpid()} on ") as caught:
            calibrate_fleet(sites, out, never)
        met.append(caught.value)
        assert storage.found_below(out) == before
        yield from here(tasks)

    assert calibrate_fleet(sites, out, second_first).done == 7
    assert len(met) == 1
    # The first is over; the note that it leaves in a folder, killed or not, keeps nobody away.
    assert calibrate_fleet(sites, out, here).done == 1


def test_every_site_has_its_row(out: Path) -> None:
    rows = rows_of(out)
    assert {name: row.status for name, row in rows.items()} == {
        name: status for status, names in ENDS.items() for name in names
    }
    codes = {name: rows[name].codes for name in ENDS["error"]}
    assert codes == {"absent": ["unreadable"], "damaged": ["unreadable"], "slip": ["usage"]}
    assert "nothing.pcd" in rows["absent"].messages[0]
    assert "radius_m" in rows["slip"].messages[0]
    assert all(rows[name].codes and rows[name].key for name in ENDS["refused"])


def test_a_row_holds_what_its_document_does(out: Path) -> None:
    row = rows_of(out)["good"]
    assert row.document is not None
    document = decode(row.document.encode())
    (lidar,) = row.lidars
    assert (row.frame, lidar.name) == ("target", "source")
    np.testing.assert_array_equal(np.reshape(lidar.T, (4, 4)), document.T_target_source)
    np.testing.assert_array_equal(np.reshape(lidar.covariance, (6, 6)), document.covariance)
    assert row.sigma_30m_m == next(
        each.sigma_m for each in document.predicted_error or () if each.range_m == 30
    )
    assert lidar.budget == document.budget
    assert [each.sha256 for each in row.inputs] == [each.sha256 for each in document.inputs]
    assert row.latitude_rad == pytest.approx(np.radians(52.5))
    assert (document.created, document.seconds) == ("", {})
    run = next(
        read_runs(str(out), part)["good"]
        for part in partitions_in(str(out))
        if "good" in read_runs(str(out), part)
    )
    assert {"read", "refine"} <= {step.name for step in run.steps}


def test_order_does_not_matter(fleet: Path, out: Path, tmp_path: Path) -> None:
    sites = shuffled(find_sites([str(fleet)]), seed=1)
    calibrate_fleet(sites, str(tmp_path), in_disorder(2))
    assert bytes_of(tmp_path) == bytes_of(out)


def test_what_was_done_is_not_done_again(fleet: Path, out: Path, tmp_path: Path) -> None:
    again = copied(out, tmp_path)
    times = {path: path.stat().st_mtime_ns for path in again.rglob("*.parquet")}
    done = Counter[str]()

    def counting(tasks: Iterator[Task]) -> Iterator[Outcome]:
        for outcome in map(answer, tasks):
            done[outcome.id] += outcome.row is not None
            yield outcome

    summary = calibrate_fleet(find_sites([str(fleet)]), str(again), counting)
    # Of a file that is absent nothing tells whether it still is.
    assert +done == {"absent": 1}
    assert summary.statuses == {status: len(ids) for status, ids in ENDS.items()}
    assert {path: path.stat().st_mtime_ns for path in again.rglob("*.parquet")} == times


def test_errors_are_tried_again_when_requested(fleet: Path, out: Path, tmp_path: Path) -> None:
    again = copied(out, tmp_path)
    sites = find_sites([str(fleet)])
    assert calibrate_fleet(sites, str(again), here, retry=True).done == 2
    assert bytes_of(again) == bytes_of(out)


def test_another_file_is_another_site(fleet: Path, out: Path, tmp_path: Path) -> None:
    folder, again = copied(fleet.parent, tmp_path), tmp_path / "again"
    small = [site for site in find_sites([str(folder / "sites.csv")]) if "small" in site.id]
    calibrate_fleet(small, str(again), here)
    before = rows_of(again)
    shutil.copy(folder / "small/2/source.pcd", folder / "small/1/target.pcd")
    assert calibrate_fleet(small, str(again), here).done == 1
    after = rows_of(again)
    assert {name for name in after if after[name] != before[name]} == {"small/1"}
    wider = [
        msgspec.structs.replace(
            small[0], config=msgspec.structs.replace(small[0].config, radius_m=0.03)
        )
    ]
    assert calibrate_fleet(wider, str(again), here).done == 1
    assert calibrate_fleet(wider, str(again), here).done == 0


def test_sites_that_are_not_named_are_kept_unless_requested(
    fleet: Path, out: Path, tmp_path: Path
) -> None:
    again = copied(out, tmp_path)
    one = [site for site in find_sites([str(fleet)]) if site.id == "small/1"]
    assert calibrate_fleet(one, str(again), here).others == 7
    assert bytes_of(again) == bytes_of(out)
    summary = calibrate_fleet(one, str(again), here, drop_others=True)
    assert (summary.done, summary.others) == (0, 7)
    assert set(rows_of(again)) == {"small/1"}
    fresh = tmp_path / "fresh"
    calibrate_fleet(one, str(fresh), here)
    assert bytes_of(again) == bytes_of(fresh)


def test_what_is_interrupted_goes_on(fleet: Path, out: Path, tmp_path: Path) -> None:
    sites = find_sites([str(fleet)])

    def interrupted(tasks: Iterator[Task]) -> Iterator[Outcome]:
        yield from map(answer, islice(tasks, 3))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        calibrate_fleet(sites, str(tmp_path), interrupted)
    some = bytes_of(tmp_path)
    assert 3 <= len(some) < len(bytes_of(out))
    assert some.items() <= bytes_of(out).items()
    calibrate_fleet(sites, str(tmp_path), in_disorder(3))
    assert bytes_of(tmp_path) == bytes_of(out)


def test_a_full_disk_ends_it_and_loses_nothing(
    fleet: Path, out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sites, writes = find_sites([str(fleet)]), []
    write = write_atomically

    def full(path: Path, data: bytes) -> None:
        writes.append(path)
        if len(writes) > 5:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        write(path, data)

    monkeypatch.setattr(storage, "write_atomically", full)
    with pytest.raises(OSError, match="No space left on device") as caught:
        calibrate_fleet(sites, str(tmp_path), here)
    assert str(tmp_path) in str(caught.value.filename)
    assert bytes_of(tmp_path).items() <= bytes_of(out).items()
    monkeypatch.undo()
    calibrate_fleet(sites, str(tmp_path), here)
    assert bytes_of(tmp_path) == bytes_of(out)


def test_a_dataset_may_be_a_url(fleet: Path, out: Path) -> None:
    import fsspec

    sites = find_sites([fleet.as_uri()])
    for _ in range(2):
        calibrate_fleet(sites, "memory://city/fleet", here)
    memory = fsspec.filesystem("memory")
    found = {
        path.rpartition("/")[2]: memory.cat_file(path)
        for path in memory.find("/city/fleet/answers")
    }
    assert found == bytes_of(out)
    assert set(known_answers("memory://city/fleet")) == {
        name for ids in ENDS.values() for name in ids
    }


def test_reports_are_made_where_they_are_not(fleet: Path, tmp_path: Path) -> None:
    sites = [site for site in find_sites([str(fleet)]) if site.id in ("small/1", "yard")]
    out, reports = str(tmp_path / "out"), tmp_path / "reports"
    calibrate_fleet(sites, out, here)
    assert calibrate_fleet(sites, out, here, reports=str(reports)).done == 2
    assert calibrate_fleet(sites, out, here, reports=str(reports)).done == 0
    assert (reports / "small/1/report.html").exists()
    assert (reports / "yard/site-report.html").exists()
    (reports / "yard/site-result.json").unlink()
    assert calibrate_fleet(sites, out, here, reports=str(reports)).done == 1


def test_progress_says_how_long(fleet: Path, out: Path) -> None:
    said: list[str] = []
    calibrate_fleet(find_sites([str(fleet)]), str(out), here, progress=said.append)
    assert said[0].startswith("calibrate: 2 of 8, about ")
    assert said[-1] == "calibrate: 8 of 8"
    assert "left" in batch.how_far("calibrate", 1, 10, 60.0)


def test_a_group_is_given_once_with_all_that_belongs_to_it() -> None:
    group_of = {f"{k}": k % 4 for k in range(10)}
    for seed in range(5):
        found = [(name, seed) for name in shuffled(group_of, seed)]
        waiting: dict[int, dict[str, int]] = {}
        whole = list(whole_groups(found[:-1], group_of, waiting))
        last = group_of[found[-1][0]]
        assert sorted(group for group, _ in whole) == [k for k in range(4) if k != last]
        for group, members in (*whole, *waiting.items()):
            assert members.items() == {each for each in found[:-1] if group_of[each[0]] == group}
        assert waiting.keys() == {last}
