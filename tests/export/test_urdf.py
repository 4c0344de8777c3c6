"""A joint in a URDF: other programs read it, and the rest of the file says what it said."""

import io
import math
import re
import sys
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.base.errors import MissingExtraError, ReadError, UsageError
from retropole.export import (
    Transform,
    export_lines,
    inverted,
    put_into_urdf,
    read_transform,
)
from retropole.export.transform import from_rpy
from retropole.export.urdf import edited_xml, is_xml, read_urdf, read_xml, write_urdf, xml_to_edit

T = se3.random(np.random.default_rng(1))
TRANSFORM = Transform(T, "front", "rear")

ROBOT = """<?xml version="1.0" encoding="utf-8"?>

<!-- rear > front -->
<?xml-stylesheet  href='a.css'?>
<robot name="car">
    <link name="base"><!-- <joint/> --></link>
    <link name="front"/>
    <joint name="j1"   type="fixed">
        <parent link="base"/><child link="front"/>
        <origin rpy='0 0  0'
                xyz = "1 2 3" />   <!-- measured <origin xyz="9 9 9"/> -->
    </joint>
    <link name="rear" />
    <joint name="a > b" type="fixed">
        <origin rpy='0 0  0'
                xyz = "1 2 3" note="x>y" />\t<!-- by tape -->
        <parent link="front"/>
        <child link="rear"/>
    </joint>
    <gazebo reference="rear"><![CDATA[<origin xyz="0 0 0"/>]]></gazebo>
    <transmission name="t"><joint name="j1"/></transmission>
</robot>

<!-- the end -->
"""
NO_REAR = re.sub(r"    <link name=\"rear\" />.*?</joint>\n", "", ROBOT, flags=re.S)


def pose_by_other_program(data: bytes) -> Array:
    """Pose of the joint to ``rear``, as urdf_parser_py has it."""
    urdf = pytest.importorskip("urdf_parser_py.urdf")
    robot = urdf.URDF.from_xml_string(data)
    assert robot.parent_map["rear"][1] == "front"
    joint = robot.joint_map[robot.parent_map["rear"][0]]
    assert joint.type == "fixed"
    cr, cp, cy = np.cos(joint.origin.rpy)
    sr, sp, sy = np.sin(joint.origin.rpy)
    Rx = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    Ry = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    Rz = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return se3.from_rt(Rz @ Ry @ Rx, np.array(joint.origin.xyz))


@pytest.mark.parametrize("pitch", [0.3, math.pi / 2, -math.pi / 2 + 1e-8])
def test_another_program_reads_the_pose(pitch: float) -> None:
    T = from_rpy(np.array([1.0, -2, 1e-9]), np.array([0.4, pitch, -3.0]))
    data = export_lines(T, "front", "rear")["urdf"].encode()
    np.testing.assert_allclose(pose_by_other_program(data), T, rtol=0, atol=1e-9)


@pytest.mark.parametrize("robot", [ROBOT, NO_REAR], ids=["replaced", "added"])
def test_another_program_reads_the_pose_from_the_robot(robot: str) -> None:
    # The parser wants neither bare gazebo text nor half a transmission.
    plain = re.sub(r"    <(gazebo|transmission).*\n", "", robot).replace(' note="x>y"', "")
    out = put_into_urdf(plain.encode(), TRANSFORM)
    np.testing.assert_allclose(pose_by_other_program(out), T, rtol=0, atol=1e-9)


def test_names_are_escaped_for_xml() -> None:
    name = "<script>alert('1')</script> & \"so\" -->"
    data = export_lines(T, "front", name)["urdf"].encode()
    assert b"<script" not in data
    (comment,) = re.findall(rb"<!--(.*)-->\n", data)
    assert b"--" not in comment
    links = ElementTree.fromstring(data).findall("link")
    assert [link.get("name") for link in links] == ["front", name]


codecs = pytest.mark.parametrize(
    "codec", ["utf-8", "utf-8-sig", "utf-16", "iso-8859-1", "us-ascii"]
)
newlines = pytest.mark.parametrize("newline", ["\n", "\r\n"])


