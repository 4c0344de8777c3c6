"""All sites of a small fleet are checked: a row each, the same bytes whoever does the work."""

import shutil
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path

import fsspec
import numpy as np
import pytest

from retropole.base.errors import UsageError
from retropole.fleet.engine import connected, mapped, outcomes
from retropole.fleet.history import run
from retropole.fleet.history.run import changes_of, check_fleet, replay
from retropole.fleet.history.store import CheckRow, append, read
from retropole.fleet.sites import find_sites
from retropole.fleet.work import Outcome, Task, unanswered
from tests.fleet.fleets import here, in_disorder
from tests.fleet.history.checks import MOVED, SIGMA, row

pytestmark = pytest.mark.full

NOW = datetime(2026, 11, 2, 4, 0, tzinfo=UTC)

ENDS = {
    "good": ("same", ("recordings_of_result",)),
    "small/1": ("cannot_tell", ("too_few_poles",)),
    "yard": ("error", ("usage",)),
    "absent": ("error", ("usage",)),
    "slip": ("error", ("usage",)),
}


def files_of(history: Path) -> dict[str, bytes]:
    return {
        f"{path.relative_to(history)}": path.read_bytes() for path in history.rglob("*.parquet")
    }


def newest(history: str) -> dict[str, CheckRow]:
    return {name: rows[-1] for name, rows in read(history)}


