"""Every export reads back as the transform that went in; what is no transform is refused."""

import ast
import json
import math
import shlex
import sys
import types
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.base.errors import MissingExtraError, ReadError, Refusal, RetropoleError, UsageError
from retropole.export import FORMATS, Transform, export_lines, inverted, read_transform
from retropole.export.documents import write_json
from retropole.export.transform import (
    choose,
    covariance_from_ros,
    covariance_to_ros,
    from_rpy,
    number,
)
from retropole.result import ReasonDoc
from tests.results import write_result
from tests.tiers import first_of

NAMES = ["base link", "it's", 'a "quoted" name', "<script>alert(1)</script>", "$(rm -rf ~); `x`"]
NAMES += [
    "a--b -->",
    "x]y[z",
    "yes",
    "1e3",
    "maps points of b into a; parent: a, child: b",
    "#no comment",
    "sp äher",
    "a//b",
]
NAMES += ["lidar-top", "/front/lidar", "--x", "{{y}}", "\\n"]


def rotation(axis: Array, angle: float) -> Array:
    return np.asarray(Rotation.from_rotvec(np.asarray(axis) * angle).as_matrix())


def product_of_axes(rpy: Array) -> Array:
    """Rz(yaw) Ry(pitch) Rx(roll), written out."""
    x, y, z = np.eye(3)
    return rotation(z, rpy[2]) @ rotation(y, rpy[1]) @ rotation(x, rpy[0])


angles = st.floats(-math.pi, math.pi)
tiny = st.one_of(st.just(0.0), st.floats(-10, 0).map(lambda e: 10 ** (1.6 * e)))
units = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array).filter(lambda v: np.linalg.norm(v) > 0.1)
any_turn = st.builds(lambda v, a: rotation(v / np.linalg.norm(v), a), units, angles)
half_turn = st.builds(
    lambda v, e: rotation(v / np.linalg.norm(v), math.pi - e),
    st.one_of(units, st.sampled_from(list(np.eye(3)))),
    tiny,
)
gimbal_lock = st.builds(
    lambda r, side, e, y: product_of_axes(np.array([r, side * (math.pi / 2 - e), y])),
    angles,
    st.sampled_from([-1, 1]),
    tiny,
    angles,
)
poses = st.builds(
    lambda R, t: se3.from_rt(R, np.array(t)),
    st.one_of(any_turn, half_turn, gimbal_lock),
    st.tuples(*[st.floats(-1e4, 1e4, allow_subnormal=False)] * 3),
)
names = st.one_of(st.sampled_from(NAMES), st.text(min_size=1, max_size=12)).filter(
    lambda name: bool(name.strip()) and name.isprintable()
)


ROUNDING = {"livox": 5.0001e-4}
"""Metres by which a format rounds: Livox's driver takes whole millimetres."""


@pytest.mark.parametrize("fmt", FORMATS)
@settings(max_examples=60, deadline=None)
@given(T=poses, parent=names, child=names)
@pytest.mark.full
def test_every_export_reads_back_in_both_directions(
    fmt: str, T: Array, parent: str, child: str
) -> None:
    if parent == child:
        return
    transform = Transform(T, parent, child)
    for each in (transform, inverted(transform)):
        back = choose(FORMATS[fmt].read(FORMATS[fmt].write(each).encode()), None, None)
        atol = ROUNDING.get(fmt, 1e-9)
        np.testing.assert_allclose(back.T_parent_child, each.T_parent_child, rtol=0, atol=atol)
        assert (back.parent, back.child) == (each.parent, each.child)
    np.testing.assert_allclose(
        inverted(transform).T_parent_child @ T, np.eye(4), rtol=0, atol=1e-9 + 1e-12 * abs(T).max()
    )


@pytest.mark.parametrize("suffixed", [True, False])
@pytest.mark.parametrize("fmt", FORMATS)
def test_the_format_is_recognized_by_suffix_or_content(
    fmt: str, suffixed: bool, tmp_path: Path
) -> None:
    suffix = {"json": ".json", "yaml": ".yaml", "urdf": ".urdf", "launch": ".py"}.get(fmt, ".txt")
    path = tmp_path / f"x{suffix if suffixed else ''}"
    T = se3.random(np.random.default_rng(1))
    path.write_text(export_lines(T, "static_transform_publisher", "b")[fmt])
    back = read_transform(path)
    np.testing.assert_allclose(back.T_parent_child, T, rtol=0, atol=ROUNDING.get(fmt, 1e-9))
    assert (back.parent, back.child) == ("static_transform_publisher", "b")


