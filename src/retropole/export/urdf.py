"""URDF: a separate fixed joint, or put into a robot that else stays as it is.

The origin of a joint is the pose of the child in the parent: ``T_parent_child``. Its ``rpy`` are
angles about fixed axes, x then y then z. XML that others wrote is read by the standard library and
edited by lxml, never with a DOCTYPE.
"""

from __future__ import annotations

import codecs
import re
from collections.abc import Sequence
from functools import partial
from html import escape
from typing import Any
from xml.etree.ElementTree import XML, Element, ParseError, TreeBuilder, XMLParser

import numpy as np

from ..base import se3
from ..base.datatypes import Array
from ..base.errors import MissingExtraError, ReadError, UsageError, said
from .text import RPY, pose_values, to_float
from .transform import Found, Transform, from_rpy, mounted, way_between


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


def _joint(transform: Transform, indent: str) -> list[str]:
    """Lines of the joint, under a comment that says in words what it maps."""
    name = _quote(f"{transform.child}_joint")
    origin = " ".join(f'{key}="{value}"' for key, value in _origin(transform).items())
    return [
        *(f"<!-- {note} -->" for note in transform.notes),
        f'<joint name={name} type="fixed">',
        f"{indent}<parent link={_quote(transform.parent)}/>",
        f"{indent}<child link={_quote(transform.child)}/>",
        f"{indent}<origin {origin}/>",
        "</joint>",
    ]


def read_urdf(data: bytes) -> list[Found]:
    """Read the joints of a robot; the pose of one that moves is refused when it is requested."""
    return _found(_robot(read_xml(data)))


def _robot(root: Element) -> Element:
    name = root.tag.rpartition("}")[2]
    if name != "robot":
        raise ReadError(f"no URDF: the root element is <{name}>, not <robot>")
    return root


def _qualified(element: Element, tag: str) -> str:
    """Tag in the namespace of an element: some robots declare one for all that has no prefix."""
    return element.tag[: element.tag.rfind("}") + 1] + tag


def _named(element: Element, tag: str) -> list[Element]:
    """Children with a tag, in the namespace of their parent."""
    return element.findall(_qualified(element, tag))


def _found(robot: Element) -> list[Found]:
    return [
        Found(_link(joint, "parent"), _link(joint, "child"), partial(_pose, joint))
        for joint in _named(robot, "joint")
    ]


def _link(joint: Element, role: str) -> str:
    """Link that a joint names as its parent or child; empty if it names none."""
    named = _named(joint, role)
    return named[0].get("link", "") if len(named) == 1 else ""


def _pose(joint: Element) -> Array:
    """``T_parent_child`` of a fixed joint; what is not given is zero."""
    _check_fixed(joint)
    values = {"xyz": "0 0 0", "rpy": "0 0 0"}
    for origin in _named(joint, "origin"):
        values |= origin.attrib
    return from_rpy(_three(values["xyz"], "xyz"), _three(values["rpy"], "rpy"))


def _check_fixed(joint: Element) -> None:
    name, kind, origins = joint.get("name", "?"), joint.get("type"), _named(joint, "origin")
    if kind != "fixed":
        raise ReadError(f"joint {name!r} is {kind}, not fixed: its origin is not the whole pose")
    if any("$" in value for origin in origins for value in origin.attrib.values()):
        raise ReadError(
            f"the origin of joint {name!r} is an expression; expand the file first: xacro FILE > "
            "robot.urdf"
        )
    if len(origins) > 1:
        raise ReadError(f"joint {name!r} has {len(origins)} origins, not one")


def _three(text: str, name: str) -> Array:
    numbers = text.split()
    if len(numbers) != 3:
        raise ReadError(f"{name}={text!r} is not three numbers")
    return np.array([to_float(word) for word in numbers])