def as_file(text: str, newline: str, codec: str) -> bytes:
    """Encode a file whose declaration names its codec (a byte order mark is no codec)."""
    declared = "utf-8" if codec == "utf-8-sig" else codec
    return text.replace("\n", newline).replace("utf-8", declared, 1).encode(codec)


def canonical(data: bytes) -> list[str]:
    """Lines of what an XML file says, whatever white space and quotes its tags have."""
    return ElementTree.canonicalize(from_file=io.BytesIO(data), with_comments=True).split("\n")


def hold_as_the_file_is(before: bytes, after: bytes, newline: str, codec: str) -> None:
    """Encoding, declaration and line endings are those of before; order and CDATA too."""
    old, new = before.decode(codec), after.decode(codec)
    assert new.encode(codec) == after
    assert new.startswith(old[: old.index("<robot")])
    assert "\n" not in new.replace(newline, "")
    assert new.count("<![CDATA[<origin") == 1
    there = [list(e.attrib) for e in ElementTree.fromstring(before).iter()]
    assert [list(e.attrib) for e in ElementTree.fromstring(after).iter()][: len(there)] == there


@codecs
@newlines
def test_replacing_changes_the_two_values_only(newline: str, codec: str) -> None:
    before = as_file(
        ROBOT.replace("measured", "gemäß" if codec != "us-ascii" else "x"), newline, codec
    )
    after = put_into_urdf(before, TRANSFORM)
    hold_as_the_file_is(before, after, newline, codec)
    lines, old = canonical(after), canonical(before)
    (at,) = [k for k, line in enumerate(lines) if line != old[k]]
    assert 'note="x>y"' in lines[at]
    lines[at] = re.sub('rpy="[^"]*"', 'rpy="0 0  0"', lines[at])
    lines[at] = re.sub('xyz="[^"]*"', 'xyz="1 2 3"', lines[at])
    assert lines == old


@codecs
@newlines
def test_adding_puts_lines_before_the_end_only(newline: str, codec: str) -> None:
    before = as_file(NO_REAR, newline, codec)
    after = put_into_urdf(before, TRANSFORM)
    hold_as_the_file_is(before, after, newline, codec)
    lines, old = canonical(after), canonical(before)
    at, count = old.index("</robot>"), len(lines) - len(old)
    assert lines[:at] + lines[at + count :] == old
    added = lines[at : at + count]
    assert all(re.match(r"    (    )?<\S", line) for line in added)
    assert [line.strip()[:6] for line in added[:3]] == ["<link ", "<!-- m", "<joint"]
    assert put_into_urdf(after, TRANSFORM) == after


def test_a_link_that_is_there_is_not_added_twice() -> None:
    robot = NO_REAR.replace("</robot>", '<link name="rear"/></robot>')
    out = put_into_urdf(robot.encode(), TRANSFORM).decode()
    assert out.count('<link name="rear"/>') == 1
    assert '<link name="rear"/>\n    <!-- maps points of rear into front;' in out


def test_a_joint_without_origin_gets_one() -> None:
    robot = re.sub(r"        <origin rpy='0 0  0'\n[^\n]*note[^\n]*\n", "", ROBOT)
    out = put_into_urdf(robot.encode(), TRANSFORM).decode()
    (line,) = re.findall(r'\n        <origin xyz="[^"]*" rpy="[^"]*"/>(?=\n        <parent)', out)
    assert canonical(out.replace(line, "").encode()) == canonical(robot.encode())


@settings(max_examples=60, deadline=None)
@given(rng=st.integers(0, 2**32 - 1).map(np.random.default_rng))
@pytest.mark.full
def test_what_was_put_in_is_read_and_putting_it_again_changes_nothing(
    rng: np.random.Generator,
) -> None:
    transform = Transform(se3.random(rng), "front", "rear")
    for robot in (ROBOT, NO_REAR):
        once = put_into_urdf(robot.encode(), transform)
        assert put_into_urdf(once, transform) == once


def test_one_joint_of_a_robot_is_read(tmp_path: Path) -> None:
    path = tmp_path / "robot.urdf"
    path.write_bytes(put_into_urdf(ROBOT.encode(), TRANSFORM))
    with pytest.raises(ReadError, match="base -> front, front -> rear"):
        read_transform(path)
    back = read_transform(path, child="rear")
    assert (back.parent, back.child) == ("front", "rear")
    np.testing.assert_allclose(back.T_parent_child, T, rtol=0, atol=1e-9)


