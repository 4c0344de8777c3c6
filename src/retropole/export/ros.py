"""ROS: static_transform_publisher lines for ROS 1 and ROS 2, and a launch file for ROS 2.

Argument order as `tf2_ros` has it. ROS 1: ``x y z qx qy qz qw frame_id child_frame_id``, or with
``yaw pitch roll`` in place of the quaternion; the program of the package `tf` takes a period after
these. ROS 2: flags. The frame is the parent.
"""

from __future__ import annotations

import ast
import shlex
from collections.abc import Sequence

import numpy as np

from ..base.datatypes import Array
from ..base.errors import ReadError, UsageError, said
from .text import QUATERNION, RPY, TRANSLATION_KEYS, comments, pose_of, pose_values, to_float
from .transform import Found, Transform, from_quaternion, from_rpy, notes_on
from .urdf import is_xml, read_xml

PROGRAM = "static_transform_publisher"

_LAUNCH = """\
from launch import LaunchDescription
from launch_ros.actions import Node

{comments}

def generate_launch_description():
    return LaunchDescription(
        [{nodes}
        ]
    )
"""
_NODE = """
            Node(
                package='tf2_ros',
                executable='{program}',
                arguments=[{arguments}
                ],
            ),"""


def write_ros1(transform: Transform) -> str:
    """Write a ``rosrun`` line; names that a shell would split are quoted."""
    if any(":=" in name for name in (transform.parent, transform.child)):
        raise UsageError("ROS 1 reads a name with := as a remapping; rename the frame")
    values = list(pose_values(transform, QUATERNION).values())
    line = shlex.join([*values, transform.parent, transform.child])
    return f"{comments(transform.notes)}rosrun tf2_ros {PROGRAM} {line}\n"


def _flags(transform: Transform) -> list[str]:
    """Arguments of the ROS 2 program, unquoted."""
    if "--ros-args" in (transform.parent, transform.child):
        raise UsageError("ROS 2 reads --ros-args as an option, not as the name of a frame")
    arguments = [
        word
        for name, value in pose_values(transform, QUATERNION).items()
        for word in (f"--{name}", value)
    ]
    return [*arguments, "--frame-id", transform.parent, "--child-frame-id", transform.child]


def write_ros2(transform: Transform) -> str:
    """Write a ``ros2 run`` line; names that a shell would split are quoted."""
    line = shlex.join(_flags(transform))
    return f"{comments(transform.notes)}ros2 run tf2_ros {PROGRAM} {line}\n"


def write_launch(*transforms: Transform, notes: Sequence[str] = ()) -> str:
    """Write a Python launch file for ROS 2 that publishes transforms.

    Notes and what each transform maps are comments below the imports: in one of the first two
    lines, Python takes ``coding:`` in a name for the encoding of the file.
    """
    nodes = ""
    for each in transforms:
        flags = _flags(each)
        pairs = zip(flags[::2], flags[1::2], strict=True)
        nodes += _NODE.format(
            program=PROGRAM,
            arguments="".join(f"\n{' ' * 20}{flag!r}, {value!r}," for flag, value in pairs),
        )
    notes_text = comments((*notes, *notes_on(transforms)))
    return _LAUNCH.format(comments=notes_text, nodes=nodes)


def read_ros1(data: bytes) -> list[Found]:
    """Read every ``static_transform_publisher`` line of `tf2_ros` in a shell script."""
    return [_positional(arguments) for arguments in _commands(data)]


def read_ros2(data: bytes) -> list[Found]:
    """Read every ``static_transform_publisher`` line in a shell script, with flags or without."""
    return [_ros2_arguments(arguments) for arguments in _commands(data)]


def read_launch(data: bytes) -> list[Found]:
    """Read the publishers of a launch file, in Python or XML; nothing in it is run.

    Of Python from its syntax alone.
    """
    if is_xml(data):
        return _read_launch_xml(data)
    try:
        tree = ast.parse(data)
    # What nests deeper than Python's parser goes ends in either of the last two.
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise ReadError(f"no Python launch file: {str(error) or 'nested too deep'}") from None
    found = []
    for call in ast.walk(tree):
        if not isinstance(call, ast.Call):
            continue
        given = {word.arg: word.value for word in call.keywords if word.arg}
        program = given.get("executable")
        if not isinstance(program, ast.Constant) or program.value != PROGRAM:
            continue
        try:
            arguments = ast.literal_eval(given["arguments"])
        except (KeyError, TypeError, ValueError):
            arguments = None
        if not isinstance(arguments, list | tuple):
            raise ReadError(f"line {call.lineno}: the arguments of {PROGRAM} are not plain strings")
        found.append(_ros2_arguments([str(word) for word in arguments]))
    return found


