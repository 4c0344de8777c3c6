"""``retropole export`` as a user runs it."""

import json
from pathlib import Path

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.bounded import Status
from retropole.base.datatypes import Array
from retropole.export import FORMATS, Transform, read_transform
from retropole.export.transform import from_rpy
from retropole.result import ReasonDoc
from tests import results
from tests.cli.commands import Done, retropole_here
from tests.export.test_export import ROUNDING

T = se3.random(np.random.default_rng(1))


def export(*words: object) -> Done:
    return retropole_here("export", *words)


def write_result(folder: Path, status: Status = "ok", pose: Array | None = None) -> Path:
    reasons = [] if status == "ok" else [ReasonDoc("weak_geometry", "sigma is 0.2 m", {})]
    covariance = None if pose is None else np.diag([1.0, 2, 3, 4, 5, 6])
    return results.write_result(folder, status, reasons, pose, covariance)


def read_back(text: str, folder: Path, fmt: str) -> tuple[Array, str, str]:
    path = folder / f"back.{fmt}"
    path.write_text(text)
    back = read_transform(path, fmt=fmt)
    return back.T_parent_child, back.parent, back.child


@pytest.mark.parametrize("fmt", FORMATS)
def test_export_and_its_inverse(fmt: str, tmp_path: Path) -> None:
    result = write_result(tmp_path, pose=T)
    done = export(tmp_path, "--to", fmt, "--parent", "front", "--child", "rear")
    assert done.returncode == 0
    assert done.stderr == ""
    T_back, *names = read_back(done.stdout, tmp_path, fmt)
    np.testing.assert_allclose(T_back, T, rtol=0, atol=10 * ROUNDING.get(fmt, 1e-10))
    assert names == ["front", "rear"]
    inverted = export(result, "--to", fmt, "--parent", "front", "--child", "rear", "--invert")
    T_inverted, *names = read_back(inverted.stdout, tmp_path, fmt)
    np.testing.assert_allclose(
        T_inverted @ T, np.eye(4), rtol=0, atol=10 * ROUNDING.get(fmt, 1e-10)
    )
    assert names == ["rear", "front"]


def test_one_format_into_another_through_files(tmp_path: Path) -> None:
    source: Path = write_result(tmp_path, pose=T)
    for fmt in FORMATS:
        out = tmp_path / "new" / f"x_{fmt}"
        assert export(source, "--to", fmt, "--out", out).returncode == 0
        source = out
    np.testing.assert_allclose(
        read_transform(source).T_parent_child, T, rtol=0, atol=ROUNDING["livox"]
    )


def test_a_refused_result_exits_with_3_and_writes_nothing(tmp_path: Path) -> None:
    path = write_result(tmp_path, "refused")
    done = export(path, "--to", "json", "--out", tmp_path / "out.json")
    assert done.returncode == 3
    assert "refused (weak_geometry)" in done.stderr
    assert "sigma is 0.2 m" in done.stderr
    assert not (tmp_path / "out.json").exists()


def test_a_warning_is_reported_on_stderr_alone(tmp_path: Path) -> None:
    path = write_result(tmp_path, "warn", T)
    done = export(path, "--to", "json")
    assert done.returncode == 0
    assert "warning (weak_geometry): sigma is 0.2 m" in done.stderr
    document = json.loads(done.stdout)
    assert np.diag(document["covariance"]).tolist() == [4, 5, 6, 1, 2, 3]


def test_the_truth_of_a_simulation_is_read(tmp_path: Path) -> None:
    path = tmp_path / "truth.json"
    document = {"T_target_source": T.tolist(), "target": "lidar0.pcd", "source": "lidar1.pcd"}
    path.write_text(json.dumps(document))
    back = read_transform(path)
    np.testing.assert_array_equal(back.T_parent_child, T)
    assert (back.parent, back.child) == ("target", "source")


def test_into_a_robot_in_place_or_elsewhere(tmp_path: Path) -> None:
    path = write_result(tmp_path, pose=T)
    robot = tmp_path / "robot.urdf"
    text = '<robot name="r">\r\n\t<link name="front"/>\r\n</robot>\r\n'
    robot.write_bytes(text.encode())
    robot.chmod(0o640)
    link = tmp_path / "link.urdf"
    link.symlink_to(robot)
    words = (path, "--into", link, "--parent", "front", "--child", "rear")
    other = tmp_path / "other.urdf"
    assert export(*words, "--out", other).returncode == 0
    assert robot.read_bytes() == text.encode()
    assert export(*words).returncode == 0
    assert robot.read_bytes() == other.read_bytes()
    assert link.is_symlink()
    assert robot.stat().st_mode & 0o777 == 0o640
    np.testing.assert_allclose(read_transform(robot).T_parent_child, T, rtol=0, atol=1e-9)


# --- on a robot ----------------------------------------------------------------------------------

TWO_ON_A_BASE = """<robot name="car">
  <link name="base_link"/><link name="front"/><link name="rear"/>
  <joint name="f" type="fixed"><parent link="base_link"/><child link="front"/>
    <origin xyz="1.0 0 1.5" rpy="0 0 0.5"/></joint>
  <joint name="r" type="fixed"><parent link="base_link"/><child link="rear"/>
    <origin xyz="-1.0 0 1.5" rpy="0 0 3.14"/></joint>
</robot>
"""
M = from_rpy(np.array([1.0, 0, 1.5]), np.array([0, 0, 0.5]))