BESIDE = Transform(T, "front", "side")
"""Of a LiDAR that is on the base as the front one is."""

ON_BASE = (
    '<link name="side"/><joint name="s" type="fixed"><parent link="base"/><child link="side"/>'
    '<origin xyz="9 9 9" rpy="0 0 1"/></joint></robot>'
)

SECOND = '<joint name="k" type="fixed"><parent link="base"/><child link="rear"/></joint></robot>'


@pytest.mark.parametrize(
    ("old", "new", "transform", "reason"),
    [
        ('<parent link="front"/>', '<parent link="top"/>', TRANSFORM, "no joints lead from 'top'"),
        ('name="j1"   type="fixed"', 'name="j1" type="revolute"', BESIDE, "'j1' is revolute"),
        ('name="j1"   type="fixed"', 'name="j1" type="floating"', BESIDE, "'j1' is floating"),
        ('xyz = "1 2 3" />', 'xyz="${x} 2 3" />', BESIDE, "'j1' is an expression"),
        ("rpy='0 0  0'", "rpy='0 0 90'", BESIDE, "degrees"),
        ('<link name="front"/>', '<link name="nose"/>', BESIDE, "no link 'front'.*--parent"),
        ("</robot>", SECOND, TRANSFORM, "child of 2 joints: 'a > b', 'k'"),
        ('"a > b" type="fixed"', '"a > b" type="revolute"', TRANSFORM, "is revolute, not fixed"),
        ('note="x>y"', 'note="${pi}"', TRANSFORM, "expression"),
        (
            "</robot>",
            "</robot>",
            Transform(T, "top", "roof"),
            "no link 'top'.*3: base, front, rear",
        ),
        ("</robot>", "</robot>", Transform(T, "rear", "base"), "loop.*--invert"),
        (
            'name="j1"   ',
            'name="roof_joint" ',
            Transform(T, "rear", "roof"),
            "'roof_joint' already",
        ),
        ('<parent link="front"/>', '<origin/><parent link="front"/>', TRANSFORM, "2 origins"),
        ('<joint name="a > b"', '<m><joint name="a > b"', TRANSFORM, "no well-formed XML"),
        ("<robot", "<!DOCTYPE robot><robot", TRANSFORM, "DOCTYPE"),
    ],
)
def test_where_it_is_unclear_what_to_change_nothing_is(
    old: str, new: str, transform: Transform, reason: str
) -> None:
    robot = ROBOT.replace(old, new, 1)
    if transform is BESIDE:
        robot = robot.replace("</robot>", ON_BASE)
    with pytest.raises((UsageError, ReadError), match=reason) as refused:
        put_into_urdf(robot.encode(), transform)
    # To call the target something else is no way out.
    assert "xport to" not in str(refused.value)


# --- both LiDARs on a base -----------------------------------------------------------------------


def chained(*joints: str) -> bytes:
    """A robot of fixed joints with random poses: ``base>mast mast>front``."""
    rng = np.random.default_rng(len(joints))
    links = dict.fromkeys(name for joint in joints for name in joint.split(">"))
    lines = [f'<link name="{name}"/>' for name in links]
    for joint in joints:
        parent, child = joint.split(">")
        xyz, rpy = (" ".join(map(str, rng.uniform(-1.5, 1.5, 3))) for _ in range(2))
        lines.append(
            f'<joint name="{joint.replace(">", "_")}" type="fixed"><parent link="{parent}"/>'
            f'<child link="{child}"/><origin xyz="{xyz}" rpy="{rpy}"/></joint>'
        )
    return f'<robot name="r">\n{chr(10).join(lines)}\n</robot>'.encode()


def in_robot(data: bytes, parent: str, child: str, folder: Path) -> Array:
    path = folder / "robot.urdf"
    path.write_bytes(data)
    return read_transform(path, parent=parent, child=child).T_parent_child


