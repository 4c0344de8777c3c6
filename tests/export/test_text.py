"""Transforms as people and libraries print them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.base.errors import ReadError, UsageError
from retropole.export import Transform, export_lines, read_transform
from retropole.export.transform import from_rpy
from retropole.report.text import describe_result
from tests.report.made_up import made_up

T = se3.random(np.random.default_rng(52))


def read(text: str, folder: Path, name: str = "t.txt") -> Transform:
    path = folder / name
    path.write_text(text)
    return read_transform(path)


def with_decimals(T: Array, precision: int) -> str:
    with np.printoptions(precision=precision, suppress=True):
        return str(T)


PRINTED = {
    "str": str(T),
    "repr": repr(T),
    "list": str(T.tolist()),
    "suppressed": with_decimals(T, 6),
    "float32": repr(T.astype(np.float32)),
    "scientific": np.array2string(T, formatter={"float": "{:.9e}".format}),
    "csv": "\n".join(",".join(map(str, row)) for row in T.tolist()),
    "semicolons": "[" + "; ".join(" ".join(map(str, row)) for row in T.tolist()) + "];",
    "rows in brackets": "\n".join(f"  [ {' '.join(f'{v:.8f}' for v in row)} ]" for row in T),
    "np.array": f"np.array({T.tolist()})  # T_front_rear",
}


@pytest.mark.parametrize("how", PRINTED)
def test_a_matrix_is_read_as_libraries_print_it(how: str, tmp_path: Path) -> None:
    np.testing.assert_allclose(read(PRINTED[how], tmp_path).T_parent_child, T, atol=2e-6)


@pytest.mark.parametrize("verbose", [False, True])
def test_what_calibrate_prints_is_read_back(verbose: bool, tmp_path: Path) -> None:
    result = made_up("ok", 400).result
    text = describe_result(result, ["result.json"], verbose=verbose)
    assert "T_target_source" in text
    transform = read(text, tmp_path)
    assert result.T_target_source is not None
    np.testing.assert_allclose(transform.T_parent_child, result.T_target_source, atol=1e-8)
    with pytest.raises(UsageError, match="not the name of a LiDAR"):
        read_transform(tmp_path / "t.txt", parent="base_link")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("1.5 0 0 0 0 0.3", "this has 6; a pose of 6 or 7 numbers is read if each has a name"),
        ("[[1, 0], [0, 1]]", "16 numbers, this has 4"),
        ("[[nan 0 0 0]\n [0 1 0 0]\n [0 0 1 0]\n [0 0 0 1]]", "1 entries not finite"),
        ("translation x 0.0 y 1.0", "'translation'|16 numbers"),
    ],
)
def test_what_is_no_matrix_is_counted(text: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(ReadError, match=said):
        read(text, tmp_path)


# --- the unit of angles --------------------------------------------------------------------------

RPY = np.array([0.3, -0.2, 1.1])


def named(values: Array, unit: str = "", comment: str = "") -> str:
    names = ("x", "y", "z", *(f"{name}{unit}" for name in ("roll", "pitch", "yaw")))
    lines = (f"{n}: {v}" for n, v in zip(names, [1.0, 2.0, 3.0, *values], strict=True))
    return "\n".join([comment, *lines])


@pytest.mark.parametrize(
    "text",
    [
        named(np.degrees(RPY), "_deg"),
        named(np.degrees(RPY), "_deg", "# degrees"),
        named(RPY, "_rad"),
        named(RPY, "", "# all angles in radians"),
        export_lines(from_rpy(np.array([1.0, 2, 3]), RPY), "degrees", "b")["rpy"],
    ],
)
def test_a_stated_unit_is_taken(text: str, tmp_path: Path) -> None:
    expected = from_rpy(np.array([1.0, 2, 3]), RPY)
    np.testing.assert_allclose(read(text, tmp_path).T_parent_child, expected, atol=1e-12)


@pytest.mark.parametrize("comment", ["", "# in degrees", "# radians, not degrees", "# my lidar"])
@pytest.mark.parametrize("rpy", [[1.5, 0, 2], [0.001, 0, 0], [0, 0, -6.0]])
def test_angles_that_may_be_either_are_not_guessed(
    comment: str, rpy: list[float], tmp_path: Path
) -> None:
    with pytest.raises(ReadError, match=r"may be radians or degrees: name them roll_rad.*yaw_deg"):
        read(named(np.array(rpy), "", comment), tmp_path)
    assert np.allclose(read(named(np.zeros(3)), tmp_path).T_parent_child[:3, :3], np.eye(3))


def test_units_are_not_mixed(tmp_path: Path) -> None:
    with pytest.raises(ReadError, match="expected x y z and"):
        read(named(RPY, "_deg").replace("yaw_deg", "yaw_rad"), tmp_path)
    with pytest.raises(ReadError, match="beyond 360°"):
        read(named(np.array([0, 0, 361.0]), "_deg"), tmp_path)


# --- tf2_echo ------------------------------------------------------------------------------------


def echoed(T: Array, of: str = "humble", decimals: int = 3) -> str:
    """Print a transform as tf2_echo (ROS 2) and tf_echo (ROS 1) do."""

    def row(values: Array) -> str:
        return "[" + ", ".join(f"{v:.{decimals}f}" for v in values) + "]"

    rpy = se3.rpy_from_rotation(T[:3, :3])
    q = row(se3.quaternion_xyzw(T[:3, :3]))
    if of == "noetic":
        return (
            f"At time 0.000\n- Translation: {row(T[:3, 3])}\n- Rotation: in Quaternion {q}\n"
            f"            in RPY (radian) {row(rpy)}\n            in RPY (degree) "
            f"{row(np.degrees(rpy))}\n"
        )
    matrix = "\n".join(" " + " ".join(f"{v:6.{decimals}f}" for v in r) for r in T)
    return (
        f"At time 0.0\n- Translation: {row(T[:3, 3])}\n- Rotation: in Quaternion (xyzw) {q}\n"
        f"- Rotation: in RPY (radian) {row(rpy)}\n- Rotation: in RPY (degree) "
        f"{row(np.degrees(rpy))}\n- Matrix:\n{matrix}\n"
    )


@pytest.mark.parametrize("of", ["humble", "noetic"])
@pytest.mark.parametrize("seed", range(20))
def test_what_tf2_echo_prints_is_read_to_its_rounding(of: str, seed: int, tmp_path: Path) -> None:
    true = se3.random(np.random.default_rng(seed))
    back = read(3 * echoed(true, of), tmp_path).T_parent_child
    difference = se3.difference(back, true)
    assert difference.rotation < np.radians(0.002)
    assert difference.translation < 0.001


def test_of_tf2_echo_the_quaternion_is_taken_where_tf2_loses_an_angle(tmp_path: Path) -> None:
    true = from_rpy(np.zeros(3), np.array([0.4, np.pi / 2, 0.1]))
    text = echoed(true).split("- Rotation: in RPY (degree)")[0]
    text += "- Rotation: in RPY (degree) [0.000, 90.000, 0.000]\n"
    assert se3.difference(read(text, tmp_path).T_parent_child, true).rotation < 2e-3
    without = text.split("- Rotation: in RPY")[0]
    assert se3.difference(read(without, tmp_path).T_parent_child, true).rotation < 2e-3


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (echoed(T) + echoed(se3.inverse(T)), "2 different transforms: this transform changes"),
        ("(degree)".join([echoed(T).split("(degree)")[0], " [1.000, 2.000, 3.000]"]), "differ by"),
        (echoed(T).split("- Rotation")[0], "expected Translation"),
        ("Translation: [1, 2, 3]\nQuaternion [0, 0, 0.9, 0.9]", "norm"),
    ],
)
def test_of_tf2_echo_nothing_is_guessed(text: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(ReadError, match=said):
        read(text, tmp_path)
