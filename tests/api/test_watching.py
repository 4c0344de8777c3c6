"""A watch of two LiDARs that are simulated, from the first sweep to the answer."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from benchmarks.again import record_again
from retropole.api import watching
from retropole.api.calibration import calibrate_with
from retropole.api.checking import read_stored
from retropole.api.result import CalibrationResult
from retropole.api.watching import Watch, Wish, names_of, open_sources
from retropole.base import se3
from retropole.base.datatypes import PointCloud
from retropole.base.errors import ReadError, UsageError
from retropole.export import Transform
from retropole.export.recording import Published
from retropole.io import Frame, read_frames
from retropole.io.fields import USUAL, Wanted
from retropole.result import InputDoc, RunConfig
from retropole.result.watching import WatchDoc
from retropole.simulation import SimulatedPair, place_again, simulate_pair
from tests.report.made_up import made_up

pytest.importorskip("mcap")


@dataclass
class Played:
    """Hands over the same few sweeps, and notes that it was closed."""

    name: str
    clouds: list[PointCloud]
    frame_id: str = "lidar"
    waits_for: str = ""
    has_ended: bool = False
    fault: str = ""
    count: int = 0
    closed: bool = False
    pause: Callable[[int], bool] = field(default=lambda count: False)

    def newest(self, wait: float) -> Frame | None:
        self.count += 1
        if self.fault:
            raise ReadError(self.fault)
        if self.pause(self.count):
            return None
        cloud = self.clouds[self.count % len(self.clouds)]
        return Frame(self.count, cloud, 1.7e9 + 0.2 * self.count, self.frame_id)

    def close(self) -> None:
        self.closed = True


class Clock:
    """Goes on by a fifth of a second with every step."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture(scope="module")
def pair() -> SimulatedPair:
    return simulate_pair(
        "street", np.random.default_rng(3), sensor_target="XT32", sensor_source="VLP-16"
    )


@pytest.fixture(scope="module")
def sweeps(pair: SimulatedPair) -> list[list[PointCloud]]:
    again = [record_again(pair, np.random.default_rng(k)) for k in range(3)]
    return [[each.target for each in again], [each.source for each in again]]


def watch_of(
    sweeps: list[list[PointCloud]], wish: Wish, out: Path
) -> tuple[Watch, list[Played], Clock]:
    sources = [Played(n, own, f"{n}_frame") for n, own in zip(wish.names, sweeps, strict=True)]
    clock = Clock()
    return Watch(sources, wish, out, clock), sources, clock


@pytest.fixture(scope="module")
def answer(sweeps: list[list[PointCloud]]) -> CalibrationResult:
    """The answer of one sweep each."""
    target, source = (own[0] for own in sweeps)
    return calibrate_with(target, source, RunConfig())


@pytest.fixture
def answered(monkeypatch: pytest.MonkeyPatch, answer: CalibrationResult) -> None:
    """Give it without working it out, where it is not what a test is about."""
    monkeypatch.setattr("retropole.api.watching.calibrate_with", lambda *given: answer)


def go_on(
    watch: Watch, clock: Clock, until: Callable[[WatchDoc], bool], seconds: float = 60.0
) -> list[WatchDoc]:
    """Step until something is said, and wait for what is worked out."""
    said: list[WatchDoc] = []
    start = clock.now
    while not said or not until(said[-1]):
        said.append(watch.step())
        clock.now += 0.2
        assert clock.now < start + seconds, said[-1].next
        if said[-1].phase == "calibrating":
            clock.now -= 0.2
            time.sleep(0.02)
    return said


WISH = Wish(RunConfig(), ("front", "rear"), sweeps=5)


