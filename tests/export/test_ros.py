"""What ROS has of a transform: launch files in XML, and messages as they are echoed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.errors import ReadError
from retropole.export import Transform, read_transform
from retropole.export.transform import from_rpy

T = se3.random(np.random.default_rng(52))
RPY = se3.rpy_from_rotation(T[:3, :3])
PROGRAM = "static_transform_publisher"

XYZ = " ".join(map(str, T[:3, 3]))
YPR = " ".join(map(str, RPY[::-1]))
QUATERNION = " ".join(map(str, se3.quaternion_xyzw(T[:3, :3])))
FLAGS = " ".join(
    f"--{name} {value}"
    for name, value in zip(("x", "y", "z", "roll", "pitch", "yaw"), (*T[:3, 3], *RPY), strict=True)
)


def read(text: str, folder: Path, name: str = "t.launch", **names: str) -> Transform:
    path = folder / name
    path.write_text(text)
    return read_transform(path, **names)


# --- launch files --------------------------------------------------------------------------------

NODES = {
    "tf, angles": f'pkg="tf" type="{PROGRAM}" args="{XYZ} {YPR} front rear 100"',
    "tf, quaternion": f'pkg="tf" type="{PROGRAM}" args="{XYZ} {QUATERNION} front rear 100"',
    "tf2_ros, angles": f'pkg="tf2_ros" type="{PROGRAM}" args="{XYZ} {YPR} front rear"',
    "tf2_ros, quaternion": f'pkg="tf2_ros" type="{PROGRAM}" args="{XYZ} {QUATERNION} front rear"',
    "ROS 2, flags": f'pkg="tf2_ros" exec="{PROGRAM}" '
    f'args="{FLAGS} --frame-id front --child-frame-id rear"',
    "ROS 2, in order": f'pkg="tf2_ros" exec="{PROGRAM}" args="{XYZ} {YPR} front rear"',
}


@pytest.mark.parametrize("name", ["robot.launch", "robot.launch.xml", "robot"])
@pytest.mark.parametrize("what", NODES)
def test_a_launch_file_in_xml_has_its_publishers(what: str, name: str, tmp_path: Path) -> None:
    node = f'<node {NODES[what]} name="link1"/>'
    text = f'<?xml version="1.0"?>\n<!-- <robot/> -->\n<launch><group ns="a">{node}</group>\n'
    text += '<node pkg="rviz" type="rviz" name="rviz" args="-d x.rviz"/></launch>'
    back = read(text, tmp_path, name)
    np.testing.assert_allclose(back.T_parent_child, T, atol=1e-12)
    assert (back.parent, back.child) == ("front", "rear")


@pytest.mark.parametrize(
    ("node", "said"),
    [
        (f'pkg="tf" type="{PROGRAM}" args="{XYZ} {YPR} a b"', "9 or 10 arguments, this has 8"),
        (f'pkg="tf2_ros" type="{PROGRAM}" args="{XYZ} {QUATERNION} a b 100"', "8 or 9 arguments"),
        (f'pkg="tf" type="{PROGRAM}" args="$(arg x) 0 0 0 0 0 a b 100"', "contain $(…)"),
        (f'pkg="tf" type="{PROGRAM}" args="0 0 0 0 0 0 a \'b 100"', "No closing quotation"),
        (f'pkg="tf" type="{PROGRAM}"', "this has 0"),
        ('pkg="rviz" type="rviz"', "0 transforms fit"),
    ],
)
def test_what_a_launch_file_leaves_open_is_reported(node: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(ReadError) as refused:
        read(f'<launch><node {node} name="n"/></launch>', tmp_path)
    assert said in str(refused.value)


def test_the_yaw_comes_first(tmp_path: Path) -> None:
    args = "0.084 -0.131 -0.104 3.1336 0.2029 -1.5702 os1_lidar camera_frame 100"
    back = read(f'<launch><node pkg="tf" type="{PROGRAM}" args="{args}"/></launch>', tmp_path)
    expected = from_rpy(np.array([0.084, -0.131, -0.104]), np.array([-1.5702, 0.2029, 3.1336]))
    np.testing.assert_allclose(back.T_parent_child, expected, atol=1e-12)


# --- messages ------------------------------------------------------------------------------------


def stamped(parent: str, child: str, pose: np.ndarray, indent: str = "- ") -> str:
    """Write a TransformStamped as ``ros2 topic echo`` prints it."""
    t, q = pose[:3, 3], se3.quaternion_xyzw(pose[:3, :3])
    lines = ["header:", "  stamp:", "    sec: 1665789714", "    nanosec: 273191209"]
    lines += [f"  frame_id: {parent}", f"child_frame_id: {child}", "transform:", "  translation:"]
    lines += [f"    {name}: {value}" for name, value in zip("xyz", t, strict=True)]
    lines += ["  rotation:", *(f"    {n}: {v}" for n, v in zip("xyzw", q, strict=True))]
    return "\n".join(
        f"{indent if k == 0 else ' ' * len(indent)}{line}" for k, line in enumerate(lines)
    )


M = se3.random(np.random.default_rng(53))


@pytest.mark.parametrize("name", ["echo.yaml", "echo.txt"])
def test_an_echo_of_tf_static_is_read(name: str, tmp_path: Path) -> None:
    pytest.importorskip("yaml")
    text = f"transforms:\n{stamped('front', 'rear', T)}\n---\n"
    for echoed in (text, text * 2, f"{stamped('front', 'rear', T, '')}\n---\n"):
        back = read(echoed, tmp_path, name)
        np.testing.assert_allclose(back.T_parent_child, T, atol=1e-12)
        assert (back.parent, back.child) == ("front", "rear")


def test_both_lidars_on_a_base_are_read_over_it(tmp_path: Path) -> None:
    pytest.importorskip("yaml")
    messages = [stamped("base_link", "front", M), stamped("base_link", "rear", M @ T)]
    one = "transforms:\n" + "\n".join(messages) + "\n---\n"
    two = "".join(f"transforms:\n{each}\n---\n" for each in messages)
    for text in (one, two, two + two):
        back = read(text, tmp_path, "echo.yaml", parent="front", child="rear")
        np.testing.assert_allclose(back.T_parent_child, T, atol=1e-12)
    moved = two + two.replace(str(M[0, 3]), str(M[0, 3] + 1))
    with pytest.raises(ReadError, match="0 transforms fit"):
        read(moved, tmp_path, "echo.yaml", parent="front", child="rear")
    with pytest.raises(ReadError, match="2 transforms fit"):
        read(moved, tmp_path, "echo.yaml", child="front")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("transforms:\n- child_frame_id: a\n", "has no 'header'"),
        ("transforms: []\n---\n", "expected the YAML"),
        ("transforms:\n- header: {frame_id: [a]}\n  child_frame_id: b\n", "'transform'"),
        ("child_frame_id: a\nheader: 5\n", "expected the YAML"),
    ],
)
def test_half_a_message_is_reported(text: str, said: str, tmp_path: Path) -> None:
    pytest.importorskip("yaml")
    with pytest.raises(ReadError, match=said):
        read(text, tmp_path, "echo.yaml")


FAST_LIO = """
common: {lid_topic: "/livox/lidar", imu_topic: "/livox/imu"}
mapping:
    acc_cov: 0.1
    extrinsic_T: [1.5, -0.2, 0.1]
    extrinsic_R: [1, 0, 0, 0, 1, 0, 0, 0, 1]
"""


@pytest.mark.parametrize("names", [{}, {"parent": "mapping", "child": "extrinsic_T"}])
@pytest.mark.parametrize(
    "text", [FAST_LIO, "/**:\n  ros__parameters:\n" + FAST_LIO.replace("\n", "\n    ")]
)
def test_a_yaml_of_another_kind_is_named_once(
    text: str, names: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("yaml")
    # Of a long message, which a long path makes, the middle is left out.
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ReadError, match=r"parent: child: .*found .*FAST-LIO.*IMU"):
        read(text, Path(), "fastlio.yaml", **names)


def test_next_to_a_transform_other_keys_do_not_matter(tmp_path: Path) -> None:
    pytest.importorskip("yaml")
    text = f"{FAST_LIO}front:\n  rear: {{x: 1, y: 2, z: 3, roll: 0, pitch: 0, yaw: 0}}\n"
    assert read(text, tmp_path, "t.yaml").parent == "front"
