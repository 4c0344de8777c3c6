"""A transform between two named frames, the forms it is written in, and the checks it must pass.

``T_parent_child`` maps points of the child frame into the parent frame: the pose of the child in
the parent, as ROS and URDF have it. The target LiDAR is the parent, the source LiDAR the child.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ..base import se3
from ..base.datatypes import Array
from ..base.errors import ReadError, UsageError, said
from ..base.se3 import relative_jacobian

ROS_COVARIANCE_ORDER = ("x", "y", "z", "rot_x", "rot_y", "rot_z")
"""ROS puts translation first (geometry_msgs/PoseWithCovariance)."""

NO_LIDARS = {
    *("base", "base_footprint", "base_link", "chassis", "ego_vehicle", "vehicle"),
    *("odom", "map", "world", "earth"),
}
"""Frames of a robot and of its surroundings (REP 105, REP 120, and others by custom)."""

FULL_TURN = 2 * math.pi + 1e-4
"""No angle in radians is larger; four printed decimals of 2π are by less."""

LONGEST_NAME = 500
"""Characters of a frame's name: YAML takes keys of 1024, and each may have to be escaped."""

_TO_ROS = [3, 4, 5, 0, 1, 2]
_PLAIN = r"[A-Za-z0-9_./]+(?:-[A-Za-z0-9_./]+)*"
_NAME = rf'({_PLAIN}|"(?:[^"\\]|\\.)*")'
_MEANING = re.compile(f"maps points of {_NAME} into {_NAME}; parent: {_NAME}, child: {_NAME}")


def is_name(name: str) -> bool:
    """Return whether a frame can have a name: see `Transform`."""
    return len(name) <= LONGEST_NAME and bool(name.strip()) and name.isprintable()


@dataclass(frozen=True, eq=False)
class Transform:
    """A rigid transform between two named frames.

    Attributes
    ----------
    T_parent_child
        (4, 4) maps homogeneous points of the child frame into the parent frame, metres.
    parent, child
        Names of the frames, up to `LONGEST_NAME` characters; they differ, and hold neither line
        breaks nor control characters.
    covariance
        (6, 6) over ``[φ, δ]``, rad and m, axes of the parent frame, or None if not known:
        ``R_true = Exp(φ) R``, ``t_true = t + δ``.
    roles
        What parent and child are in the calibration: ``("target", "source")``, or swapped
        after `inverted`; ``("parent", "child")`` if the parent is not a LiDAR (`mounted`).
    verdict
        Of the calibration that it is from, on one line (`result.verdict_line`);
        empty if not known.

    Raises
    ------
    UsageError
        For names that no frame can have.
    ReadError
        For a matrix that is not rigid (`se3.rigid`).
    """

    T_parent_child: Array
    parent: str
    child: str
    covariance: Array | None = None
    roles: tuple[str, str] = ("target", "source")
    verdict: str = ""

    def __post_init__(self) -> None:
        """Check the names and the matrix."""
        se3.rigid(self.T_parent_child)
        for role, name in (("parent", self.parent), ("child", self.child)):
            if len(name) > LONGEST_NAME:
                raise UsageError(
                    f"the name of the {role} frame has {len(name)} characters; "
                    f"{LONGEST_NAME} at most"
                )
            if not is_name(name):
                raise UsageError(f"{name[:60]!r} is not a valid name for the {role} frame")
        if self.parent == self.child:
            raise UsageError(f"parent and child are both named {self.parent!r}; they must differ")

    @property
    def meaning(self) -> str:
        """Describe what it maps, and name the frames so that they can be read back."""
        parent, child = quoted(self.parent), quoted(self.child)
        return f"maps points of {child} into {parent}; parent: {parent}, child: {child}"

    @property
    def notes(self) -> list[str]:
        """Describe in comments what it maps, and the verdict of its calibration."""
        return [self.meaning, *([self.verdict] if self.verdict else [])]


def notes_on(transforms: Sequence[Transform]) -> list[str]:
    """Describe what several transforms map, and each verdict once."""
    verdicts = dict.fromkeys(each.verdict for each in transforms if each.verdict)
    return [*(each.meaning for each in transforms), *verdicts]