@pytest.fixture(scope="module")
def checked(city: Path, answers: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """History of one run."""
    history = tmp_path_factory.mktemp("history")
    found = check_fleet(find_sites([str(city)]), str(history), here, answers=answers, now=NOW)
    assert (found.appended, len(found.sites)) == (8, 8)
    assert [site.id for site in found.sites if site.is_decided] == ["good"]
    assert not any(site.changes for site in found.sites)
    return history


def test_every_site_has_a_row(checked: Path) -> None:
    rows = newest(str(checked))
    for name, end in ENDS.items():
        assert (rows[name].status, rows[name].codes) == end
    good = rows["good"]
    assert good.time == datetime(2026, 11, 2, 3, 0, tzinfo=UTC)
    assert good.is_usable
    assert len(good.stored_sha256) == len(good.target_sha256) == 64
    assert "no pair with poles in common" in (rows["yard"].message or "")
    assert "not calibrated: unreadable" in (rows["damaged"].message or "")


def test_the_order_of_the_work_does_not_matter(
    checked: Path, city: Path, answers: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sites = find_sites([str(city)])
    check_fleet(sites[::-1], str(tmp_path), in_disorder(3), answers=answers, now=NOW)
    assert files_of(tmp_path) == files_of(checked)
    monkeypatch.setattr(run, "FLUSH", 3)
    few = [site for site in sites if site.id != "good"]
    for name, doing in (("a", here), ("b", in_disorder(5))):
        check_fleet(few, str(tmp_path / name), doing, answers=answers, now=NOW)
    assert files_of(tmp_path / "a") == files_of(tmp_path / "b")
    assert len(files_of(tmp_path / "a")) == 3


def test_two_workers_give_the_bytes_of_one_process(
    checked: Path, city: Path, answers: str, tmp_path: Path
) -> None:
    with connected(workers=2) as client:
        found = check_fleet(
            find_sites([str(city)]),
            str(tmp_path),
            lambda tasks: outcomes(client, tasks),
            answers=answers,
            now=NOW,
            replaying=partial(mapped, client),
        )
    assert [site.id for site in found.sites] == sorted(newest(str(checked)))
    assert [site.is_decided for site in found.sites].count(True) == 1
    assert files_of(tmp_path) == files_of(checked)


def test_the_same_again_adds_nothing_and_checks_nothing(
    checked: Path, city: Path, answers: str
) -> None:
    before = files_of(checked)
    done: list[Outcome] = []

    def noted(tasks: Iterator[Task]) -> Iterator[Outcome]:
        for outcome in here(tasks):
            done.append(outcome)
            yield outcome

    found = check_fleet(find_sites([str(city)]), str(checked), noted, answers=answers, now=NOW)
    assert found.appended == 0
    known = {"good", "small/1", "small/2", "small/3"}
    assert {each.id for each in done if each.check is None} == known
    assert next(site for site in found.sites if site.id == "good").is_decided
    assert files_of(checked) == before


def test_a_damaged_history_is_named_and_ends_nothing(
    checked: Path, city: Path, answers: str, tmp_path: Path
) -> None:
    history = tmp_path / "history"
    shutil.copytree(checked, history)
    append(str(history), [row(0, "good"), row(1, "good")])
    for bad in set(history.rglob("*.parquet")) - {history / name for name in files_of(checked)}:
        bad.write_bytes(bad.read_bytes()[:200])
    found = check_fleet(find_sites([str(city)]), str(history), here, answers=answers, now=NOW)
    assert len(found.sites) == 8
    assert [f"{bad}" in found.damaged[0] for _ in found.damaged] == [True]


def test_everything_may_be_in_an_object_store(city: Path, answers: str, checked: Path) -> None:
    memory = fsspec.filesystem("memory")
    memory.put(str(city.parent), "/town", recursive=True)
    memory.put(answers, "/town-answers", recursive=True)
    history = "memory://town-history"
    found = check_fleet(
        find_sites(["memory://town/tonight.csv"]),
        history,
        here,
        answers="memory://town-answers",
        now=NOW,
    )
    assert found.appended == 8
    near, far = newest(str(checked)), newest(history)
    assert near.keys() == far.keys()
    np.testing.assert_array_equal(near["good"].step, far["good"].step)
    for name, one in near.items():
        assert (one.status, one.codes, one.key) == (
            far[name].status,
            far[name].codes,
            far[name].key,
        )
        assert "/tmp" not in (far[name].message or "")


def test_whose_process_never_answers_has_a_row_too(
    city: Path, answers: str, tmp_path: Path
) -> None:
    def silent(tasks: Iterator[Task]) -> Iterator[Outcome]:
        for task in tasks:
            yield unanswered(task.site, "time_limit", "not done within 1 s")

    sites = [site for site in find_sites([str(city)]) if site.id in ("good", "small/2")]
    found = check_fleet(sites, str(tmp_path), silent, answers=answers, now=NOW)
    assert [(site.id, site.newest.codes) for site in found.sites] == [
        ("good", ("time_limit",)),
        ("small/2", ("time_limit",)),
    ]
    # Once it does answer, that counts.
    found = check_fleet(sites[:1], str(tmp_path), here, answers=answers, now=NOW)
    assert [site.is_decided for site in found.sites] == [True]


def test_an_interrupt_loses_no_check(city: Path, answers: str, tmp_path: Path) -> None:
    def interrupted(tasks: Iterator[Task]) -> Iterator[Outcome]:
        yield next(here(tasks))
        raise KeyboardInterrupt

    sites = [site for site in find_sites([str(city)]) if site.id.startswith("small")]
    with pytest.raises(KeyboardInterrupt):
        check_fleet(sites, str(tmp_path), interrupted, answers=answers, now=NOW)
    assert len(newest(str(tmp_path))) == 1


def test_an_interrupt_loses_no_fault_that_was_met(city: Path, answers: str, tmp_path: Path) -> None:
    def interrupted(tasks: Iterator[Task]) -> Iterator[Outcome]:
        yield from here(tasks)
        raise KeyboardInterrupt

    sites = [site for site in find_sites([str(city)]) if site.id in ("small/1", "slip", "absent")]
    with pytest.raises(KeyboardInterrupt):
        check_fleet(sites, str(tmp_path), interrupted, answers=answers, now=NOW)
    assert "small/1" in newest(str(tmp_path))
    assert len(newest(str(tmp_path))) > 1


def test_what_is_wrong_with_all_sites_is_no_row(city: Path, answers: str, tmp_path: Path) -> None:
    sites = find_sites([str(city)])
    with pytest.raises(UsageError, match="is not a dataset"):
        check_fleet(sites, str(tmp_path / "h"), here, answers=str(tmp_path))
    path = tmp_path / "sites.csv"
    path.write_text("id,target,source,result\na,t.pcd,s.pcd,result.json\n")
    with pytest.raises(UsageError, match="remove the column result"):
        check_fleet(find_sites([str(path)]), str(tmp_path / "h"), here, answers=answers)
    assert not (tmp_path / "h").exists()


def test_a_site_that_moved_stays_changed_until_it_is_calibrated_anew() -> None:
    rng = np.random.default_rng(0)
    rows = [row(k, step=SIGMA * rng.normal(size=6) + MOVED * (k >= 8)) for k in range(12)]
    seen = changes_of(rows[:10])
    (event,) = seen.changes
    assert (event.kind, seen.times[event.onset]) == ("step", rows[8].time)
    assert seen.is_new(event)
    later = changes_of(rows)
    assert [later.is_new(each) for each in later.changes] == [False]
    again = [row(k, stored_sha256="b", step=SIGMA) for k in range(12, 14)]
    assert not changes_of([*rows, *again]).changes


def test_a_failure_of_this_run_is_reported(tmp_path: Path) -> None:
    fine, failed = row(0), row(1, status="error", step=None, covariance=None, random=None)
    append(str(tmp_path), [fine, failed])
    ((_, rows),) = read(str(tmp_path))
    assert changes_of(rows).is_decided
    assert not changes_of(rows, failed).is_decided
    assert rows[1].time - rows[0].time == timedelta(days=7)


def test_a_replay_says_what_each_site_does_alone(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    for k in range(14):
        moved = MOVED * (k >= 9)
        append(str(tmp_path), [row(k, "b", step=SIGMA * rng.normal(size=6) + moved)])
        append(str(tmp_path), [row(k, "a"), row(k, "c", stored_sha256="xy"[k > 8])])
    found, damaged = replay(str(tmp_path))
    assert not damaged
    assert [site.id for site in found] == ["a", "b", "c"]
    for site, (_, rows) in zip(found, sorted(read(str(tmp_path))), strict=True):
        alone = changes_of(rows)
        assert site.times == alone.times
        assert [(one.kind, one.onset, one.found) for one in site.watched.events] == [
            (one.kind, one.onset, one.found) for one in alone.watched.events
        ]
    assert found[1].changes
    assert len(found[2].times) == 5
    some, _ = replay(str(tmp_path), ["b"])
    assert [site.id for site in some] == ["b"]
