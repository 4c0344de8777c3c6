"""One site is checked: a row, whatever is wrong with it."""

import shutil
from datetime import UTC, datetime
from pathlib import Path

import msgspec
import pytest

from retropole.fleet.dataset import Row, partition_of, read_rows
from retropole.fleet.history.check import check_site, unanswered_check
from retropole.fleet.history.store import CheckRow
from retropole.fleet.process import Reader
from retropole.fleet.sites import FleetSite, find_sites
from retropole.fleet.work import Check, Hashed, Task, environment, failed

pytestmark = pytest.mark.full

TRIED = datetime(2026, 11, 2, 4, 0, tzinfo=UTC)
CHECK = Check(tolerance=(0.005, 0.03), tried=TRIED)


def checked(site: FleetSite, **options: object) -> CheckRow:
    row = check_site(site, msgspec.structs.replace(CHECK, **options))
    assert row is not None
    return row


@pytest.fixture(scope="module")
def answer(answers: str) -> Row:
    return read_rows(answers, partition_of("good"))["good"]


@pytest.fixture(scope="module")
def beside(fleet: Path, answer: Row, tmp_path_factory: pytest.TempPathFactory) -> FleetSite:
    """A pair with its stored result beside it."""
    folder = tmp_path_factory.mktemp("beside") / "good"
    shutil.copytree(fleet.parent / "good", folder)
    assert answer.document is not None
    (folder / "result.json").write_text(answer.document)
    (site,) = find_sites([str(folder.parent)])
    return site


def test_the_stored_result_may_lie_next_to_the_target(beside: FleetSite, answer: Row) -> None:
    told: list[Hashed] = []
    one = check_site(beside, CHECK, told.append)
    assert one is not None
    # Nothing was recorded since.
    assert (one.status, one.codes) == ("same", ("recordings_of_result",))
    assert one.is_usable
    # Recorded when its files were written.
    assert one.time.timestamp() == int(Path(beside.target).stat().st_mtime)
    ((key, inputs, stored),) = [(each.key, each.inputs, each.site_sha256) for each in told]
    assert (key, stored) == (one.key, one.stored_sha256)
    assert [each.sha256 for each in inputs] == [one.target_sha256, one.source_sha256]
    known = msgspec.structs.replace(CHECK, known=[one.key])
    assert check_site(beside, known) is None
    # From elsewhere it is the same check.
    away = msgspec.structs.replace(beside, result=f"{Path(beside.target).parent}")
    assert check_site(away, known) is None
    within = msgspec.structs.replace(known, document=answer.document)
    assert check_site(msgspec.structs.replace(beside, target=beside.target), within) is None


def test_a_time_that_is_given_counts(beside: FleetSite) -> None:
    site = msgspec.structs.replace(beside, time="2026-10-05T03:00:00+00:00", source="nothing.pcd")
    one = checked(site)
    assert (one.status, one.codes) == ("error", ("unreadable",))
    assert one.time == datetime(2026, 10, 5, 3, 0, tzinfo=UTC)


def test_each_fault_is_reported(beside: FleetSite, fleet: Path, tmp_path: Path) -> None:
    damaged = msgspec.structs.replace(beside, source=str(fleet.parent / "damaged.pcd"))
    assert checked(damaged, tried=TRIED).codes == ("unreadable",)
    absent = msgspec.structs.replace(beside, result=str(tmp_path / "nothing.json"))
    one = checked(absent)
    assert (one.status, one.codes, one.time) == ("error", ("unreadable",), TRIED)
    assert "there is no stored result" in (one.message or "")
    (tmp_path / "pose.csv").write_text("1,0,0,0\n0,1,0,0\n0,0,1,0\n0,0,0,1\n")
    bare = msgspec.structs.replace(beside, result=str(tmp_path / "pose.csv"))
    assert checked(bare).status in ("cannot_tell", "error")
    assert checked(bare).message


def test_the_other_way_round_is_no_movement(beside: FleetSite) -> None:
    swapped = msgspec.structs.replace(
        beside,
        target=beside.source,
        source=beside.target,
        result=str(Path(beside.target).parent / "result.json"),
    )
    one = checked(swapped)
    assert (one.status, one.codes, one.is_usable) == ("cannot_tell", ("swapped",), False)


def test_of_a_worker_that_died_what_is_known_is_kept(beside: FleetSite) -> None:
    one = unanswered_check(beside, CHECK, failed(beside, "error", "killed", "its process crashed"))
    assert (one.id, one.time, one.codes) == (beside.id, TRIED, ("killed",))
    assert one.message == "its process crashed"
    assert (one.stored_sha256, one.target_sha256) == ("", "")


def test_a_process_of_its_own_gives_the_same_row(beside: FleetSite) -> None:
    reader = Reader()
    task = Task(site=beside, check=CHECK, time_limit=300.0, environment=environment())
    try:
        outcome = reader.answer(task)
    finally:
        reader.close()
    assert outcome.row is None
    assert outcome.check == check_site(beside, CHECK)