@pytest.mark.parametrize("fmt", FORMATS)
def test_every_output_says_in_words_what_it_maps(fmt: str) -> None:
    transform = Transform(np.eye(4), "front_lidar", "rear_lidar")
    words = "maps points of rear_lidar into front_lidar; parent: front_lidar, child: rear_lidar"
    assert words in FORMATS[fmt].write(transform)


@settings(max_examples=300, deadline=None)
@given(R=st.one_of(any_turn, half_turn, gimbal_lock))
@pytest.mark.full
def test_rpy_is_about_fixed_axes_x_y_z_also_in_gimbal_lock(R: Array) -> None:
    rpy = se3.rpy_from_rotation(R)
    np.testing.assert_allclose(product_of_axes(rpy), R, rtol=0, atol=1e-14)
    np.testing.assert_allclose(from_rpy(np.zeros(3), rpy)[:3, :3], R, rtol=0, atol=1e-14)


@given(value=st.floats(allow_nan=False, allow_infinity=False))
@pytest.mark.full
def test_numbers_read_back_the_same_in_yaml_too(value: float) -> None:
    yaml = pytest.importorskip("yaml")
    assert float(number(value)) == value
    assert yaml.safe_load(number(value)) == value


def test_yaml_is_laid_out_as_autoware_has_it() -> None:
    yaml = pytest.importorskip("yaml")
    T = from_rpy(np.array([1e-7, 0, 1.4]), np.array([0, 1e-9, -math.pi / 2]))
    text = export_lines(T, "base_link", "sensor_kit_base_link")["yaml"]
    pose = yaml.safe_load(text)["base_link"]["sensor_kit_base_link"]
    assert list(pose) == ["x", "y", "z", "roll", "pitch", "yaw"]
    assert pose["yaw"] == pytest.approx(-math.pi / 2, abs=1e-12)
    assert all(isinstance(value, float) for value in pose.values())


def test_reading_yaml_names_the_extra_it_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "yaml", None)
    with pytest.raises(MissingExtraError, match=r"retropole\[yaml\]"):
        FORMATS["yaml"].read(b"a: {}")


@pytest.mark.parametrize("fmt", FORMATS)
def test_files_saved_on_windows_are_read(fmt: str, tmp_path: Path) -> None:
    path = tmp_path / "x"
    text = "\ufeff" + export_lines(np.eye(4), "a", "b")[fmt].replace("\n", "\r\n")
    path.write_bytes(text.encode())
    back = read_transform(path)
    np.testing.assert_array_equal(back.T_parent_child, np.eye(4))
    assert (back.parent, back.child) == ("a", "b")


def test_a_yaml_of_many_sensors_gives_the_one_that_is_named(tmp_path: Path) -> None:
    pytest.importorskip("yaml")
    path = tmp_path / "sensors_calibration.yaml"
    path.write_text(
        "base_link:\n  kit: {x: 1, y: 2.0, z: 1e-3, roll: 0, pitch: 0.0, yaw: 0.1}  # flow\n"
        "  'lidar': {x: 0, y: 0, z: 3, roll: 0, pitch: 0, yaw: 0}\n"
    )
    with pytest.raises(ReadError, match=r"2 transforms fit.*base_link -> kit, base_link -> lidar"):
        read_transform(path)
    kit = read_transform(path, parent="base_link", child="kit")
    np.testing.assert_allclose(kit.T_parent_child[:3, 3], [1, 2, 1e-3])
    np.testing.assert_allclose(se3.log_so3(kit.T_parent_child[:3, :3]), [0, 0, 0.1], atol=1e-12)
    with pytest.raises(ReadError, match="0 transforms fit kit -> base_link"):
        read_transform(path, parent="kit", child="base_link")
    path.write_text("a:\n  b: {x: 1, x: 2, y: 0, z: 0, roll: 0, pitch: 0, yaw: 0}\n")
    with pytest.raises(ReadError, match="twice"):
        read_transform(path)


# --- ROS -----------------------------------------------------------------------------------------