@pytest.mark.full
def test_good_poles_are_kept_and_calibrated(
    pair: SimulatedPair, sweeps: list[list[PointCloud]], tmp_path: Path
) -> None:
    watch, sources, clock = watch_of(sweeps, WISH, tmp_path)
    said = go_on(watch, clock, lambda doc: doc.phase == "done")
    codes = list(dict.fromkeys(doc.code for doc in said))
    assert codes == ["settling", "good", "calibrating", "done"]
    assert watch.is_over
    assert watch.result is not None
    assert watch.result.T_target_source is not None
    step = se3.local(watch.result.T_target_source, pair.T_target_source)
    assert np.linalg.norm(step[3:]) < 0.02
    last = said[-1]
    assert last.status == "ok"
    assert last.probability is not None
    assert last.probability > 0.95
    assert [len(each.poles) for each in last.lidars] == [2, 2]
    capturing = [doc for doc in said if doc.phase == "capturing"]
    assert capturing[-1].lidars[0].sweeps_per_s == pytest.approx(5.0)
    assert {doc.captured for doc in said} >= {0, 1, 2, 3}
    written = watch.finish()
    assert all(each.closed for each in sources)
    assert {each.name for each in written} >= {"placement1.mcap", "result.json", "report.html"}
    kept = list(read_frames(tmp_path / "placement1.mcap", topic="/source/points"))
    assert len(kept) >= 5
    assert kept[0].frame_id == "rear_frame"
    assert any(np.allclose(kept[0].cloud.xyz[:5], own.xyz[:5], atol=1e-6) for own in sweeps[1])


@pytest.mark.full
def test_both_lidars_exchanged_give_the_inverse(
    pair: SimulatedPair, sweeps: list[list[PointCloud]], tmp_path: Path
) -> None:
    watch, _, clock = watch_of(sweeps[::-1], WISH, tmp_path)
    go_on(watch, clock, lambda doc: doc.phase == "done")
    assert watch.result is not None
    assert watch.result.T_target_source is not None
    step = se3.local(watch.result.T_target_source, se3.inverse(pair.T_target_source))
    assert np.linalg.norm(step[3:]) < 0.02


@pytest.mark.full
def test_a_need_that_is_not_met_asks_for_another_placement(
    pair: SimulatedPair, sweeps: list[list[PointCloud]], tmp_path: Path
) -> None:
    wish = Wish(RunConfig(need_m=0.007, at_m=30.0), ("front", "rear"), sweeps=5)
    watch, sources, clock = watch_of(sweeps, wish, tmp_path)
    said = go_on(watch, clock, lambda doc: doc.code == "need_not_met")
    assert not said[-1].is_good
    assert not watch.is_over
    # As long as the poles stand there, no other placement is kept.
    for _ in range(10):
        clock.now += 0.2
        assert watch.step().code == "need_not_met"
    assert [path.name for path in tmp_path.glob("*.mcap")] == ["placement1.mcap"]
    other = place_again(pair, np.random.default_rng(5))
    for source, cloud in zip(sources, (other.target, other.source), strict=True):
        source.clouds = [cloud]
    said = go_on(watch, clock, lambda doc: doc.placements == 2 and doc.code == "need_not_met")
    assert "Placement 3" in said[-1].next
    assert (tmp_path / "placement2.mcap").exists()
    assert watch.result is not None
    assert len(watch.result.document.inputs) == 4


@pytest.mark.full
def test_what_is_wrong_is_reported_and_it_goes_on(
    sweeps: list[list[PointCloud]], tmp_path: Path
) -> None:
    watch, (front, rear), clock = watch_of(sweeps, WISH, tmp_path)
    rear.fault = "message 3 of /rear: its fields contradict each other"
    said = go_on(watch, clock, lambda doc: clock.now > 2)
    assert said[-1].code == "unreadable"
    assert "contradict" in said[-1].next
    assert len([line for line in said[-1].words if "contradict" in line]) == 1
    rear.fault = ""
    go_on(watch, clock, lambda doc: doc.phase == "capturing")
    rear.pause, rear.waits_for = lambda count: True, "nobody publishes /rear"
    said = go_on(watch, clock, lambda doc: doc.code == "silent")
    assert "nobody publishes /rear" in said[-1].next
    assert said[-1].captured == 0
    rear.pause, rear.frame_id = lambda count: False, "another"
    said = go_on(watch, clock, lambda doc: doc.phase == "capturing")
    assert any("'another'" in line for line in said[-1].words)
    assert not front.closed