@pytest.mark.parametrize(
    "joints",
    [
        ("base>front", "base>rear"),
        ("base>mast", "mast>head", "head>front", "base>rear"),
        ("base>front", "base>tail", "tail>bumper", "bumper>rear"),
        ("base>mast", "mast>front", "base>tail", "tail>rear", "rear>mesh"),
        ("front>bracket", "bracket>rear"),
        ("front>rear",),
        ("base>front", "front>mesh"),
    ],
)
def test_the_robot_has_both_lidars_as_the_transform_says(
    joints: tuple[str, ...], tmp_path: Path
) -> None:
    before = chained(*joints)
    after = put_into_urdf(before, TRANSFORM)
    np.testing.assert_allclose(in_robot(after, "front", "rear", tmp_path), T, atol=1e-9)
    # Nothing moved but what leads to the child.
    for parent, child in (joint.split(">") for joint in joints):
        if child != "rear":
            was, now = (in_robot(data, parent, child, tmp_path) for data in (before, after))
            np.testing.assert_array_equal(now, was)
    assert put_into_urdf(after, TRANSFORM) == after
    if "base>front" not in joints or "base>rear" not in joints:
        return
    mine, theirs = (put_into_urdf(before, each) for each in (TRANSFORM, inverted(TRANSFORM)))
    np.testing.assert_allclose(in_robot(theirs, "front", "rear", tmp_path), T, atol=1e-9)
    np.testing.assert_array_equal(
        in_robot(theirs, "base", "rear", tmp_path), in_robot(before, "base", "rear", tmp_path)
    )
    assert mine != theirs


def test_another_program_reads_both_on_the_base() -> None:
    urdf = pytest.importorskip("urdf_parser_py.urdf")
    robot = urdf.URDF.from_xml_string(put_into_urdf(chained("base>front", "base>rear"), TRANSFORM))

    def pose(joint: str) -> Array:
        origin = robot.joint_map[joint].origin
        return from_rpy(np.array(origin.xyz), np.array(origin.rpy))

    np.testing.assert_allclose(pose("base_front") @ T, pose("base_rear"), rtol=0, atol=1e-9)


def test_a_target_below_the_source_is_a_circle() -> None:
    for joints in (("rear>bracket", "bracket>front", "base>rear"), ("rear>front",)):
        with pytest.raises(UsageError, match=r"below 'rear' in the robot.*--invert"):
            put_into_urdf(chained(*joints), TRANSFORM)
        back = put_into_urdf(chained(*joints), inverted(TRANSFORM))
        assert back != chained(*joints)


def test_a_joint_inside_a_macro_is_not_touched() -> None:
    robot = ROBOT.replace('<joint name="a > b"', '<macro><joint name="a > b"')
    robot = robot.replace("    <gazebo", "    </macro><gazebo")
    with pytest.raises(UsageError, match="macro"):
        put_into_urdf(robot.encode(), TRANSFORM)


def test_nothing_is_added_where_macros_may_make_the_same() -> None:
    robot = NO_REAR.replace("</robot>", '<xacro:leg prefix="rear"/></robot>')
    robot = robot.replace("<robot", '<robot xmlns:xacro="http://ros.org/wiki/xacro"')
    with pytest.raises(UsageError, match="xacro"):
        put_into_urdf(robot.encode(), TRANSFORM)


def test_a_macro_that_is_called_as_an_element_of_urdf_is_none() -> None:
    robot = ROBOT.replace("<robot", '<robot xmlns:xacro="http://ros.org/wiki/xacro"')
    robot = robot.replace('<link name="front"/>', '<xacro:link name="front"/>')
    with pytest.raises(UsageError, match="no link 'front'"):
        put_into_urdf(robot.replace("</robot>", ON_BASE).encode(), BESIDE)


@pytest.mark.parametrize("robot", [ROBOT, NO_REAR], ids=["replaced", "added"])
def test_a_robot_may_have_a_namespace(robot: str, tmp_path: Path) -> None:
    data = robot.replace("<robot", '<robot xmlns="http://drake.mit.edu"').encode()
    out = put_into_urdf(data, TRANSFORM)
    np.testing.assert_allclose(in_robot(out, "front", "rear", tmp_path), T, rtol=0, atol=1e-9)
    assert out.count(b"xmlns") == 1
    assert put_into_urdf(out, TRANSFORM) == out


def test_deep_nesting_is_no_trap() -> None:
    deep = b"<robot>" + b"<a>" * 5000 + b"</a>" * 5000 + b"</robot>"
    with pytest.raises(ReadError, match=r"cannot edit the XML.*depth"):
        put_into_urdf(deep, TRANSFORM)


