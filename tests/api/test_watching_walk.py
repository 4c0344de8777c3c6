"""A watch of a walk: from the first sweep to the answer that `calibrate --carried` gives."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import retropole as rp
from benchmarks.carried import Walking, watched
from retropole.api import watching_walk
from retropole.api.simulation import simulate_walk
from retropole.api.watching import Wish
from retropole.api.watching_walk import Solution, WalkWatch
from retropole.base.datatypes import PointCloud
from retropole.base.errors import Refusal
from retropole.base.reasons import Code
from retropole.carried import track
from retropole.carried.guidance import Continuation
from retropole.planning.live_advice import ENOUGH
from retropole.result import RunConfig
from retropole.result.watching import WatchDoc

pytest.importorskip("mcap")

CONFIG = RunConfig(
    carried=True, sensor_target="VLP-16", sensor_source="VLP-16", need_m=0.1, at_m=30.0
)
WISH = Wish(CONFIG, ("front", "rear"))


class Seen:
    """A watch to its end: what was said, and how many sweeps were searched."""

    def __init__(self, out: Path) -> None:
        walk = simulate_walk("street", 2, frames=200)
        sources = [
            Walking(name, walk.record(k, np.random.default_rng([2, k])))
            for k, name in enumerate(WISH.names)
        ]
        self.out, self.searched = out, 0
        self.said: list[WatchDoc] = []
        with pytest.MonkeyPatch.context() as patch:
            search = track._poles_in

            def counted(*given: object) -> object:
                self.searched += 1
                return search(*given)  # type: ignore[arg-type]

            patch.setattr(track, "_poles_in", counted)
            for self.watch, said in watched(sources, WISH, out):
                self.said.append(said)


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> Seen:
    return Seen(tmp_path_factory.mktemp("watch"))


@pytest.mark.full
def test_it_stops_by_itself_once_the_need_is_met_and_not_before(seen: Seen) -> None:
    last = seen.said[-1]
    assert (last.code, last.phase, last.status) == ("done", "done", "ok")
    assert last.seconds < 19.0
    assert last.probability is not None
    assert last.probability >= ENOUGH
    walking = [each for each in seen.said if each.phase == "walking"]
    assert all(each.probability is None or each.probability < ENOUGH for each in walking)
    assert {each.name for each in seen.out.iterdir()} == {
        "walk1.mcap",
        "result.json",
        "report.html",
    }


@pytest.mark.full
def test_it_gives_what_calibrate_gives_of_the_recording_and_searches_each_sweep_once(
    seen: Seen,
) -> None:
    path, topics = seen.out / "walk1.mcap", ("/target/points", "/source/points")
    again = rp.calibrate(path, path, topic=topics, options=CONFIG)
    assert seen.watch.result is not None
    assert again.walk is not None
    assert np.array_equal(again.required_transform(), seen.watch.result.required_transform())
    assert np.array_equal(np.array(again.covariance), np.array(seen.watch.result.covariance))
    assert again.walk == seen.watch.result.walk or again.walk.path == seen.watch.result.walk.path  # type: ignore[union-attr]
    assert seen.searched == sum(again.walk.sweeps)


@pytest.mark.full
def test_the_way_is_shown_of_each_alone_then_of_both_and_the_error_falls(seen: Seen) -> None:
    walks = [each.walk for each in seen.said if each.walk is not None]
    last = walks[-1].charts[0]
    assert last.names == ["front", "rear"]
    target, source = (np.array(path) for path in last.paths)
    gaps = np.linalg.norm(target[:, None] - source, axis=2).min(axis=1)
    assert 0 < np.median(gaps) < 0.15
    bounds = [bound for _, bound in walks[-1].bounds]
    assert bounds[-1] <= min(bounds)
    assert 0 < bounds[-1] < 0.1
    guided = [each for each in seen.said if "after 5 s" in each.next]
    assert all(each.is_good for each in guided)


def cloud(number: int, *, times: bool = True) -> PointCloud:
    """Few points, none of a pole."""
    xyz = np.random.default_rng(number).normal((5.0, 0.0, 0.0), size=(40, 3))
    when = 0.1 * number + np.linspace(0, 0.09, 40) if times else None
    return PointCloud(xyz, np.arange(40.0), time=when)


def small(out: Path, *, times: bool = True, count: int = 60) -> list[WatchDoc]:
    """Watch sweeps without a pole."""
    clouds = [cloud(k, times=times) for k in range(count)]
    sources = [Walking("a", clouds), Walking("b", [replace(each) for each in clouds])]
    return [said for _, said in watched(sources, WISH, out)]


@pytest.mark.full
def test_without_a_pole_it_is_reported_who_sees_none(tmp_path: Path) -> None:
    said = small(tmp_path)
    assert said[40].code == "unseen"
    assert said[40].next.startswith("front sees no pole")
    assert said[-1].status == "refused"
    assert (tmp_path / "walk1.mcap").exists()


def test_without_times_it_is_reported_at_once(tmp_path: Path) -> None:
    said = small(tmp_path, times=False, count=30)
    assert said[25].code == "unreadable"
    assert "have no times" in said[25].next
    assert said[-1].code == "ended"
    assert not list(tmp_path.iterdir())


def test_where_there_is_no_room_it_is_reported_and_the_walk_begins_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path) -> None:
        raise OSError(28, "No space left on device", str(path))

    with monkeypatch.context() as patch:
        patch.setattr(watching_walk, "stream_atomically", full)
        said = small(tmp_path, count=40)
    assert said[25].code == "not_written"
    assert "Free disk space" in said[25].next
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("code", "begins_again"), [("two_walks", False), ("clock_jumps", True), (None, False)]
)
def test_what_is_wrong_goes_before_how_to_go_on(
    tmp_path: Path, code: Code | None, begins_again: bool
) -> None:
    sources = [Walking(name, map(cloud, range(60))) for name in "ab"]
    now = [0.0]
    watch = WalkWatch(sources, WISH, tmp_path, lambda: now[0])
    for _ in range(25):
        watch.step()
        now[0] += 0.05
    refusal = None if code is None else Refusal(code, "said why", {})
    steps = [Continuation("left", "Walk 3 m to the left.", 0.02)]
    watch._solution = Solution(refusal, None, steps, [], 9.0, 0.03, 0.07)
    one, none = np.zeros(1), np.zeros(1, dtype=np.int64)
    pole = track.Found(0, 0.0, np.ones(3), np.ones(3), np.ones((1, 3)), one, none, none > 0)
    for own in watch._walked:
        own.last = now[0], pole
    said = watch.step()
    assert said.is_good is (code is None)
    assert said.code == (code or "left")
    assert ("said why" in said.next) is (code is not None)
    assert (watch._solution is None) is begins_again
    watch.finish()
