"""URDF: a fixed joint of its own, or put into a robot whose file else stays byte for byte.

The origin of a joint is the pose of the child in the parent: ``T_parent_child``. Its ``rpy`` are
angles about fixed axes, x then y then z.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from html import escape

import numpy as np

from ..base import se3
from ..base.datatypes import Array
from ..base.errors import ReadError, UsageError
from .text import RPY, pose_values, to_float
from .transform import Found, Transform, from_rpy, mounted, way_between
from .xml_scan import Element, Scan, scan_xml, with_attributes


def write_urdf(*transforms: Transform, name: str = "retropole", notes: Sequence[str] = ()) -> str:
    """Write a robot of fixed joints, parents before children, under notes as comments."""
    frames = dict.fromkeys(frame for each in transforms for frame in (each.parent, each.child))
    # Two hyphens would end a comment.
    lines = [f"<!-- {note.replace('--', '- -').rstrip('-')} -->" for note in notes]
    lines += [f"<link name={_quote(frame)}/>" for frame in frames]
    lines += [line for each in transforms for line in _joint(each, "  ")]
    body = "".join(f"  {line}\n" for line in lines)
    declaration = '<?xml version="1.0" encoding="utf-8"?>'
    return f"{declaration}\n<robot name={_quote(name)}>\n{body}</robot>\n"


def _quote(name: str) -> str:
    """Write a name as the value of an attribute."""
    return f'"{escape(name)}"'


def _origin(transform: Transform) -> dict[str, str]:
    """Attributes of the joint's origin."""
    values = list(pose_values(transform, RPY).values())
    return {"xyz": " ".join(values[:3]), "rpy": " ".join(values[3:])}


def _origin_tag(transform: Transform) -> str:
    return with_attributes("<origin/>", _origin(transform))


def _joint(transform: Transform, indent: str) -> list[str]:
    """Lines of the joint, under a comment that says in words what it maps."""
    name = _quote(f"{transform.child}_joint")
    return [
        *(f"<!-- {note} -->" for note in transform.notes),
        f'<joint name={name} type="fixed">',
        f"{indent}<parent link={_quote(transform.parent)}/>",
        f"{indent}<child link={_quote(transform.child)}/>",
        f"{indent}{_origin_tag(transform)}",
        "</joint>",
    ]


def read_urdf(data: bytes) -> list[Found]:
    """Read the joints of a robot; the pose of one that moves is refused when it is asked for."""
    return _found(_robot(scan_xml(data)).named("joint"))


def _found(joints: Iterable[Element]) -> list[Found]:
    return [
        Found(_link(joint, "parent"), _link(joint, "child"), lambda joint=joint: _pose(joint))  # type: ignore[misc]
        for joint in joints
    ]


def _robot(scan: Scan) -> Element:
    if scan.root.tag != "robot":
        raise ReadError(f"no URDF: the root element is <{scan.root.tag}>, not <robot>")
    return scan.root


def _link(joint: Element, role: str) -> str:
    """Link that a joint names as its parent or child; empty where it names none."""
    named = joint.named(role)
    return named[0].attributes.get("link", "") if len(named) == 1 else ""


def _pose(joint: Element) -> Array:
    """``T_parent_child`` of a fixed joint; what is not given is zero."""
    _check_fixed(joint)
    attributes = joint.named("origin")[0].attributes if joint.named("origin") else {}
    xyz, rpy = (_three(attributes.get(name, "0 0 0"), name) for name in ("xyz", "rpy"))
    return from_rpy(xyz, rpy)


def _check_fixed(joint: Element) -> None:
    name, kind = joint.attributes.get("name", "?"), joint.attributes.get("type")
    if kind != "fixed":
        raise ReadError(f"joint {name!r} is {kind}, not fixed: its origin is not the whole pose")
    if any("$" in value for each in joint.named("origin") for value in each.attributes.values()):
        raise ReadError(
            f"the origin of joint {name!r} is an expression; expand the file first: xacro FILE > "
            "robot.urdf"
        )
    if len(joint.named("origin")) > 1:
        raise ReadError(f"joint {name!r} has {len(joint.named('origin'))} origins, not one")


def _three(text: str, name: str) -> Array:
    words = text.split()
    if len(words) != 3:
        raise ReadError(f"{name}={text!r} is not three numbers")
    return np.array([to_float(word) for word in words])


def put_into_urdf(data: bytes, transform: Transform) -> bytes:
    """Put a transform into a robot, and leave every other byte as it is.

    The joint that leads to the child is written. Where it starts at another link than the parent,
    its origin is the way there from that link, over fixed joints, times the transform: the robot
    then has both LiDARs as the transform says. Where the child has no joint yet, one is added at
    the end of the robot, and the child's link with it if that is missing.

    Parameters
    ----------
    data
        The URDF file.
    transform
        Names and pose; the parent must be a link of the robot.

    Returns
    -------
    bytes
        The file with the joint, in its own encoding, indentation and line endings.

    Raises
    ------
    ReadError
        Where it is no well-formed URDF, and where a joint on the way moves or is an expression.
    UsageError
        Where it is unclear what to change: the parent is no link, or is not connected with the
        link that the child's joint starts at; the child has several joints; its joint moves or is
        an expression; or it would close a circle.
    """
    scan = scan_xml(data)
    robot = _robot(scan)
    joints = [e for e in robot.walk() if e.tag == "joint" and e.named("child")]
    mine = [joint for joint in joints if _link(joint, "child") == transform.child]
    if mine:
        _check_joint(mine, robot)
        written = _from_link(_link(mine[0], "parent"), robot, transform)
        out = _with_origin(scan, mine[0], written)
    else:
        _check_room(robot, joints, transform)
        written = transform
        out = _with_joint(scan, transform)
    there = read_urdf(out)
    same = [f for f in there if (f.parent, f.child) == (written.parent, written.child)]
    if len(same) != 1 or np.abs(same[0].pose() - written.T_parent_child).max() > 1e-9:
        raise UsageError("the joint does not read back from the edited URDF; nothing was written")
    return out