def test_only_to_edit_a_robot_takes_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "lxml", None)
    (found,) = read_urdf(write_urdf(TRANSFORM).encode())
    np.testing.assert_allclose(found.pose(), T, rtol=0, atol=1e-9)
    with pytest.raises(MissingExtraError, match=r"retropole\[urdf\]"):
        put_into_urdf(ROBOT.encode(), TRANSFORM)


parsers = pytest.mark.parametrize("parse", [read_xml, xml_to_edit])

LAUGHS = "".join(f'<!ENTITY l{k + 1} "{f"&l{k};" * 10}">' for k in range(12))
"""Each entity ten times the one before."""


@parsers
@pytest.mark.parametrize("codec", ["utf-8", "utf-8-sig", "utf-16", "iso-8859-1"])
@pytest.mark.parametrize(
    ("doctype", "body"),
    [
        ("<!DOCTYPE r>", "<r/>"),
        (f'<!DOCTYPE r [<!ENTITY l0 "ha">{LAUGHS}]>', "<r>&l12;</r>"),
        (f'<!DOCTYPE r [<!ENTITY l0 "ha">{LAUGHS}]>', '<r a="&l12;"/>'),
        ('<!DOCTYPE r [<!ENTITY x SYSTEM "FILE">]>', "<r>&x;</r>"),
        ('<!DOCTYPE r [<!ENTITY % x SYSTEM "FILE">%x;]>', "<r/>"),
        ('<!DOCTYPE r SYSTEM "FILE">', "<r/>"),
        ('<!DOCTYPE r [<!ATTLIST r a CDATA "given">]>', "<r/>"),
    ],
)
def test_a_doctype_is_refused_whatever_it_holds(
    parse: Callable[[bytes], object], codec: str, doctype: str, body: str, tmp_path: Path
) -> None:
    secret = tmp_path / "secret"
    secret.write_text("secret")
    declared = "utf-8" if codec == "utf-8-sig" else codec
    text = f'<?xml version="1.0" encoding="{declared}"?>\n<!-- c -->{doctype}{body}'
    with pytest.raises(ReadError, match="DOCTYPE"):
        parse(text.replace("FILE", secret.as_uri()).encode(codec))


@parsers
@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "no well-formed XML"),
        (b"<r", "no well-formed XML"),
        (b"<r/><r/>", "no well-formed XML"),
        (b"<r>&undeclared;</r>", "undefined entity"),
        (b"<r><undeclared:e/></r>", "unbound prefix"),
        (b"<r>\xff</r>", "no well-formed XML"),
        (b'<?xml version="1.0" encoding="none"?><r/>', "cannot decode the XML"),
        (b'<?xml version="1.0" encoding="gb2312"?><r/>', "cannot decode the XML"),
    ],
)
def test_what_is_no_xml_is_refused(
    parse: Callable[[bytes], object], data: bytes, reason: str
) -> None:
    with pytest.raises(ReadError, match=reason):
        parse(data)


@pytest.mark.parametrize(
    "data",
    [
        b"<r/>\n",
        b"\xef\xbb\xbf<r/>\n",
        b"<?xml version='1.0' standalone='yes' ?>\r\n\r\n<!-- a --><r>\r\n</r>\r\n",
        b"<?p a?>\n<!-- <?p b?> -->\n<r>&lt;&#13;<!-- c --><?p d?></r>\n<!-- <r/> -->\n<?p?>\n",
        "<r a='é'/>\n".replace("'", '"').encode("utf-16"),
        '<?xml version="1.0" encoding="windows-1252"?>\n<r a="€"/>\n'.encode("cp1252"),
        b'<?xml version="1.0" encoding="us-ascii"?>\n<r a="&#8364;&#10;"/>\n',
    ],
)
def test_what_is_not_edited_is_written_as_it_was(data: bytes) -> None:
    assert is_xml(data)
    assert edited_xml(xml_to_edit(data), data) == data


def test_much_behind_the_root_takes_no_longer_than_its_size() -> None:
    data = b"<r/>\n" + b"<!---->\n" * 20_000
    assert edited_xml(xml_to_edit(data), data) == data