def put_into_urdf(data: bytes, transform: Transform) -> bytes:
    """Write a transform into a robot, and leave the rest of the file unchanged.

    The joint to the child is written. Where it starts at another link than the parent,
    its origin is the way there from that link, over fixed joints, times the transform: the robot
    then has both LiDARs as the transform says. Where the child has no joint yet, one is added at
    the end of the robot, and the child's link with it if that is missing. Needs the extra ``urdf``.

    Parameters
    ----------
    data
        The URDF file.
    transform
        Names and pose; the parent must be a link of the robot.

    Returns
    -------
    bytes
        The file with the joint, in the original encoding, indentation and line endings.

    Raises
    ------
    MissingExtraError
        Where lxml is not installed.
    ReadError
        If it is not a well-formed URDF, or if a joint on the way moves or is an expression.
    UsageError
        If it is unclear what to change: the parent is not a link, or is not connected with the
        link that the child's joint starts at; the child has several joints; its joint moves or is
        an expression; or it would close a circle.
    """
    robot: Any = _robot(xml_to_edit(data))
    joints = robot.iter(_qualified(robot, "joint"))
    mine = [joint for joint in joints if _link(joint, "child") == transform.child]
    if mine:
        _check_joint(mine, robot)
        _set_origin(mine[0], _from_link(_link(mine[0], "parent"), robot, transform))
    else:
        _check_room(robot, transform)
        _add_joint(robot, transform)
    return edited_xml(robot, data)


def _from_link(link: str, robot: Element, transform: Transform) -> Transform:
    """Give the pose of the child in the link that its joint starts at."""
    if link == transform.parent:
        return transform
    _check_parent(robot, transform)
    way = way_between(_found(robot), link, transform.parent)
    if way is None:
        raise UsageError(
            f"no joints lead from {link!r}, where the joint to {transform.child!r} starts, to "
            f"{transform.parent!r}: the robot does not define where {transform.parent!r} is on it"
        )
    return mounted(transform, Transform(se3.rigid(way.pose()), link, transform.parent))


def _check_joint(mine: list[Any], robot: Any) -> None:
    """Refuse where the path to the child is not one fixed joint that is written out."""
    names = ", ".join(repr(joint.get("name", "?")) for joint in mine)
    if len(mine) > 1:
        child = _link(mine[0], "child")
        raise UsageError(f"{child!r} is the child of {len(mine)} joints: {names}")
    if mine[0].getparent() is not robot:
        raise UsageError(f"joint {names} is inside a macro or condition; expand it first")
    _check_fixed(mine[0])


def _links(robot: Element) -> list[str]:
    return [link.get("name", "") for link in _named(robot, "link")]


def _check_parent(robot: Element, transform: Transform) -> None:
    """Refuse if the parent is not a link, or is below the child: a joint would close a circle."""
    parent, child, links = transform.parent, transform.child, _links(robot)
    if parent not in links:
        raise UsageError(
            f"the robot has no link {parent!r} for the parent; it has {len(links)}: "
            f"{', '.join(links[:20]) or 'none'}. Name the link of the LiDAR, with --parent"
        )
    way = way_between(_found(robot), child, parent)
    if way is not None and not way.of_parent:
        raise UsageError(
            f"{parent!r} is below {child!r} in the robot: a joint back would form a "
            "loop; export with --invert for the opposite joint"
        )


def _check_room(robot: Any, transform: Transform) -> None:
    """Refuse where a new joint would depend on nothing, close a circle or take a name twice."""
    if any(element.prefix == "xacro" for element in robot.iter("*")):
        raise UsageError(
            f"the file is xacro and has no plain joint to {transform.child!r}, but its includes "
            "and macros may create one; expand it first: xacro FILE > robot.urdf"
        )
    if "xacro" in robot.nsmap and "$" in transform.parent + transform.child:
        raise UsageError("xacro reads $ in a name as an expression; expand the file first")
    _check_parent(robot, transform)
    name = f"{transform.child}_joint"
    if any(joint.get("name") == name for joint in _named(robot, "joint")):
        raise UsageError(f"the robot has a joint {name!r} already, for another child")