def inverted(transform: Transform) -> Transform:
    """Turn a transform round: parent and child change places.

    The covariance follows to first order. With ``R' = Rᵀ`` and ``t' = −Rᵀ t``, the errors are
    ``φ' = −Rᵀ φ`` and ``δ' = −Rᵀ (δ + [t]ₓ φ)``.
    """
    T = transform.T_parent_child
    covariance = transform.covariance
    if covariance is not None:
        J = relative_jacobian(T, np.eye(4))[:, :6]
        covariance = J @ covariance @ J.T
    return replace(
        transform,
        T_parent_child=se3.inverse(T),
        parent=transform.child,
        child=transform.parent,
        covariance=covariance,
        roles=transform.roles if "parent" in transform.roles else transform.roles[::-1],
    )


def mounted(transform: Transform, mounting: Transform) -> Transform:
    """Give the pose of the child in the frame that the parent is mounted in.

    Parameters
    ----------
    transform
        ``T_parent_child``.
    mounting
        ``T_frame_parent``, taken as exact: its child is the parent of `transform`.
    """
    covariance = transform.covariance
    if covariance is not None:
        turn = np.kron(np.eye(2), mounting.T_parent_child[:3, :3])
        covariance = turn @ covariance @ turn.T
    return replace(
        transform,
        T_parent_child=mounting.T_parent_child @ transform.T_parent_child,
        parent=mounting.parent,
        covariance=covariance,
        roles=("parent", "child"),
    )


def covariance_to_ros(covariance: Array) -> Array:
    """Reorder a (6, 6) covariance from ``[φ, δ]`` to ROS's ``[x y z rot_x rot_y rot_z]``."""
    return covariance[np.ix_(_TO_ROS, _TO_ROS)]


covariance_from_ros = covariance_to_ros
"""The way back: exchanging the two halves undoes itself."""


def from_quaternion(
    translation: Array, xyzw: Array, tolerance: float = se3.RIGID_TOLERANCE
) -> Array:
    """Build a 4×4 transform from a translation, m, and a unit quaternion ``x y z w``.

    Raises
    ------
    ReadError
        If a number is not finite, or the norm is further than the tolerance from 1.
    """
    q, t = np.asarray(xyzw, dtype=float), np.asarray(translation, dtype=float)
    if not (np.isfinite(q).all() and np.isfinite(t).all()):
        raise ReadError("no rigid transform: a number is not finite")
    norm = float(np.hypot.reduce(q))
    if abs(norm - 1) > tolerance:
        raise ReadError(f"no unit quaternion: x y z w = {q.tolist()} has norm {norm:.6g}, not 1")
    return se3.from_quaternion_xyzw(q, t)


def to_quaternion(T: Array) -> Array:
    """Unit quaternion ``x y z w`` (4,) of a 4×4 transform, with w ≥ 0."""
    return se3.quaternion_xyzw(T[:3, :3])


def from_rpy(translation: Array, rpy: Array) -> Array:
    """Build a 4×4 transform from a translation, m, and roll, pitch, yaw, rad.

    About fixed axes, x then y then z: ``R = Rz(yaw) Ry(pitch) Rx(roll)``, as in URDF and ROS.

    Raises
    ------
    ReadError
        If a number is not finite, or an angle is larger than a full turn.
    """
    if not (np.isfinite(rpy).all() and np.isfinite(translation).all()):
        raise ReadError("no rigid transform: a number is not finite")
    largest = max(map(float, rpy), key=abs)
    if abs(largest) > FULL_TURN:
        raise ReadError(
            f"an angle of {largest:g} is beyond 2π = 6.283: degrees? Give radians, "
            f"{math.radians(largest):.6g} for {largest:g}°; text and YAML may have degrees as "
            "roll_deg, pitch_deg, yaw_deg"
        )
    return se3.from_rt(se3.rotation_from_rpy(rpy), np.asarray(translation, dtype=float))


def quoted(name: str) -> str:
    """Write a name so that it is safe in any comment and can be read back: bare, or as JSON.

    Also where a shell takes no comments, as zsh at its prompt.
    """
    if re.fullmatch(_PLAIN, name):
        return name
    text = json.dumps(name, ensure_ascii=False)
    return '"' + re.sub(r"[\[\]<>&$`!-]", lambda c: f"\\u{ord(c[0]):04x}", text[1:-1]) + '"'


def names_in_words(text: str) -> tuple[str | None, str | None]:
    """Read parent and child back from `Transform.meaning`; None, None if it is not there."""
    found = _MEANING.search(text)
    if found is None:
        return None, None
    try:
        parent, child = (json.loads(n) if n[0] == '"' else n for n in found.groups()[2:])
    except json.JSONDecodeError as error:
        raise ReadError(f"cannot read the names in {found[0]!r}: {said(error)}") from None
    return parent, child