@pytest.mark.full
def test_what_was_begun_is_not_lost(sweeps: list[list[PointCloud]], tmp_path: Path) -> None:
    watch, _, clock = watch_of(sweeps, WISH, tmp_path)
    go_on(watch, clock, lambda doc: doc.captured > 1)
    (written,) = watch.finish()
    assert len(list(read_frames(written, topic="/target/points"))) > 1


@pytest.mark.full
def test_recordings_that_end_are_calibrated_by_what_there_was(
    sweeps: list[list[PointCloud]], tmp_path: Path
) -> None:
    watch, sources, clock = watch_of(sweeps, WISH, tmp_path)
    go_on(watch, clock, lambda doc: doc.captured > 1)
    for source in sources:
        source.has_ended, source.pause = True, lambda count: True
    go_on(watch, clock, lambda doc: doc.phase == "done")
    assert watch.result is not None
    nothing, sources, clock = watch_of(sweeps, WISH, tmp_path / "other")
    for source in sources:
        source.has_ended, source.pause = True, lambda count: True
    assert nothing.step().code == "ended"
    assert nothing.is_over


@pytest.mark.full
def test_a_rig_is_checked_against_its_result(
    sweeps: list[list[PointCloud]], tmp_path: Path
) -> None:
    watch, _, clock = watch_of(sweeps, WISH, tmp_path / "first")
    go_on(watch, clock, lambda doc: doc.phase == "done")
    watch.finish()
    stored = read_stored(tmp_path / "first")
    again, _, clock = watch_of(
        sweeps, Wish(RunConfig(), ("front", "rear"), sweeps=5, stored=stored), tmp_path / "then"
    )
    said = go_on(again, clock, lambda doc: doc.phase == "done")
    assert said[-1].status in ("same", "cannot_tell")
    assert again.checked is not None


@pytest.mark.full
def test_recordings_of_a_watch_before_are_kept(
    sweeps: list[list[PointCloud]], tmp_path: Path
) -> None:
    (tmp_path / "placement1.mcap").write_bytes(b"before")
    watch, _, clock = watch_of(sweeps, WISH, tmp_path)
    go_on(watch, clock, lambda doc: doc.captured > 1)
    (written,) = watch.finish()
    assert written.name == "placement2.mcap"
    assert (tmp_path / "placement1.mcap").read_bytes() == b"before"


@pytest.mark.full
def test_where_there_is_no_room_sweeps_stay_and_are_written_when_there_is(
    sweeps: list[list[PointCloud]], tmp_path: Path, answered: None
) -> None:
    # A folder that is no folder has no room; what lies in the way is taken away.
    out = tmp_path / "out"
    out.write_bytes(b"")
    watch, sources, clock = watch_of(sweeps, WISH, out)
    said = go_on(watch, clock, lambda doc: doc.code == "not_written")
    assert not said[-1].is_good
    assert f"{out}" in said[-1].next
    assert "Free disk space: 15 sweeps are kept in memory" in said[-1].next
    # Whatever is seen meanwhile.
    for source in sources:
        source.pause = lambda count: True
    said = go_on(watch, clock, lambda doc: doc.seconds > said[-1].seconds + 4)
    assert {doc.code for doc in said} == {"not_written"}
    assert len([words for words in said[-1].words if "Free disk space" in words]) == 1
    out.unlink()
    go_on(watch, clock, lambda doc: doc.phase == "done", 120)
    assert [path.name for path in out.glob("*.mcap")] == ["placement1.mcap"]
    assert watch.result is not None
    assert watch.result.status == "ok"