def tf2_ros1(words: list[str]) -> tuple[Array, str, str]:
    """Read arguments in tf2_ros's documented order: x y z qx qy qz qw frame_id child_frame_id."""
    x, y, z, qx, qy, qz, qw = map(float, words[:7])
    (frame_id, child_frame_id) = words[7:]
    return se3.from_rt(rotation_of(qw, qx, qy, qz), np.array([x, y, z])), frame_id, child_frame_id


def rotation_of(w: float, x: float, y: float, z: float) -> Array:
    """Rotation matrix of a unit quaternion, term by term."""
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def tf2_ros2(words: list[str]) -> tuple[Array, str, str]:
    """Read the flags that ``static_transform_publisher --help`` of ROS 2 lists."""
    flags = dict(zip(words[::2], words[1::2], strict=True))
    order = ["--x", "--y", "--z", "--qx", "--qy", "--qz", "--qw", "--frame-id", "--child-frame-id"]
    assert sorted(flags) == sorted(order)
    return tf2_ros1([flags[name] for name in order])


@pytest.mark.parametrize("child", [*NAMES, "plain"])
def test_publisher_lines_have_the_order_of_tf2_and_survive_a_shell(child: str) -> None:
    T = se3.random(np.random.default_rng(3))
    lines = export_lines(T, "a parent", child)
    for fmt, prefix, read in (
        ("ros1", ["rosrun", "tf2_ros"], tf2_ros1),
        ("ros2", ["ros2", "run", "tf2_ros"], tf2_ros2),
    ):
        words = shlex.split(lines[fmt].splitlines()[-1])
        assert words[: len(prefix) + 1] == [*prefix, "static_transform_publisher"]
        T_read, frame_id, child_frame_id = read(words[len(prefix) + 1 :])
        np.testing.assert_allclose(T_read, T, rtol=0, atol=1e-12)
        assert (frame_id, child_frame_id) == ("a parent", child)


@pytest.mark.parametrize("child", [*NAMES, "plain"])
def test_the_launch_file_runs_and_hands_over_the_arguments(
    child: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    launch, launch_ros, actions = (
        types.ModuleType(name) for name in ("launch", "launch_ros", "launch_ros.actions")
    )
    launch.LaunchDescription = list  # type: ignore[attr-defined]
    actions.Node = dict  # type: ignore[attr-defined]
    for module in (launch, launch_ros, actions):
        monkeypatch.setitem(sys.modules, module.__name__, module)
    T = se3.random(np.random.default_rng(4))
    scope: dict[str, object] = {}
    exec(compile(export_lines(T, "a parent", child)["launch"], "x.launch.py", "exec"), scope)
    (node,) = scope["generate_launch_description"]()  # type: ignore[operator]
    assert (node["package"], node["executable"]) == ("tf2_ros", "static_transform_publisher")
    T_read, frame_id, child_frame_id = tf2_ros2(node["arguments"])
    np.testing.assert_allclose(T_read, T, rtol=0, atol=1e-12)
    assert (frame_id, child_frame_id) == ("a parent", child)


@pytest.mark.parametrize(
    "line",
    [
        "ros2 run tf2_ros static_transform_publisher --yaw 0.3 --frame-id a --child-frame-id b "
        "--x 2",
        "ros2 run tf2_ros static_transform_publisher \\\n 2 0 0 0.3 0 0 a b",
        "rosrun tf2_ros static_transform_publisher 2 0 0 0.3 0 0 a b  # yaw pitch roll",
    ],
)
def test_lines_that_others_wrote_are_read(line: str, tmp_path: Path) -> None:
    path = tmp_path / "publish.sh"
    path.write_text(f"#!/bin/sh\n{line}\n")
    back = read_transform(path)
    expected = se3.from_rt(rotation(np.array([0, 0, 1]), 0.3), np.array([2.0, 0, 0]))
    np.testing.assert_allclose(back.T_parent_child, expected, atol=1e-12)
    assert (back.parent, back.child) == ("a", "b")


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("rosrun tf static_transform_publisher 0 0 0 0 0 0 a b 100", "period"),
        ("rosrun tf2_ros static_transform_publisher 0 0 0 0 0 0 a", "8 or 9 arguments"),
        ("rosrun tf2_ros static_transform_publisher 0 0 0 0 0 0 0.9 a b", "norm 0.9"),
        ("rosrun tf2_ros static_transform_publisher 0 0 nan 0 0 0 1 a b", "finite"),
        ("ros2 run tf2_ros static_transform_publisher --x 1 --frame-id a", "child-frame-id"),
        (
            "ros2 run tf2_ros static_transform_publisher --qw 1 --yaw 1 --frame-id a "
            "--child-frame-id b",
            "quaternion and",
        ),
    ],
)
def test_lines_that_say_no_pose_are_refused(line: str, reason: str, tmp_path: Path) -> None:
    path = tmp_path / "publish.sh"
    path.write_text(line)
    with pytest.raises(ReadError, match=reason):
        read_transform(path)