def _read_launch_xml(data: bytes) -> list[Found]:
    """Read the publishers of a launch file of ROS 1 (``type=``) or ROS 2 (``exec=``)."""
    root = read_xml(data)
    if root.tag != "launch":
        raise ReadError(f"no launch file: the root element is <{root.tag}>, not <launch>")
    found: list[Found] = []
    for node in root.iter("node"):
        of = node.attrib
        if PROGRAM not in (of.get("type"), of.get("exec")):
            continue
        args, name = of.get("args", ""), of.get("name", PROGRAM)
        if "$(" in args:
            raise ReadError(
                f"node {name!r}: its args contain $(…); replace them by numbers and names"
            )
        try:
            arguments = shlex.split(args)
        except ValueError as error:
            raise ReadError(f"node {name!r}: {said(error)}") from None
        if "exec" in of:
            found.append(_ros2_arguments(arguments))
        else:
            found.append(_positional(arguments, of.get("pkg", "")))
    return found


def _commands(data: bytes) -> list[list[str]]:
    """Arguments of every call of the program in a shell script."""
    commands = []
    for line in data.decode().replace("\\\r\n", " ").replace("\\\n", " ").splitlines():
        if PROGRAM not in line:
            continue
        try:
            arguments = shlex.split(line, comments=True)
        except ValueError as error:
            raise ReadError(f"{line.strip()!r}: {said(error)}") from None
        if PROGRAM not in arguments:
            continue
        at = arguments.index(PROGRAM)
        if at and arguments[at - 1] == "tf":
            raise ReadError(
                f"'tf {PROGRAM}' has a period; only that of tf2_ros is read: leave out the "
                "period and write tf2_ros"
            )
        commands.append(arguments[at + 1 :])
    return commands


def _ros2_arguments(arguments: list[str]) -> Found:
    """Read flags as `tf2_ros` does: what is not given is zero, no rotation is the identity."""
    if not any(word.startswith("--") for word in arguments):
        return _positional(arguments)
    flags, values = arguments[::2], arguments[1::2]
    names = [flag.removeprefix("--") for flag in flags]
    known = {*TRANSLATION_KEYS, *QUATERNION, *RPY, "frame-id", "child-frame-id"}
    if len(flags) != len(values) or not set(names) <= known or len(set(names)) < len(names):
        raise ReadError(f"cannot read the arguments of {PROGRAM}: {' '.join(arguments)}")
    given = dict(zip(names, values, strict=True))
    parent, child = given.pop("frame-id", None), given.pop("child-frame-id", None)
    if not parent or not child:
        raise ReadError(f"{PROGRAM} needs --frame-id and --child-frame-id")
    is_quaternion = not given.keys().isdisjoint(QUATERNION)
    if is_quaternion and not given.keys().isdisjoint(RPY):
        raise ReadError(f"{PROGRAM} has a quaternion and roll-pitch-yaw; one is needed")
    full = dict.fromkeys((*TRANSLATION_KEYS, *(QUATERNION if is_quaternion else RPY)), "0")
    full |= ({"qw": "1"} if is_quaternion else {}) | given
    return Found(parent, child, lambda: pose_of(full))


def _positional(arguments: list[str], package: str = "tf2_ros") -> Found:
    """Read ``x y z qx qy qz qw parent child`` or ``x y z yaw pitch roll parent child``.

    The program of the package `tf` takes a period in milliseconds as one more.
    """
    more = package == "tf"
    if len(arguments) not in (8 + more, 9 + more):
        raise ReadError(
            f"{PROGRAM} of {package} takes {8 + more} or {9 + more} arguments, this has "
            f"{len(arguments)}: x y z yaw pitch roll, or x y z qx qy qz qw, parent child"
            f"{' period' if more else ''}"
        )
    *numbers, parent, child = arguments[: len(arguments) - more]

    def pose() -> Array:
        values = np.array([to_float(word) for word in numbers])
        if len(values) == 7:
            return from_quaternion(values[:3], values[3:])
        return from_rpy(values[:3], values[:2:-1])

    return Found(parent, child, pose)