@pytest.mark.parametrize("words", [(), ("--to", "urdf")])
def test_both_lidars_on_a_base(words: tuple[str, ...], tmp_path: Path) -> None:
    path, robot = write_result(tmp_path, pose=T), tmp_path / "robot.urdf"
    robot.write_text(TWO_ON_A_BASE)
    done = export(path, *words, "--into", robot, "--parent", "front", "--child", "rear")
    assert (done.returncode, done.stdout) == (0, "")
    assert "the joint from base_link to rear is changed by" in done.stderr
    back = read_transform(robot, parent="base_link", child="rear")
    np.testing.assert_allclose(back.T_parent_child, M @ T, rtol=0, atol=1e-9)
    again = export(path, *words, "--into", robot, "--parent", "front", "--child", "rear")
    assert "is changed by 0" in again.stderr


@pytest.mark.parametrize("fmt", [*FORMATS, "mcap", "into"])
@pytest.mark.parametrize("names", [("base_link", "rear"), ("front", "car/base_link")])
def test_no_format_takes_a_base_for_a_lidar(
    fmt: str, names: tuple[str, str], tmp_path: Path
) -> None:
    path, out = write_result(tmp_path, pose=T), tmp_path / "out"
    out.write_text(TWO_ON_A_BASE)
    where = ("--into", out) if fmt == "into" else ("--to", fmt, "--out", out)
    done = export(path, *where, "--parent", names[0], "--child", names[1])
    assert done.returncode == 2
    assert "is not the name of a LiDAR frame" in done.stderr
    assert out.read_text() == TWO_ON_A_BASE


@pytest.mark.parametrize("mounting", ["urdf", "yaml"])
@pytest.mark.parametrize("fmt", FORMATS)
def test_a_mounting_gives_the_pose_on_the_base(fmt: str, mounting: str, tmp_path: Path) -> None:
    path, file = write_result(tmp_path, pose=T), tmp_path / f"mounting.{mounting}"
    file.write_text(
        TWO_ON_A_BASE
        if mounting == "urdf"
        else FORMATS["yaml"].write(Transform(M, "base_link", "front"))
    )
    words = ("--to", fmt, "--mounting", file, "--child", "rear", "--parent", "front")
    done = export(path, *words)
    assert (done.returncode, done.stderr) == (0, "")
    back, *names = read_back(done.stdout, tmp_path, fmt)
    np.testing.assert_allclose(back, M @ T, rtol=0, atol=10 * ROUNDING.get(fmt, 1e-10))
    assert names == ["base_link", "rear"]
    back, *names = read_back(export(*(path, *words, "--invert")).stdout, tmp_path, fmt)
    np.testing.assert_allclose(back @ M @ T, np.eye(4), rtol=0, atol=10 * ROUNDING.get(fmt, 1e-10))
    assert names == ["rear", "base_link"]


def test_a_mounting_is_needed_once(tmp_path: Path) -> None:
    path, file = write_result(tmp_path, pose=T), tmp_path / "mounting.urdf"
    file.write_text(TWO_ON_A_BASE)
    for words, reason in (
        (("--into", file, "--mounting", file), "the robot file has it"),
        (("--to", "mcap", "--out", tmp_path / "x", "--mounting", file), "has only the LiDARs"),
        (("--to", "json", "--mounting", file), "2 transforms fit"),
        (("--to", "json", "--mounting", file, "--parent", "left"), "0 transforms fit"),
    ):
        done = export(path, *words)
        assert done.returncode == 2
        assert reason in done.stderr


def test_help_names_no_base_as_a_lidar() -> None:
    text = export("--help").stdout
    assert "--parent base_link" not in text
    assert "--mounting" in text


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        ((), "--to is needed"),
        (("--to", "toml"), "toml"),
        (("--to", "json", "--into", "robot.urdf"), "--into writes a joint"),
        (("--to", "json", "--parent", "a", "--child", "a"), "must differ"),
        (("--to", "json", "--from", "yaml"), "expected the YAML"),
        (("--into", "missing.urdf"), "missing.urdf"),
    ],
)
def test_bad_usage_says_why(words: tuple[str, ...], reason: str, tmp_path: Path) -> None:
    done = export(write_result(tmp_path, pose=T), *words)
    assert done.returncode == 2
    assert reason in done.stderr


def test_a_robot_without_the_parent_stays_as_it_is(tmp_path: Path) -> None:
    path = write_result(tmp_path, pose=T)
    robot = tmp_path / "robot.urdf"
    robot.write_text('<robot name="r"><link name="base"/></robot>')
    before = robot.read_bytes()
    done = export(path, "--into", robot)
    assert done.returncode == 2
    assert "no link 'target'" in done.stderr
    assert str(robot) in done.stderr
    assert robot.read_bytes() == before


def test_help_lists_every_format_with_examples() -> None:
    text = export("--help").stdout
    for name, each in FORMATS.items():
        assert f"\n    {name} " in text
        assert each.title in text
    assert text.count("retropole export ") >= 4