def number(value: float) -> str:
    """Write a number so that it reads back the same, also if YAML 1.1 wants a point in it."""
    text = repr(float(value) + 0.0)
    mantissa, e, exponent = text.partition("e")
    return text if not e or "." in mantissa else f"{mantissa}.0e{exponent}"


class Found(NamedTuple):
    """A transform in a file.

    Attributes
    ----------
    parent, child
        Names of its frames in the file; None if the file names none.
    pose
        Gives ``T_parent_child`` (4, 4). Called for the chosen one alone, so that nothing that is
        wrong in the rest of a file is in the way.
    covariance
        (6, 6) over ``[φ, δ]``, axes of the parent, or None.
    roles, verdict
        As in `Transform`.
    is_of_lidars
        Whether both frames are known to be those of LiDARs, whatever they are called.
    """

    parent: str | None
    child: str | None
    pose: Callable[[], Array]
    covariance: Array | None = None
    roles: tuple[str, str] = ("target", "source")
    verdict: str = ""
    is_of_lidars: bool = False


class Way(NamedTuple):
    """Transforms from two frames up to the first frame that is above both, nearest first."""

    of_parent: list[Found]
    of_child: list[Found]

    def pose(self) -> Array:
        """Give ``T_parent_child`` (4, 4)."""
        above = [np.eye(4), np.eye(4)]
        for k, steps in enumerate(self):
            for step in steps:
                above[k] = se3.rigid(step.pose()) @ above[k]
        return se3.inverse(above[0]) @ above[1]


def way_between(found: Sequence[Found], parent: str, child: str) -> Way | None:
    """Find the way from one frame to another over the transforms of a file.

    A frame that is the child of several transforms ends the way: it is unclear where it is.

    Returns
    -------
    Way or None
        None if no path connects them.
    """
    above: dict[str, list[Found]] = {}
    for each in found:
        if each.parent and each.child:
            above.setdefault(each.child, []).append(each)

    def up(frame: str) -> dict[str, list[Found]]:
        """Each frame from one upwards, with the transform to the next, if any."""
        frames: dict[str, list[Found]] = {}
        while frame not in frames:
            over = above.get(frame, [])
            frames[frame] = over if len(over) == 1 else []
            frame = over[0].parent or "" if len(over) == 1 else frame
        return frames

    of_parent, of_child = up(parent), up(child)
    top = next((frame for frame in of_parent if frame in of_child), None)
    if top is None:
        return None
    return Way(
        *(
            [steps[0] for steps in list(own.values())[: list(own).index(top)]]
            for own in (of_parent, of_child)
        )
    )


def choose(found: Sequence[Found], parent: str | None, child: str | None) -> Transform:
    """Find the one transform that fits the names; name it if the file does not.

    If none has both names, that over a way of several: over ``base_link`` to both LiDARs.

    Raises
    ------
    ReadError
        If none fits, several do, or the only one is not a rigid transform.
    UsageError
        If a LiDAR is given the name of a frame that is none (`NO_LIDARS`).
    """
    fits = [f for f in found if _fits(f.parent, parent) and _fits(f.child, child)]
    if not fits and parent and child:
        way = way_between(found, parent, child)
        # Against the direction of the file is what --invert is for.
        if way is not None and way.of_child:
            fits = [Found(parent, child, way.pose)]
    if len(fits) != 1:
        listed = ", ".join(f"{f.parent or 'unnamed'} -> {f.child or 'unnamed'}" for f in found[:20])
        wanted = f"{parent or 'any parent'} -> {child or 'any child'}"
        raise ReadError(
            f"{len(fits)} transforms fit {wanted} of {listed or 'none'}; name both frames of one "
            "(--parent, --child)"
        )
    one = fits[0]
    for role, there, given in zip(one.roles, (one.parent, one.child), (parent, child), strict=True):
        if one.is_of_lidars and there is None and (given or "").rpartition("/")[2] in NO_LIDARS:
            raise UsageError(
                f"{given!r} is not the name of a LiDAR frame: give the frame of the {role} "
                "itself; for its pose on a robot use --mounting FILE or --into ROBOT.urdf"
            )
    return Transform(
        se3.rigid(one.pose()),
        one.parent or parent or one.roles[0],
        one.child or child or one.roles[1],
        one.covariance,
        one.roles,
        one.verdict,
    )


def _fits(in_file: str | None, wanted: str | None) -> bool:
    return in_file is None or wanted is None or in_file == wanted
