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
RPY_RAD, RPY_DEG = (tuple(f"{name}{unit}" for name in RPY) for unit in ("_rad", "_deg"))
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

    The note is after the numbers, in square brackets: pasted, CloudCompare drops what is in
    such brackets; from a file it reads sixteen numbers and stops.
    """
    return f"{_rows(transform.T_parent_child)}[ {'; '.join(transform.notes)} ]\n"


_TERMINAL = re.compile(r"^T_target_source\b.*\n(?:[ ]+[^ \[].*\n){0,9}((?:\s*\[.*\n?){4})", re.M)
"""The matrix as `retropole calibrate` prints it, in the middle of its other lines."""

_WRAPPING = re.compile(r"\b(?:(?:np|numpy)\.)?(?:array|matrix)\s*\(|,?\s*dtype\s*=\s*[\w.]+|\)")
"""What the repr of an array of NumPy has about its numbers."""


def read_matrix(data: bytes) -> list[Found]:
    """Read sixteen numbers, row by row, also in brackets with commas, as NumPy prints them.

    Comments start with # or //, or are in [ ] with more than numbers.
    """
    text = data.decode()
    parent, child = names_in_words(text)
    printed = _TERMINAL.findall(text)
    is_printed = len(printed) == 1
    body = _WRAPPING.sub(" ", printed[0] if is_printed else text)
    body = re.sub(r"#.*|//.*|\[[^][]*\]", _without_notes, body)
    given = re.sub(r"[][,;]", " ", body).split()
    if len(given) != 16:
        raise ReadError(
            f"a 4×4 matrix has 16 numbers, this has {len(given)}; a pose of 6 or 7 numbers is read "
            "if each has a name, one per line, as 'x: 1.5': x y z and qx qy qz qw, or roll_deg "
            "pitch_deg yaw_deg"
        )
    values = np.array([to_float(word) for word in given]).reshape(4, 4)
    return [Found(parent, child, lambda: values, is_of_lidars=is_printed)]


def _without_notes(bracketed: re.Match[str]) -> str:
    """Leave out a comment; text in brackets stays if it is only numbers."""
    numbers = re.fullmatch(r"(?i)\[((?:[-+\d.e,;\s]|nan|inf)*)\]", bracketed[0])
    return f" {numbers[1]} " if numbers else " "


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
    """Read lines ``name: number`` with a translation and a quaternion or roll-pitch-yaw.

    Angles are in the unit that their names or a comment state. Also what ``tf2_echo`` prints.
    """
    text = data.decode()
    names, code = names_in_words(text), re.sub(r"#.*", "", text)
    if "Translation:" in code:
        return [Found(*names, lambda: _echoed(code))]
    values: dict[str, str] = {}
    for line in code.splitlines():
        if not line.strip():
            continue
        name, colon, value = line.partition(":")
        if not colon or name.strip() in values:
            raise ReadError(f"expected one line 'name: number' for each name, got {line.strip()!r}")
        values[name.strip()] = value
    comment = "\n".join(re.findall("#.*", text))
    radians = re.search(r"\bradians?\b", comment) and not re.search(r"\bdegrees?\b", comment)
    known = RPY_MEANING in text or bool(radians)
    return [Found(*names, lambda: pose_of(values, unit_is_known=known))]


_ECHOED = re.compile(r"(Translation|Quaternion|RPY \(degree\))[^[\n]*\[([^][\n]*)\]")


def _echoed(text: str) -> Array:
    """Read the one transform that ``tf2_echo PARENT CHILD`` prints, over and over.

    Its quaternion has three decimals. Angles in degrees with as many say the same to 0.001°.
    """
    poses = {tuple(_ECHOED.findall(f"Translation{each}")) for each in text.split("Translation")[1:]}
    if len(poses) > 1:
        raise ReadError(
            f"tf2_echo printed {len(poses)} different transforms: this transform changes"
        )
    parts = {name: values.replace(",", " ").split() for name, values in poses.pop()}
    if [len(parts.get(name, ())) for name in ("Translation", "Quaternion")] != [3, 4]:
        raise ReadError("expected Translation: [x, y, z] and Quaternion [x, y, z, w] of tf2_echo")
    t, q = (
        np.array([to_float(word) for word in parts[name]]) for name in ("Translation", "Quaternion")
    )
    rounding = min(10.0 ** -len(word.partition(".")[2]) for word in parts["Quaternion"])
    T = from_quaternion(t, q, max(rounding, se3.RIGID_TOLERANCE))
    angles = parts.get("RPY (degree)", [])
    if len(angles) != 3:
        return T
    sharper = _from_degrees(t, np.array([to_float(word) for word in angles]))
    difference = se3.difference(T, sharper).rotation
    if difference <= 4 * rounding:
        return sharper
    # With the nose straight up or down tf2 loses an angle, not the quaternion.
    if abs(abs(to_float(angles[1])) - 90) < 0.1:
        return T
    raise ReadError(f"quaternion and roll-pitch-yaw of tf2_echo differ by {difference:.3g} rad")


def pose_of(values: dict[str, str], *, unit_is_known: bool = True) -> Array:
    """Build a 4×4 transform from ``x y z`` and ``qx qy qz qw`` or ``roll pitch yaw`` by name.

    Parameters
    ----------
    values
        The numbers; angles also as ``roll_deg``, … or ``roll_rad``, ….
    unit_is_known
        Whether angles whose names have no unit are in radians.
    """
    kinds = (QUATERNION, RPY_DEG, RPY_RAD, RPY)
    kind = next((names for names in kinds if names[-1] in values), RPY)
    if set(values) != {*TRANSLATION_KEYS, *kind}:
        raise ReadError(
            f"expected {' '.join(TRANSLATION_KEYS)} and {' '.join(QUATERNION)} or {' '.join(RPY)}, "
            f"got {' '.join(values) or 'nothing'}"
        )
    t, angles = (
        np.array([to_float(values[name]) for name in names]) for names in (TRANSLATION_KEYS, kind)
    )
    if kind == QUATERNION:
        return from_quaternion(t, angles)
    if kind == RPY_DEG:
        return _from_degrees(t, angles)
    T = from_rpy(t, angles)
    if kind == RPY and not unit_is_known and angles.any():
        raise ReadError(
            f"roll, pitch, yaw of {', '.join(f'{angle:g}' for angle in angles)} may be radians or "
            "degrees: name them roll_rad, pitch_rad, yaw_rad, or roll_deg, pitch_deg, yaw_deg"
        )
    return T


def _from_degrees(translation: Array, rpy: Array) -> Array:
    if np.abs(rpy).max() > 360:
        raise ReadError(f"an angle of {max(rpy, key=abs):g}° is beyond 360°")
    return from_rpy(translation, np.radians(rpy))


def to_float(word: str) -> float:
    """Read a number, or say which word is none."""
    try:
        return float(word)
    except ValueError:
        raise ReadError(f"{word.strip()!r} is not a number") from None