def _from_link(link: str, robot: Element, transform: Transform) -> Transform:
    """Give the pose of the child in the link that its joint starts at."""
    if link == transform.parent:
        return transform
    _check_link(transform.parent, robot)
    way = way_between(_found(robot.named("joint")), link, transform.parent)
    if way is None:
        raise UsageError(
            f"no joints lead from {link!r}, where the joint to {transform.child!r} starts, to "
            f"{transform.parent!r}: the robot does not say where {transform.parent!r} is on it"
        )
    if any(transform.child in (step.parent, step.child) for steps in way for step in steps):
        raise _circle(transform)
    return mounted(transform, Transform(se3.rigid(way.pose()), link, transform.parent))


def _check_joint(mine: list[Element], robot: Element) -> None:
    """Refuse where what leads to the child is not one fixed joint that is written out."""
    names = ", ".join(repr(joint.attributes.get("name", "?")) for joint in mine)
    if len(mine) > 1:
        child = _link(mine[0], "child")
        raise UsageError(f"{child!r} is the child of {len(mine)} joints: {names}")
    if mine[0] not in robot.children:
        raise UsageError(f"joint {names} stands inside a macro or condition; expand it first")
    _check_fixed(mine[0])


def _check_link(name: str, robot: Element) -> None:
    links = [link.attributes.get("name", "") for link in robot.named("link")]
    if name not in links:
        raise UsageError(
            f"the robot has no link {name!r} for the parent; it has {len(links)}: "
            f"{', '.join(links[:20]) or 'none'}. Name the LiDAR's own link, with --parent"
        )


def _circle(transform: Transform) -> UsageError:
    return UsageError(
        f"{transform.parent!r} is below {transform.child!r} in the robot: a joint back would close "
        "a circle; export with --invert for the joint the other way"
    )


def _check_room(robot: Element, joints: list[Element], transform: Transform) -> None:
    """Refuse where a new joint would hang on nothing, close a circle or take a name twice."""
    if any(element.tag.startswith("xacro:") for element in robot.walk()):
        raise UsageError(
            f"the file is xacro and has no plain joint to {transform.child!r}, but what it "
            "includes and its macros may make one; expand it first: xacro FILE > robot.urdf"
        )
    if "xmlns:xacro" in robot.attributes and "$" in transform.parent + transform.child:
        raise UsageError("xacro takes $ in a name for an expression; expand the file first")
    _check_link(transform.parent, robot)
    above = {_link(joint, "child"): _link(joint, "parent") for joint in joints}
    at, way = transform.parent, [transform.parent]
    while at in above and above[at] not in way:
        at = above[at]
        way.append(at)
    if transform.child in way:
        raise _circle(transform)
    name = f"{transform.child}_joint"
    if any(joint.attributes.get("name") == name for joint in robot.named("joint")):
        raise UsageError(f"the robot has a joint {name!r} already, for another child")


def _with_origin(scan: Scan, joint: Element, transform: Transform) -> bytes:
    """Set the origin of a joint that is there."""
    origins = joint.named("origin")
    if origins:
        start, end = origins[0].start, origins[0].head_end
        tag = with_attributes(scan.text(start, end), _origin(transform))
    else:
        start = end = joint.named("child")[0].end
        before = _indent(scan, joint.named("child")[0].start)
        tag = ("" if before is None else _newline(scan) + before) + _origin_tag(transform)
    return scan.data[:start] + scan.encode(tag) + scan.data[end:]


def _with_joint(scan: Scan, transform: Transform) -> bytes:
    """Add a joint, and the child's link where it is missing, as the last of the robot."""
    robot = scan.root
    newline, indent = _newline(scan), _indent(scan, robot.children[0].start) or "  "
    lines = _joint(transform, indent)
    if transform.child not in [link.attributes.get("name") for link in robot.named("link")]:
        lines.insert(0, f"<link name={_quote(transform.child)}/>")
    block = "".join(f"{indent}{line}{newline}" for line in lines)
    last = _indent(scan, robot.foot)
    at = robot.foot - len(scan.encode(last or ""))
    block = block if last is not None else newline + block
    return scan.data[:at] + scan.encode(block) + scan.data[at:]


def _indent(scan: Scan, at: int) -> str | None:
    """Blanks before a byte on its line; None where something else stands there."""
    found = re.search(r"[\r\n]([^\S\r\n]*)\Z", scan.text(scan.root.start, at))
    return found and found[1]


def _newline(scan: Scan) -> str:
    """The line ending that the file uses first."""
    found = re.search(r"\r\n|\r|\n", scan.text(scan.root.start, scan.root.end))
    return found[0] if found else "\n"
