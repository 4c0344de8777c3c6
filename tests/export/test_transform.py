"""Which transform of a file is meant, names of its frames, and where a LiDAR is mounted."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from retropole.base import se3
from retropole.base.errors import ReadError, UsageError
from retropole.export import (
    FORMATS,
    Transform,
    inverted,
    mounted,
    read_mounting,
    read_transform,
)
from retropole.export.documents import found_in_result
from retropole.export.transform import FULL_TURN, NO_LIDARS, Found, choose, from_rpy, way_between
from retropole.result import InputDoc, encode
from tests.export.test_export import ROUNDING
from tests.report.made_up import made_up

RNG = np.random.default_rng(52)
T = se3.random(RNG)


def found(*names: str) -> list[Found]:
    """Transforms with random poses between frames: ``base>front``."""
    out = []
    for k, name in enumerate(names):
        pose = se3.random(np.random.default_rng(k))
        parent, _, child = name.partition(">")
        out.append(Found(parent, child, partial(np.copy, pose)))
    return out


# --- over several transforms ---------------------------------------------------------------------


def test_the_way_over_a_base_is_both_ways_together() -> None:
    robot = found("base>mast", "mast>front", "base>rear", "rear>hood", "base>wheel")
    base_mast, mast_front, base_rear, rear_hood, _ = (each.pose() for each in robot)
    expected = se3.inverse(base_mast @ mast_front) @ base_rear @ rear_hood
    transform = choose(robot, "front", "hood")
    np.testing.assert_allclose(transform.T_parent_child, expected, atol=1e-12)
    assert (transform.parent, transform.child) == ("front", "hood")
    down = choose(robot, "base", "front")
    np.testing.assert_allclose(down.T_parent_child, base_mast @ mast_front, atol=1e-12)
    np.testing.assert_allclose(
        choose(robot, "hood", "front").T_parent_child, se3.inverse(expected), atol=1e-12
    )


@pytest.mark.parametrize(
    ("names", "why"),
    [
        (("front>rear",), "against the file"),
        (("base>rear", "other>front"), "two trees"),
        (("base>rear", "base>mast", "top>mast", "mast>front"), "two parents on the way"),
        (("front>a", "a>front", "base>rear"), "a circle"),
        (("a>b", "b>a"), "neither is there"),
    ],
)
def test_no_way_is_made_up(names: tuple[str, ...], why: str) -> None:
    with pytest.raises(ReadError, match="0 transforms fit rear -> front"):
        choose(found(*names), "rear", "front")


def test_a_way_up_has_no_steps_down() -> None:
    way = way_between(found("base>mast", "mast>front"), "front", "base")
    assert way is not None
    assert [len(steps) for steps in way] == [2, 0]


# --- angles --------------------------------------------------------------------------------------


@pytest.mark.parametrize("k", range(3))
@pytest.mark.parametrize("sign", [-1, 1])
def test_no_angle_is_beyond_a_full_turn(k: int, sign: int) -> None:
    rpy = np.zeros(3)
    rpy[k] = sign * 6.2832
    np.testing.assert_allclose(from_rpy(np.zeros(3), rpy), np.eye(4), atol=1e-4)
    for angle in (FULL_TURN * 1.001, 35.2843, 180.0, 1e300):
        rpy[k] = sign * angle
        with pytest.raises(ReadError, match=r"beyond 2π.*degrees.*roll_deg"):
            from_rpy(np.zeros(3), rpy)


PUBLISHER = "static_transform_publisher"
IN_DEGREES = {
    "rpy": ("x: 0\ny: 0\nz: 1\nroll: 0\npitch: 0\nyaw: {}\n", "t.txt"),
    "yaml": ("front: {{rear: {{x: 0, y: 0, z: 1, roll: 0, pitch: 0, yaw: {}}}}}", "t.yaml"),
    "urdf": (
        "<robot name='r'><joint name='j' type='fixed'><parent link='a'/><child link='b'/>"
        "<origin rpy='0 0 {}'/></joint></robot>",
        "t.urdf",
    ),
    "ros1": (f"rosrun tf2_ros {PUBLISHER} 0 0 1 {{}} 0 0 a b", "t.sh"),
    "ros2": (f"ros2 run tf2_ros {PUBLISHER} --yaw {{}} --frame-id a --child-frame-id b", "t.sh"),
    "launch": (
        f"Node(executable='{PUBLISHER}', arguments=['0', '0', '1', '{{}}', '0', '0', 'a', 'b'])",
        "t.py",
    ),
    "rslidar": ("x: 0\ny: 0\nz: 1\nroll: 0\npitch: 0\nyaw: {}\n", "t.txt"),
    "hesai": ("transform_flag: true\nx: 0\ny: 0\nz: 1\nroll: 0\npitch: 0\nyaw: {}\n", "t.txt"),
    "ROS 1 launch": (
        f"<launch><node pkg='tf' type='{PUBLISHER}' args='0 0 1 {{}} 0 0 a b 100'/></launch>",
        "t.launch",
    ),
}
"""Every format that has angles in radians."""


def test_every_format_of_angles_is_known_here() -> None:
    angled = {name for name, each in FORMATS.items() if "yaw" in each.write(Transform(T, "a", "b"))}
    assert angled - {"livox"} <= {*IN_DEGREES}


@pytest.mark.parametrize("fmt", IN_DEGREES)
def test_no_format_takes_degrees_for_radians(fmt: str, tmp_path: Path) -> None:
    pattern, name = IN_DEGREES[fmt]
    path = tmp_path / name
    for angle in ("35.2843", "-7.6617", "180"):
        path.write_text(pattern.format(angle))
        with pytest.raises(ReadError, match="degrees"):
            read_transform(path)


# --- the frames of LiDARs ------------------------------------------------------------------------


def with_frames(*frames: str) -> bytes:
    """Encode a result whose recordings name these frames, target and source in turn."""
    result = made_up("ok", 400).result
    inputs = [InputDoc("a.mcap", "0" * 64, 1, 0, "auto", None, frame_id=each) for each in frames]
    return encode(replace(result, inputs=inputs))


@pytest.mark.parametrize("name", sorted(NO_LIDARS))
def test_a_lidar_is_not_named_as_a_robot_s_base(name: str, tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    path.write_bytes(with_frames("", ""))
    for given in (name, f"car/{name}"):
        for names in ({"parent": given}, {"child": given}):
            with pytest.raises(UsageError, match=r"is not the name of a LiDAR frame.*--mounting"):
                read_transform(path, **names)
    assert read_transform(path, parent=f"{name}_lidar", child="rear").parent == f"{name}_lidar"
    # What a file of another program is of is for that program to say.
    path = tmp_path / "matrix.txt"
    path.write_text("1 0 0 1  0 1 0 2  0 0 1 3  0 0 0 1")
    assert read_transform(path, parent=name, child="front").parent == name


@pytest.mark.parametrize(
    ("frames", "names"),
    [
        (("front", "rear"), ("front", "rear")),
        (("front", "rear", "front", "rear"), ("front", "rear")),
        (("base_link", "rear"), ("base_link", "rear")),
        (("front", "rear", "front", "back"), (None, None)),
        (("lidar", "lidar"), (None, None)),
        (("front", ""), (None, None)),
        (("front", "a\u202eb"), (None, None)),
        ((), (None, None)),
    ],
)
def test_a_result_has_the_frames_of_its_recordings(
    frames: tuple[str, ...], names: tuple[str | None, str | None], tmp_path: Path
) -> None:
    path = tmp_path / "result.json"
    path.write_bytes(with_frames(*frames))
    default = names if names[0] else ("target", "source")
    transform = read_transform(path)
    assert (transform.parent, transform.child) == default
    if names[0]:
        with pytest.raises(ReadError, match="0 transforms fit chassis"):
            read_transform(path, parent="chassis")
    else:
        assert read_transform(path, parent="left").parent == "left"


def test_a_name_that_no_frame_can_have_is_none_of_a_result() -> None:
    result = made_up("ok", 400).result
    inputs = [InputDoc("a", "0" * 64, 1, 0, "auto", None, frame_id=f) for f in ("a\nb", "c")]
    assert found_in_result(replace(result, inputs=inputs))[:2] == (None, None)


# --- mountings -----------------------------------------------------------------------------------


def test_a_mounting_comes_before_the_transform_and_turns_its_covariance() -> None:
    A = RNG.normal(size=(6, 6)) * 1e-3
    C, M = A @ A.T, se3.random(RNG)
    there = mounted(Transform(T, "front", "rear", C), Transform(M, "base_link", "front"))
    assert (there.parent, there.child, there.roles) == ("base_link", "rear", ("parent", "child"))
    np.testing.assert_allclose(there.T_parent_child, M @ T, atol=1e-12)
    steps = RNG.multivariate_normal(np.zeros(6), C, 4000)
    moved = np.array([se3.local(M @ T, M @ se3.retract(T, step)) for step in steps])
    assert there.covariance is not None
    spread, scale = np.cov(moved, rowvar=False), np.sqrt(np.diag(there.covariance))
    np.testing.assert_allclose(
        spread / np.outer(scale, scale), there.covariance / np.outer(scale, scale), atol=0.1
    )


@pytest.mark.parametrize("fmt", FORMATS)
def test_every_format_takes_and_gives_a_mounting(fmt: str, tmp_path: Path) -> None:
    M = se3.random(RNG)
    path = tmp_path / "mounting"
    path.write_text(FORMATS[fmt].write(Transform(M, "base_link", "front")))
    for target in ("front", None):
        base = read_mounting(path, target)
        np.testing.assert_allclose(base.T_parent_child, M, atol=ROUNDING.get(fmt, 1e-9))
    with pytest.raises(ReadError, match="0 transforms fit"):
        read_mounting(path, "left")
    there = mounted(Transform(T, "front", "rear"), base)
    path.write_text(FORMATS[fmt].write(there))
    for each, back in (
        (there, read_transform(path, parent="base_link", child="rear")),
        (inverted(there), inverted(read_transform(path))),
    ):
        atol = 2 * ROUNDING.get(fmt, 1e-9)
        np.testing.assert_allclose(back.T_parent_child, each.T_parent_child, atol=atol)
        assert (back.parent, back.child) == (each.parent, each.child)
    assert "T_target_source" not in path.read_text()


def test_a_mounting_names_its_frames(tmp_path: Path) -> None:
    path = tmp_path / "mounting.txt"
    np.savetxt(path, np.eye(4))
    with pytest.raises(UsageError, match=r"mounting\.txt: does not give the names of the frames"):
        read_mounting(path, "front")