def test_reading_a_launch_file_runs_nothing(tmp_path: Path) -> None:
    path = tmp_path / "x.launch.py"
    text = export_lines(np.eye(4))["launch"]
    path.write_text(f"raise SystemExit\n{text}")
    assert read_transform(path).parent == "target"
    path.write_text(text.replace("'0.0'", "str(0)", 1))
    with pytest.raises(ReadError, match="not plain strings"):
        read_transform(path)
    assert ast.parse(text)


NODE = "Node(executable='static_transform_publisher', arguments={})"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a" + ".b" * 9000, "no Python launch file"),
        ("not " * 9000 + "a", "no Python launch file"),
        (NODE.format("-" * 9000 + "1"), "no Python launch file"),
        (NODE.format("5"), "not plain strings"),
        (NODE.format("None"), "not plain strings"),
        (NODE.format("{[]: 1}"), "not plain strings"),
    ],
)
def test_a_launch_file_may_be_anything(text: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / "x.launch.py"
    path.write_text(text)
    with pytest.raises(ReadError, match=said):
        read_transform(path)


# --- CloudCompare --------------------------------------------------------------------------------


def test_cloudcompare_takes_it_pasted_and_from_a_file() -> None:
    T = se3.random(np.random.default_rng(5))
    text = export_lines(T, "x]y", "z[w")["cloudcompare"]
    note = text[text.index("[") :]
    assert note.count("[") == 1
    assert note.rstrip().index("]") == len(note.rstrip()) - 1
    for numbers in (text.replace(note, "").split(), text.split()[:16]):
        np.testing.assert_array_equal(np.array(numbers, float).reshape(4, 4), T)


# --- covariance ----------------------------------------------------------------------------------


def sampled_covariance(T: Array, covariance: Array, rng: np.random.Generator) -> Array:
    """Spread of the inverse's chart when the transform spreads by a covariance."""
    steps = rng.multivariate_normal(np.zeros(6), covariance, 6000)
    back = se3.inverse(T)
    moved = [se3.local(back, se3.inverse(se3.retract(T, step))) for step in steps]
    return np.cov(np.array(moved), rowvar=False)


def test_the_covariance_of_the_inverse_is_that_of_samples() -> None:
    rng = np.random.default_rng(6)
    T = se3.random(rng)
    A = rng.normal(size=(6, 6)) * 1e-3
    C = A @ A.T
    backward = inverted(Transform(T, "a", "b", C))
    assert backward.covariance is not None
    expected = sampled_covariance(T, C, rng)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(backward.covariance / scale, expected / scale, atol=0.08)
    twice = inverted(backward)
    assert twice.covariance is not None
    np.testing.assert_allclose(twice.covariance, C, atol=1e-15)
    assert twice.roles == ("target", "source")


def test_ros_puts_translation_first() -> None:
    C = np.diag([1.0, 2, 3, 40, 50, 60])
    C[0, 3] = C[3, 0] = 7.0  # φ_x with δ_x
    ros = covariance_to_ros(C)
    assert np.diag(ros).tolist() == [40, 50, 60, 1, 2, 3]
    assert ros[0, 3] == 7
    np.testing.assert_array_equal(covariance_from_ros(ros), C)


def test_json_holds_the_covariance_and_its_order(tmp_path: Path) -> None:
    C = np.diag([1.0, 2, 3, 4, 5, 6])
    path = tmp_path / "x.json"
    for transform in (
        Transform(np.eye(4), "a", "b", C),
        inverted(Transform(np.eye(4), "a", "b", C)),
    ):
        path.write_text(FORMATS["json"].write(transform))
        document = json.loads(path.read_text())
        assert f"T_{'_'.join(transform.roles)}" in document
        assert document["covariance_order"] == ["x", "y", "z", "rot_x", "rot_y", "rot_z"]
        back = read_transform(path)
        assert back.covariance is not None
        assert transform.covariance is not None
        np.testing.assert_allclose(back.covariance, transform.covariance)
        assert back.roles == transform.roles
    document["covariance_order"].reverse()
    path.write_text(json.dumps(document))
    with pytest.raises(ReadError, match="covariance_order"):
        read_transform(path)


# --- refusals ------------------------------------------------------------------------------------

R90 = [[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


@pytest.mark.parametrize(
    ("place", "value", "reason"),
    [
        ((2, 2), -1, "determinant is -1"),
        ((2, 2), 1.01, "determinant is 1.01"),
        ((0, 3), float("nan"), "1 entries not finite"),
        ((0, 3), float("inf"), "1 entries not finite"),
        ((3, 0), 0.5, "last row"),
    ],
)
def test_what_is_not_rigid_is_refused_in_numbers(
    place: tuple[int, int], value: float, reason: str, tmp_path: Path
) -> None:
    matrix = np.array(R90, dtype=float)
    matrix[place] = value
    path = tmp_path / "m.txt"
    np.savetxt(path, matrix)
    with pytest.raises(ReadError, match=reason):
        read_transform(path)
    with pytest.raises(ReadError, match=reason):
        export_lines(matrix)


def test_rounding_is_taken_and_made_rigid(tmp_path: Path) -> None:
    T = se3.random(np.random.default_rng(7))
    path = tmp_path / "m.txt"
    np.savetxt(path, T, fmt="%.6f")
    back = read_transform(path, parent="a", child="b")
    np.testing.assert_allclose(back.T_parent_child, T, atol=1e-6)
    R = back.T_parent_child[:3, :3]
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-14)
    assert (back.parent, back.child) == ("a", "b")


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("a.txt", "1 2 3", "16 numbers, this has 3"),
        ("a.txt", "", "16 numbers, this has 0"),
        ("a.txt", "one " * 16, "'one' is not a number"),
        ("a.txt", "x: 1\ny: 1\nz: 1\nqw: 1\n", "expected x y z and qx"),
        ("a.txt", "x: 1\nx: 2\nyaw: 0\n", "one line"),
        ("a.json", "[1]", "not an object"),
        ("a.json", "{", "no JSON"),
        ("a.json", "{}", "found 0"),
        ("a.json", '{"T_target_source": "x"}', "not a transform"),
        ("a.json", '{"T_target_source": [[1, 0], [0, 1]]}', "instead of"),
        ("a.json", '{"schema": "retropole/result/1"}', "no result document"),
        ("a.yaml", "a: 1", "expected the YAML"),
        ("a.yaml", "a: [", "no YAML"),
        ("a.yaml", "", "expected the YAML"),
        ("a.py", "def", "no Python"),
        ("a.py", "x = 1", "0 transforms fit"),
        ("a.urdf", "<robot", "no well-formed XML"),
        ("a.urdf", "<sdf/>", "root element is <sdf>"),
        ("a.urdf", "<!DOCTYPE robot [<!ENTITY a 'b'>]><robot name='&a;'/>", "DOCTYPE"),
        ("a.bin", b"\xff\x00\x93", "no text"),
    ],
)
def test_files_that_hold_no_transform_are_refused(
    name: str, content: str | bytes, reason: str, tmp_path: Path
) -> None:
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(ReadError, match=reason) as caught:
        read_transform(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("fmt", FORMATS)
@settings(max_examples=60, deadline=None)
@given(data=st.one_of(st.binary(max_size=80), st.text(max_size=80).map(str.encode)))
@pytest.mark.full
def test_readers_fail_with_a_reason_only(fmt: str, data: bytes) -> None:
    hold_reason(fmt, data)


def hold_reason(fmt: str, data: bytes) -> None:
    """Read data that may be anything: what is wrong is said, to its end."""
    reason = "none"
    try:
        choose(FORMATS[fmt].read(data), None, None)
    except UnicodeDecodeError:
        pass
    except RetropoleError as error:
        reason = str(error).strip()
    assert reason
    assert reason[-1] not in ":;,("
    assert "()" not in reason


HOSTILE = (
    *(b"-" * 40_000, b"not " * 40_000, b"[" * 40_000, b"(" * 40_000, b"{" * 40_000, b"<a>" * 9000),
    *(b"a:\n b:\n  x: 1", b"<robot/>", b"<launch/>", b"---\n---\n", b"\xef\xbb\xbf", b"\0" * 99),
    *(b"At time 0\n- Translation: []", b"Translation", b"Translation: [a, b, c]\n Quaternion []"),
    *(b"T_target_source\n1\n2\n3\n4", b"[[[[]]]]", b"transforms:\n- {header: {frame_id: a}}"),
    NODE.format("-" * 40_000).encode(),
)


@pytest.mark.parametrize("fmt", first_of(FORMATS, 4))
def test_no_hostile_file_gets_an_empty_reason(fmt: str) -> None:
    for data in HOSTILE:
        hold_reason(fmt, data)


def test_matrix_and_quaternion_in_one_file_must_agree(tmp_path: Path) -> None:
    document = json.loads(export_lines(np.eye(4))["json"])
    document["translation_m"]["x"] = 0.1
    path = tmp_path / "x.json"
    path.write_text(json.dumps(document))
    with pytest.raises(ReadError, match=r"differ by 0\.1"):
        read_transform(path)


@pytest.mark.parametrize("names", [("a", "a"), ("", "b"), ("a", "  "), ("a\nb", "c")])
def test_names_that_no_frame_can_have_are_refused(names: tuple[str, str]) -> None:
    with pytest.raises(UsageError):
        export_lines(np.eye(4), *names)


def test_an_unknown_format_is_named(tmp_path: Path) -> None:
    path = tmp_path / "x"
    path.write_text("x")
    with pytest.raises(UsageError, match="no format 'toml'"):
        read_transform(path, fmt="toml")


def test_a_refused_result_holds_no_transform(tmp_path: Path) -> None:
    reasons = [ReasonDoc("too_few_poles", "1 pole, 2 are needed", {"poles": 1})]
    path = write_result(tmp_path, "refused", reasons)
    for place in (path, tmp_path):
        with pytest.raises(Refusal, match="1 pole, 2 are needed") as caught:
            read_transform(place)
        assert caught.value.code == "too_few_poles"
    write_result(tmp_path, "refused", reasons, np.eye(4), np.eye(6))
    with pytest.raises(ReadError, match="the status is refused"):
        read_transform(tmp_path)
    write_result(tmp_path, "warn", reasons, np.eye(4), np.eye(6))
    back = read_transform(tmp_path, parent="a")
    assert (back.parent, back.child) == ("a", "source")
    np.testing.assert_array_equal(back.covariance, np.eye(6))


@pytest.mark.parametrize(
    "bomb",
    [
        b"a: &a {b: {x: 1}}\nc: *a\n",
        b"a: " + b"[" * 30_000,
        b"? " * 20_000,
        b"a: 1\n" * 200_000,
        b"\xff\xfe\x00",
    ],
)
def test_a_yaml_that_would_take_long_is_an_error(bomb: bytes, tmp_path: Path) -> None:
    pytest.importorskip("yaml")
    path = tmp_path / "bomb.yaml"
    path.write_bytes(bomb)
    with pytest.raises(ReadError):
        read_transform(path)


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ({"T_target_source": np.diag([1e308, 1.0, 1.0, 1.0]).tolist()}, "beyond"),
        ({"T_target_source": [[10**400] * 4] * 4}, "transform"),
        ({"covariance": (-1e-4 * np.eye(6)).tolist()}, "negative"),
        ({"covariance": np.tri(6).tolist()}, "symmetric"),
        ({"covariance": (1e300 * np.eye(6)).tolist()}, "up to"),
        ({"covariance": (np.eye(6) + 2 * np.eye(6)[::-1]).tolist()}, "eigenvalue"),
        ({"covariance_order": [["x"]]}, "neither"),
    ],
)
def test_a_json_that_holds_no_transform_names_the_fault(
    fault: dict[str, object], message: str, tmp_path: Path
) -> None:
    document = json.loads(
        write_json(Transform(np.eye(4), "front", "rear", np.eye(6), ("target", "source")))
    )
    path = tmp_path / "edited.json"
    path.write_text(json.dumps(document | fault))
    with pytest.raises(ReadError, match=message):
        read_transform(path)