def _set_origin(joint: Any, transform: Transform) -> None:
    """Set the origin of a joint that is there; one that is missing becomes its first element."""
    origin = joint.find(_qualified(joint, "origin"))
    if origin is None:
        origin = joint.makeelement("origin")
        origin.tail = joint.text
        joint.insert(0, origin)
    origin.attrib.update(_origin(transform))


def _add_joint(robot: Any, transform: Transform) -> None:
    """Add a joint, and the child's link where it is missing, as the last of the robot."""
    before = (robot.text or "").rpartition("\n")[2]
    indent = before if before.isspace() else "  "
    lines = _joint(transform, indent)
    if transform.child not in _links(robot):
        lines.insert(0, f"<link name={_quote(transform.child)}/>")
    newline = f"\n{indent}"
    new = list(xml_to_edit(f"<robot>{newline.join(lines)}</robot>".encode()))
    # What is before the end tag of the robot ends up behind the new elements.
    last = robot[-1]
    text, _, foot = (last.tail or "").rpartition("\n")
    last.tail, new[-1].tail = text + newline, f"\n{foot}"
    robot.extend(new)


def is_xml(data: bytes) -> bool:
    """Recognize XML, in any encoding, by how it begins."""
    return data.lstrip().startswith((b"<", b"\xef\xbb\xbf<", b"\xff\xfe", b"\xfe\xff"))


class _WithoutDoctype(TreeBuilder):
    def doctype(self, *_: object) -> None:
        raise ReadError("the XML has a DOCTYPE; such files are not accepted")


def read_xml(data: bytes) -> Element:
    """Parse an XML file; gives its root element.

    Raises
    ------
    ReadError
        For what is not well-formed, and for a DOCTYPE: entities can blow a small file up, and none
        of the files read here need one.
    """
    try:
        return XML(data, XMLParser(target=_WithoutDoctype()))
    except ParseError as error:
        raise ReadError(f"no well-formed XML: {said(error)}") from None
    except (LookupError, ValueError) as error:
        raise ReadError(f"cannot decode the XML: {said(error)}") from None


def xml_to_edit(data: bytes) -> Any:
    """Parse an XML file with its comments and processing instructions; needs the extra ``urdf``.

    Returns
    -------
    lxml.etree._Element
        The root element; `edited_xml` writes it again.

    Raises
    ------
    MissingExtraError
        Where lxml is not installed.
    ReadError
        As `read_xml`, and for elements nested deeper than 256.
    """
    try:
        from lxml import etree
    except ImportError:
        raise MissingExtraError("urdf", "putting a joint into a URDF") from None
    read_xml(data)
    parser = etree.XMLParser(
        resolve_entities=False,
        no_network=True,
        load_dtd=False,
        huge_tree=False,
        strip_cdata=False,
    )
    try:
        return etree.fromstring(data, parser)
    except etree.XMLSyntaxError as error:
        raise ReadError(f"cannot edit the XML: {said(error)}") from None


def edited_xml(root: Any, data: bytes) -> bytes:
    """Write the root element of `xml_to_edit` into the file that it was parsed from.

    Parameters
    ----------
    root
        The lxml element.
    data
        That file. What is before the root element is taken from there as it is.

    Returns
    -------
    bytes
        In the encoding and with the line endings of `data`; what the encoding lacks is written as
        character references.
    """
    from lxml import etree

    is_utf_16 = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    codec: str = "utf-16" if is_utf_16 else root.getroottree().docinfo.encoding
    before = data.decode(codec)
    text: str = re.findall(r"\A\ufeff?(?:\s+|<\?.*?\?>|<!--.*?-->)*", before, re.DOTALL)[0]
    text += etree.tostring(root, encoding="unicode", with_tail=False) + "\n"
    # Comments and the like. By `tostring`, the time would grow with the square of their number.
    text += "".join(f"{node}\n" for node in root.itersiblings())
    if "\r\n" in before:
        text = text.replace("\r\n", "\n").replace("\n", "\r\n")
    return text.encode(codec, "xmlcharrefreplace")
