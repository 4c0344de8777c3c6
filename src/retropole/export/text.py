"""Plain text: a 4×4 matrix, CloudCompare's matrix, a quaternion, roll-pitch-yaw."""

from __future__ import annotations

import re
from collections.abc import Iterable

import numpy as np

from ..base import se3
from ..base.datatypes import Array
from ..base.errors import ReadError
from .transform import (
    Found,
    Transform,
    from_quaternion,
    from_rpy,
    names_in_words,
    number,
    to_quaternion,
)

TRANSLATION_KEYS = ("x", "y", "z")
QUATERNION = ("qx", "qy", "qz", "qw")
RPY = ("roll", "pitch", "yaw")
RPY_MEANING = "metres and radians; fixed axes x, y, z: R = Rz(yaw) Ry(pitch) Rx(roll)"


def comments(notes: Iterable[str]) -> str:
    """Write notes as comments of a shell, of YAML and of Python, a line each."""
    return "".join(f"# {note}\n" for note in notes)


def named_lines(values: dict[str, str], indent: str = "") -> str:
    """Write each value on a line with its name."""
    return "".join(f"{indent}{name}: {value}\n" for name, value in values.items())


def _rows(T: Array) -> str:
    return "".join(" ".join(number(v) for v in row) + "\n" for row in T)


def write_matrix(transform: Transform) -> str:
    """Write four rows of four numbers below a comment."""
    return f"{comments(transform.notes)}{_rows(transform.T_parent_child)}"


def write_cloudcompare(transform: Transform) -> str:
    """Write the matrix for CloudCompare's Edit > Apply Transformation, on the child's cloud.

    The note stands after the numbers, in square brackets: pasted, CloudCompare drops what is in
    such brackets; from a file it reads sixteen numbers and stops.
    """
    return f"{_rows(transform.T_parent_child)}[ {'; '.join(transform.notes)} ]\n"


def read_matrix(data: bytes) -> list[Found]:
    """Read sixteen numbers, row by row; comments start with # or // or stand in [ ]."""
    text = data.decode()
    parent, child = names_in_words(text)
    words = re.sub(r"#.*|//.*|\[[^]]*\]", " ", text).replace(",", " ").split()
    if len(words) != 16:
        raise ReadError(f"a 4×4 matrix has 16 numbers, this has {len(words)}")
    values = np.array([to_float(word) for word in words]).reshape(4, 4)
    return [Found(parent, child, lambda: values)]


def pose_values(transform: Transform, rotation: tuple[str, ...]) -> dict[str, str]:
    """Write translation and quaternion or roll-pitch-yaw as numbers by name."""
    T = transform.T_parent_child
    angles = to_quaternion(T) if rotation == QUATERNION else se3.rpy_from_rotation(T[:3, :3])
    values = (*T[:3, 3], *angles)
    return dict(zip((*TRANSLATION_KEYS, *rotation), map(number, values), strict=True))


def write_quaternion(transform: Transform) -> str:
    """Write ``x y z qx qy qz qw``, each on a line with its name."""
    notes = (*transform.notes, "metres; unit quaternion, qw is the real part")
    return comments(notes) + named_lines(pose_values(transform, QUATERNION))


def write_rpy(transform: Transform) -> str:
    """Write ``x y z roll pitch yaw``, each on a line with its name."""
    return comments((*transform.notes, RPY_MEANING)) + named_lines(pose_values(transform, RPY))


def read_named(data: bytes) -> list[Found]:
    """Read lines ``name: number`` with a translation and a quaternion or roll-pitch-yaw."""
    text = data.decode()
    values: dict[str, str] = {}
    for line in re.sub(r"#.*", "", text).splitlines():
        if not line.strip():
            continue
        name, colon, value = line.partition(":")
        if not colon or name.strip() in values:
            raise ReadError(f"expected one line 'name: number' for each name, got {line.strip()!r}")
        values[name.strip()] = value
    return [Found(*names_in_words(text), lambda: pose_of(values))]


def pose_of(values: dict[str, str]) -> Array:
    """Build a 4×4 transform from ``x y z`` and ``qx qy qz qw`` or ``roll pitch yaw`` by name."""
    kind = QUATERNION if "qw" in values else RPY
    if set(values) != {*TRANSLATION_KEYS, *kind}:
        raise ReadError(
            f"expected {' '.join(TRANSLATION_KEYS)} and {' '.join(QUATERNION)} or {' '.join(RPY)}, "
            f"got {' '.join(values) or 'nothing'}"
        )
    t, angles = ([to_float(values[name]) for name in names] for names in (TRANSLATION_KEYS, kind))
    build = from_quaternion if kind == QUATERNION else from_rpy
    return build(np.array(t), np.array(angles))


def to_float(word: str) -> float:
    """Read a number, or say which word is none."""
    try:
        return float(word)
    except ValueError:
        raise ReadError(f"{word.strip()!r} is no number") from None
