"""Slips of one morning: the wrong file, unit, order or sensor. Each is told, and what to do."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from retropole.base.datatypes import Array, PointCloud
from retropole.io import read_cloud, write_pcd
from retropole.result.decoding import decode
from retropole.simulation import simulate_pair
from tests.cli.commands import Done, retropole_here, transform_of

pytestmark = pytest.mark.full

Clouds = tuple[PointCloud, PointCloud]


def scaled(cloud: PointCloud, factor: float) -> PointCloud:
    return replace(cloud, xyz=cloud.xyz * factor, origin=cloud.origin * factor)


def calibrate(out: Path, *words: object) -> Done:
    return retropole_here("calibrate", *words, "--out", out)


def check_refused(done: Done, out: Path, code: str) -> str:
    """Check that it is refused with a code, which the result and its report say, too."""
    assert done.returncode == 3, done.stderr
    assert f"refused ({code})" in done.stderr
    (reason,) = decode((out / "result.json").read_bytes()).reasons
    assert reason.code == code
    assert "what to do" in done.stdout
    assert (out / "report.html").stat().st_size > 0
    return reason.message


@pytest.fixture(scope="module")
def millimetres(clouds: Clouds, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("millimetres")
    for k, cloud in enumerate(clouds):
        write_pcd(folder / f"{k}.pcd", scaled(cloud, 1000))
    return folder


@pytest.fixture(scope="module")
def in_millimetres(millimetres: Path) -> Path:
    out = millimetres / "out"
    done = calibrate(out, millimetres / "0.pcd", millimetres / "1.pcd", "--unit", "mm")
    assert done.returncode == 0, done.stderr
    return out


class TestTheSameTwice:
    def given_twice(self, scene: Path, folder: Path) -> dict[str, tuple[Path, Path]]:
        target = scene / "lidar0.pcd"
        front, copy = folder / "front", folder / "copy"
        front.mkdir()
        shutil.copy(target, front / "0.pcd")
        shutil.copytree(front, copy)
        return {
            "file": (target, target),
            "copy": (target, front / "0.pcd"),
            "folder": (front, front),
            "folder's copy": (front, copy),
            "folder of it": (target, front),
        }

    @pytest.mark.parametrize("kind", ["file", "copy", "folder", "folder's copy", "folder of it"])
    def test_for_both_sides(self, scene: Path, tmp_path: Path, kind: str) -> None:
        target, source = self.given_twice(scene, tmp_path)[kind]
        message = check_refused(
            calibrate(tmp_path / "out", target, source), tmp_path / "out", "same_recording"
        )
        same = "are both" if target == source else "one is a copy of the other"
        assert same in message
        assert "that of the other as SOURCE" in message

    def test_in_another_format(self, scene: Path, clouds: Clouds, tmp_path: Path) -> None:
        intensity = clouds[0].intensity
        assert intensity is not None
        np.save(tmp_path / "a.npy", np.column_stack([clouds[0].xyz, intensity]))
        done = calibrate(tmp_path / "out", scene / "lidar0.pcd", tmp_path / "a.npy")
        message = check_refused(done, tmp_path / "out", "same_recording")
        assert "100% of the points of one are, number for number, in the other" in message

    @pytest.mark.parametrize("again", [("lidar0", "other"), ("other", "copy"), ("copy", "other")])
    def test_among_placements(self, scene: Path, tmp_path: Path, again: tuple[str, str]) -> None:
        names = {"lidar0": scene / "lidar0.pcd", "other": scene / "truth.pcd"}
        names["copy"] = Path(shutil.copy(scene / "lidar1.pcd", tmp_path / "copy.pcd"))
        write_pcd(tmp_path / "other.pcd", PointCloud(np.ones((9, 3)), np.arange(9.0)))
        names["other"] = tmp_path / "other.pcd"
        first = ("--placement", scene / "lidar0.pcd", scene / "lidar1.pcd")
        done = calibrate(tmp_path / "out", *first, "--placement", names[again[0]], names[again[1]])
        message = check_refused(done, tmp_path / "out", "same_recording")
        assert "of placement 1" in message
        assert "of placement 2" in message
        assert "give each placement separate recordings" in message


class TestUnits:
    def test_info_says_what_the_unit_may_be(self, millimetres: Path) -> None:
        done = retropole_here("info", millimetres / "0.pcd")
        assert "they look like millimetres (11 m)" in done.stdout
        assert "read them with --unit mm" in done.stdout
        right = retropole_here("info", millimetres / "0.pcd", "--unit", "mm").stdout
        assert "look like" not in right
        assert "median 10.82 m" in right

    def test_feet_are_recognized_by_the_poles(self, dense: Path, tmp_path: Path) -> None:
        for k in (0, 1):
            cloud = read_cloud(dense / f"lidar{k}.pcd")
            write_pcd(tmp_path / f"{k}.pcd", scaled(cloud, 1 / 0.3048))
        files = tmp_path / "0.pcd", tmp_path / "1.pcd"
        done = retropole_here("info", files[1])
        assert "farther than a OS1 sees; read as feet it shows 2 poles" in done.stdout
        assert "read them with --unit ft, in this and every other command" in done.stdout
        message = check_refused(calibrate(tmp_path / "o", *files), tmp_path / "o", "too_few_poles")
        assert "(--unit ft), or the poles are" in message
        assert calibrate(tmp_path / "o", *files, "--unit", "ft").returncode == 0

    def test_calibrate_says_it_and_converts_nothing(
        self, millimetres: Path, tmp_path: Path
    ) -> None:
        done = calibrate(tmp_path, millimetres / "0.pcd", millimetres / "1.pcd")
        assert "read them with --unit mm" in check_refused(done, tmp_path, "wrong_unit")

    def test_detect_says_it(
        self, millimetres: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(
            "retropole.report.detection.draw_detection", lambda *args, **named: None
        )
        path = millimetres / "0.pcd"
        done = retropole_here("detect", path, "--out", tmp_path)
        assert "if they are, read them with --unit mm" in done.stderr
        done = retropole_here("detect", path, "--out", tmp_path, "--unit", "mm")
        assert done.stderr == ""
        assert "2 poles" in done.stdout

    def test_what_reads_the_inputs_again_knows_the_unit(
        self, millimetres: Path, in_millimetres: Path, truth: Array
    ) -> None:
        result = decode((in_millimetres / "result.json").read_bytes())
        assert (result.config.unit, result.config.unit_source) == ("mm", None)
        np.testing.assert_allclose(transform_of(in_millimetres), truth, atol=0.01)
        done = retropole_here("report", in_millimetres)
        assert (done.returncode, done.stderr) == (0, "")
        recordings = millimetres / "0.pcd", millimetres / "1.pcd"
        done = retropole_here("check", in_millimetres, *recordings)
        assert done.returncode == 0, done.stdout + done.stderr

    def test_one_of_the_two(
        self, scene: Path, millimetres: Path, truth: Array, tmp_path: Path
    ) -> None:
        recordings = scene / "lidar0.pcd", millimetres / "1.pcd"
        message = check_refused(calibrate(tmp_path, *recordings), tmp_path, "wrong_scale")
        assert "is the source in millimetres? Then read it with --unit m --unit mm" in message
        done = calibrate(tmp_path, *recordings, "--unit", "m", "--unit", "mm")
        assert done.returncode == 0, done.stderr
        np.testing.assert_allclose(transform_of(tmp_path), truth, atol=0.01)

    def test_a_unit_that_is_not_theirs(self, scene: Path, tmp_path: Path) -> None:
        done = calibrate(tmp_path, scene / "lidar0.pcd", scene / "lidar1.pcd", "--unit", "mm")
        message = check_refused(done, tmp_path, "wrong_unit")
        assert "the given unit is wrong" in message

    def test_las_in_map_coordinates(self, clouds: Clouds, tmp_path: Path) -> None:
        laspy = pytest.importorskip("laspy")
        for k, cloud in enumerate(clouds):
            las = laspy.create(point_format=3, file_version="1.2")
            las.header.scales, las.header.offsets = [0.001] * 3, [4e5, 5.2e6, 0]
            las.x, las.y, las.z = (cloud.xyz + np.array([4e5, 5.2e6, 100])).T
            las.intensity = cloud.intensity
            las.write(tmp_path / f"{k}.las")
        info = retropole_here("info", tmp_path / "0.las").stdout
        done = calibrate(tmp_path, tmp_path / "0.las", tmp_path / "1.las")
        message = check_refused(done, tmp_path, "far_from_lidar")
        for words in (info, message):
            assert (
                "a LAS file does not store where the LiDAR was, so that the origin of the beams "
                "is unknown" in words
            )
            assert "subtract the LiDAR's position from all points" in words


class TestSensors:
    def test_one_of_other_rings(self, scene: Path, tmp_path: Path) -> None:
        target = simulate_pair("corridor", np.random.default_rng(1), sensor_target="XT32").target
        write_pcd(tmp_path / "a.pcd", target)
        recordings = tmp_path / "a.pcd", scene / "lidar1.pcd"
        done = calibrate(tmp_path, *recordings, "--sensor", "VLP-16", "--sensor", "auto")
        message = check_refused(done, tmp_path, "wrong_sensor")
        assert "has 32 rings, the VLP-16 has 16: name the sensor that recorded it, XT32" in message


def test_target_and_source_swapped_in_check(
    scene: Path, clouds: Clouds, in_millimetres: Path, millimetres: Path, tmp_path: Path
) -> None:
    done = retropole_here("check", in_millimetres, millimetres / "1.pcd", millimetres / "0.pcd")
    assert done.returncode == 3
    assert "TARGET and SOURCE are swapped: RESULT was computed from these files" in done.stdout
    assert "exchange them" in done.stdout
    assert "moved" not in done.stdout
    # It is told before the clouds are read: of these, nothing is said of their unit or size.
    assert done.stderr == ""
    # New recordings are told by the stored pose, which then fits reversed.
    for k, cloud in enumerate(clouds):
        write_pcd(tmp_path / f"{k}.pcd", recorded_again(cloud, k))
    words = "check", in_millimetres, tmp_path / "1.pcd", tmp_path / "0.pcd", "--unit", "m"
    done = retropole_here(*words, "--json")
    answer = json.loads(done.stdout)
    assert (done.returncode, answer["status"]) == (3, "cannot_tell")
    assert [reason["code"] for reason in answer["reasons"]] == ["swapped"]
    assert answer["T_target_source"] is None


def recorded_again(cloud: PointCloud, seed: int) -> PointCloud:
    """Measure the same points again, with other noise along the beams."""
    rng = np.random.default_rng(seed)
    ray = cloud.xyz - cloud.origin
    ray /= np.linalg.norm(ray, axis=1)[:, None]
    return replace(cloud, xyz=cloud.xyz + 0.01 * rng.normal(size=(len(ray), 1)) * ray)