@pytest.mark.full
def test_a_result_that_cannot_be_written_is_written_later(
    sweeps: list[list[PointCloud]], tmp_path: Path, answered: None
) -> None:
    watch, _, clock = watch_of(sweeps, WISH, tmp_path)
    (tmp_path / "result.json").mkdir()
    said = go_on(watch, clock, lambda doc: doc.code == "not_written")
    assert "the result is kept in memory" in said[-1].next
    (tmp_path / "result.json").rmdir()
    clock.now += 6.0
    go_on(watch, clock, lambda doc: doc.phase == "done")
    assert (tmp_path / "result.json").is_file()


@pytest.mark.full
def test_what_can_never_be_written_is_an_error_that_says_what_is_lost(
    sweeps: list[list[PointCloud]], tmp_path: Path, answered: None
) -> None:
    (tmp_path / "out").write_bytes(b"")
    watch, sources, clock = watch_of(sweeps, WISH, tmp_path / "out")
    go_on(watch, clock, lambda doc: doc.code == "not_written")
    with pytest.raises(OSError, match="15 sweeps of each LiDAR are lost"):
        watch.finish()
    assert all(each.closed for each in sources)


@pytest.mark.full
def test_another_recording_in_the_place_of_what_was_captured_is_left_out(
    sweeps: list[list[PointCloud]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    answer: CalibrationResult,
) -> None:
    module = "retropole.api.watching"

    def swapped(target: object, source: object, config: RunConfig) -> CalibrationResult:
        if isinstance(target, list):
            # It is there before anything is read, and is a sound one.
            target[0].write_bytes(target[0].read_bytes() + b" ")
        return answer

    monkeypatch.setattr(f"{module}.calibrate_with", swapped)
    watch, _, clock = watch_of(sweeps, WISH, tmp_path)
    said = go_on(watch, clock, lambda doc: any("left out" in words for words in doc.words))
    assert "placement1.mcap is left out: it has changed since it was recorded" in said[-1].words[-1]
    assert watch.result is None
    used = list[Path]()

    def noted(target: object, source: object, config: RunConfig) -> CalibrationResult:
        used.extend(target if isinstance(target, list) else ())
        return answer

    monkeypatch.setattr(f"{module}.calibrate_with", noted)
    go_on(watch, clock, lambda doc: doc.phase == "done")
    assert watch.result is answer
    assert [each.name for each in used] == ["placement2.mcap"]


@pytest.mark.full
def test_sweeps_of_another_origin_join_no_placement_that_is_kept(
    sweeps: list[list[PointCloud]], tmp_path: Path, answered: None
) -> None:
    wish = Wish(RunConfig(need_m=0.0001, at_m=30.0), ("front", "rear"), sweeps=5)
    watch, (front, _), clock = watch_of(sweeps, wish, tmp_path)
    go_on(watch, clock, lambda doc: doc.placements == 1 and doc.phase != "calibrating")
    front.frame_id = "other" * 300
    said = go_on(watch, clock, lambda doc: doc.code == "unreadable")
    assert "'otherother" in said[-1].next
    assert "the stored ones from frame 'front_frame'" in said[-1].next
    assert all(len(words) < 400 for words in said[-1].words)
    front.frame_id = "front_frame"
    go_on(watch, clock, lambda doc: doc.code != "unreadable")


def test_sources_are_opened_by_their_names(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="not a source"):
        open_sources(["front.pcd", "folder:x"])
    with pytest.raises(UsageError, match="two sources"):
        open_sources([f"folder:{tmp_path}"] * 2)
    with pytest.raises(UsageError, match="not a port"):
        open_sources(["velodyne:abc", f"folder:{tmp_path}"])
    with pytest.raises(UsageError, match="metadata"):
        open_sources(["ouster:7502", f"folder:{tmp_path}"])
    (tmp_path / "a").mkdir()
    first, second = open_sources([f"folder:{tmp_path}", f"folder:{tmp_path / 'a'}"])
    assert first.newest(0.0) is None
    first.close()
    second.close()


def test_sources_read_the_field_and_the_angles_that_are_wanted(tmp_path: Path) -> None:
    for name in ("front", "rear"):
        np.savez(tmp_path / f"{name}.npz", xyz=np.eye(3), intensity=np.ones(3), echo=np.arange(3.0))
    texts = [f"replay:{tmp_path / name}.npz" for name in ("front", "rear")]
    read = []
    for source in open_sources(texts, wanted=(Wanted("echo"), USUAL)):
        frame = source.newest(1.0)
        assert frame is not None
        read.append(frame.cloud.intensity)
        source.close()
    np.testing.assert_array_equal(read, [[0, 1, 2], [1, 1, 1]])
    unit = Wanted(angles="unit.csv")
    for named, wanted, fault in (
        (texts, unit, "has no packets"),
        (
            [f"folder:{tmp_path}", "hesai:2368"],
            unit,
            "angles can be given for packets of hesai, robosense",
        ),
        (["hesai:2368", f"folder:{tmp_path}"], Wanted("echo"), "packets have one intensity"),
    ):
        with pytest.raises(UsageError, match=fault):
            open_sources(named, wanted=(wanted, USUAL))


def test_names_come_from_topics() -> None:
    other = "target", "source"
    assert names_of(["ros2:/front/points", "ros2:/rear/points"], other) == ("front", "rear")
    assert names_of(["ros2:/lidar/a", "bag:x.mcap:/lidar/b"], other) == ("a", "b")
    assert names_of(["velodyne:2368", "velodyne:2369"], other) == other
    assert names_of(["folder:in/front", "replay:in/rear.bag"], other) == ("front", "rear")
    assert names_of(["ros2:/points", "ros2:/points"], other) == other
    assert names_of(["folder:.", "folder:.."], other) == other
    assert names_of(["folder:/", "folder:./a"], other) == ("/", "a")


# --- the frames of what is published -------------------------------------------------------------


@pytest.mark.parametrize(
    ("frames", "said"),
    [
        (("", "rear"), "the sweeps of front have no frame_id"),
        (("front", ""), "the sweeps of rear have no frame_id"),
        (("lidar", "lidar"), "both LiDARs name the frame 'lidar'"),
        (("front\nlidar", "rear"), "not a valid name for the parent frame"),
        (("front", "x" * 501), "501 characters"),
    ],
)
def test_frames_that_cannot_be_published_are_found_before_the_work(
    frames: tuple[str, str], said: str, sweeps: list[list[PointCloud]], tmp_path: Path
) -> None:
    watch, sources, _ = watch_of(sweeps, WISH, tmp_path)
    for source, frame in zip(sources, frames, strict=True):
        source.frame_id = frame
    assert watch.frames() is None
    watch.step()
    with pytest.raises(UsageError) as refused:
        watch.frames()
    assert said in str(refused.value)
    assert not list(tmp_path.iterdir())


def test_an_answer_is_published_in_its_frames_and_withdrawn(
    sweeps: list[list[PointCloud]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent = []

    def publish(transforms: Sequence[Transform], **where: object) -> Published:
        sent.extend([(each.parent, each.child) for each in transforms])
        return Published(object())

    monkeypatch.setattr(watching, "publish", publish)
    watch, sources, _ = watch_of(sweeps, WISH, tmp_path)
    watch.step()
    names = watch.frames()
    assert names == ("front_frame", "rear_frame")
    inputs = [InputDoc("a", "0" * 64, 1, 0, "auto", None, frame_id=each) for each in names]
    document = replace(made_up("ok", 400).result, inputs=inputs)
    watch.result = CalibrationResult(document, None, None)
    watch.publish()
    first = watch.published
    assert sent == [names]
    assert first is not None
    watch.publish()
    assert first.writer is None
    second = watch.published
    assert second is not None
    watch.withdraw()
    assert second.writer is None
    assert watch.published is None
    # The driver has another frame now: what was calibrated fits its sweeps no longer.
    sources[1].frame_id = "back"
    watch.step()
    watch.publish()
    assert sent == [names, names]
    assert watch.published is None
    words = " ".join(watch.step().words)
    assert "withdrawn from /tf_static" in words
    assert "not published: the sweeps have other frames now" in words
