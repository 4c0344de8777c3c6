"""A frame may be called anything: it reaches every format as it is, or is refused in one line."""

from __future__ import annotations

import ast
import json
import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.base.errors import UsageError
from retropole.export import FORMATS, Transform, put_into_urdf, read_transform
from retropole.export.transform import LONGEST_NAME
from tests.export.test_export import ROUNDING
from tests.tiers import first_of

T = se3.random(np.random.default_rng(12))
TOUCH = "touch touched"
"""What a name tries to run; a file of this name in the working folder shows that it ran."""

NAMES = {
    "semicolon": f"a; {TOUCH};",
    "pipe": f"a | {TOUCH} &",
    "quote": f"it's '; {TOUCH}; '",
    "double quote": f'a"; {TOUCH}; "b',
    "both quotes": "'\"'\"\"'",
    "substitution": f"$({TOUCH})",
    "braces": "${HOME}{a,b}${{x}}",
    "backtick": f"`{TOUCH}`",
    "history": "!! !x",
    "glob": "*?[a-z]~/x",
    "redirection": "a > touched",
    "backslash": "a\\",
    "backslash n": "a\\nb\\u000ac",
    "dash": "-x",
    "dashes": "--",
    "flag": "--frame-id",
    "help": "--help",
    "assignment": "A=touched",
    "comment": "# x",
    "no comment": "a#b",
    "colon": "a: b",
    "yaml": "- {a: [b]}, &x *x !!python/object/apply:os.system ['touch touched'] | >",
    "yaml word": "No",
    "yaml number": "1e3",
    "yaml merge": "<<",
    "yaml question": "? a",
    "percent": "%YAML %s %d",
    "markup": "<script>alert(1)</script>",
    "attribute": '"/><link name="x',
    "entity": "&lt;&amp;&#65;&x;",
    "cdata": "<![CDATA[x]]>",
    "comment ends": "a --> b",
    "two dashes": "a--b",
    "dash at the end": "a-",
    "processing": "<?php x ?>",
    "unicode": "höhe 上 🛰 é \U0001f469",
    "right to left": "שלום",
    "blanks inside": "a  b",
    "words": "maps points of b into a; parent: a, child: b",
    "bracket": "x]y[z",
    "slashes": "a//b",
    "cookie": "coding:utf_7 +AAoA-",
    "cookie of latin": "coding: latin1 é",
    "template": "{{x}} {0} %(x)s",
    "python": "' + __import__('os').system('touch touched') + '",
    "python lines": "'''\"\"\"",
    "longest": "x" * LONGEST_NAME,
    "longest of quotes": '"\\' * (LONGEST_NAME // 2),
}
REFUSED = {
    "newline": f"a\n{TOUCH}\n",
    "carriage return": "a\rb",
    "tab": "a\tb",
    "nul": "a\0b",
    "escape": "\x1b]0;title\x07",
    "delete": "a\x7f",
    "next line": "a\x85b",
    "line separator": "a\u2028b",
    "no-break space": "a\u00a0b",
    "right-to-left override": "a\u202eb",
    "zero width": "a\u200bb",
    "byte order mark": "\ufeffa",
    "lone surrogate": "a\udcffb",
    "no character": "a\uffffb",
    "empty": "",
    "blank": "  ",
    "too long": "x" * (LONGEST_NAME + 1),
    "10,000 characters": "x" * 10_000,
}


def of_shell(text: str, folder: Path, shell: list[str]) -> tuple[Array, str, str]:
    """Run the line; in place of ROS, a program that writes its arguments down."""
    stub = folder / "bin"
    stub.mkdir(exist_ok=True)
    for program in ("rosrun", "ros2"):
        (stub / program).write_text("#!/bin/sh\nprintf '%s\\0' \"$@\" > said\n")
        (stub / program).chmod(0o755)
    (folder / "said").unlink(missing_ok=True)
    subprocess.run(
        shell,
        input=text.encode(),
        cwd=folder,
        env={**os.environ, "PATH": f"{stub}:{os.environ['PATH']}"},
        capture_output=True,
        timeout=60,
        check=False,
    )
    said = (folder / "said").read_text(encoding="utf-8").split("\0")[:-1]
    words = said[said.index("static_transform_publisher") + 1 :]
    if len(words) == 9:
        return pose([float(w) for w in words[:7]]), words[7], words[8]
    assert words[::2] == [
        *(f"--{name}" for name in ("x", "y", "z", "qx", "qy", "qz", "qw")),
        "--frame-id",
        "--child-frame-id",
    ]
    values = words[1::2]
    return pose([float(w) for w in values[:7]]), values[7], values[8]


def pose(values: list[float]) -> Array:
    return se3.from_quaternion_xyzw(np.array(values[3:]), np.array(values[:3]))


def of_script(text: str, folder: Path) -> tuple[Array, str, str]:
    return of_shell(text, folder, ["sh"])


def of_launch(text: str, _: Path) -> tuple[Array, str, str]:
    (call,) = (
        node
        # From bytes, as Python reads it: a comment may name an encoding.
        for node in ast.walk(ast.parse(text.encode()))
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Node"
    )
    (arguments,) = (k.value for k in call.keywords if k.arg == "arguments")
    values = ast.literal_eval(arguments)[1::2]
    return pose([float(w) for w in values[:7]]), values[7], values[8]


def of_urdf(text: str, _: Path) -> tuple[Array, str, str]:
    robot = ElementTree.fromstring(text.encode())
    assert [e.tag for e in robot.iter()] == ["robot", *["link"] * 2, *TAGS_OF_A_JOINT]
    links = [link.attrib["name"] for link in robot.findall("link")]
    parent, child = (robot.find(f"joint/{e}").attrib["link"] for e in ("parent", "child"))  # type: ignore[union-attr]
    assert links == [parent, child]
    origin = robot.find("joint/origin")
    assert origin is not None
    xyz, rpy = (np.array(origin.attrib[k].split(), dtype=float) for k in ("xyz", "rpy"))
    return se3.from_rt(se3.rotation_from_rpy(rpy), xyz), parent, child


TAGS_OF_A_JOINT = ["joint", "parent", "child", "origin"]


def of_yaml(text: str, _: Path) -> tuple[Array, str, str]:
    yaml = pytest.importorskip("yaml")
    ((parent, children),) = yaml.safe_load(text).items()
    ((child, values),) = children.items()
    xyz, rpy = (np.array([values[k] for k in ks]) for ks in (("x", "y", "z"), RPY))
    return se3.from_rt(se3.rotation_from_rpy(rpy), xyz), parent, child


RPY = ("roll", "pitch", "yaw")


def of_json(text: str, _: Path) -> tuple[Array, str, str]:
    document = json.loads(text)
    return np.array(document["T_target_source"]), document["parent"], document["child"]


def of_lines(text: str, _: Path) -> tuple[Array, None, None]:
    """``name: number`` below comments; the names stand in those alone."""
    assert [line.startswith("#") for line in text.splitlines()] == [True] * 2 + [False] * (
        len(text.splitlines()) - 2
    )
    values = [float(line.split(": ")[1]) for line in text.splitlines()[2:]]
    if len(values) == 7:
        return pose(values), None, None
    return (
        se3.from_rt(se3.rotation_from_rpy(np.array(values[3:])), np.array(values[:3])),
        None,
        None,
    )


def of_matrix(text: str, folder: Path) -> tuple[Array, None, None]:
    (folder / "m").write_text(text)
    return np.loadtxt(folder / "m"), None, None


def of_cloudcompare(text: str, _: Path) -> tuple[Array, None, None]:
    numbers, bracket, note = text.partition("[")
    assert bracket
    assert note.count("[") == 0
    assert note.endswith("]\n")
    assert note.count("]") == 1
    return np.array(numbers.split(), dtype=float).reshape(4, 4), None, None


def of_driver(text: str, _: Path) -> tuple[Array, None, None]:
    """What YAML has below comments, as the drivers of RoboSense and Hesai turn points by it."""
    yaml = pytest.importorskip("yaml")
    values = yaml.safe_load(text)
    assert values.pop("transform_flag", True) is True
    assert list(values) == ["x", "y", "z", *RPY]
    return turned(*(values[name] for name in values)), None, None


def of_livox(text: str, _: Path) -> tuple[Array, None, None]:
    values = json.loads(text)["extrinsic_parameter"]
    assert all(isinstance(values[axis], int) for axis in "xyz")
    angles = np.radians([values[name] for name in RPY])
    return turned(*(values[axis] / 1000 for axis in "xyz"), *angles), None, None


def turned(x: float, y: float, z: float, roll: float, pitch: float, yaw: float) -> Array:
    """Write out the matrix of these drivers: livox_ros_driver2, ``SetLidarsExtParam``; Hesai's
    SDK, ``TransformPoint``; rs_driver, ``Translation · Rz · Ry · Rx``.
    """
    (a, b, c), (sa, sb, sc) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
    return np.array(
        [
            [b * c, sa * sb * c - a * sc, a * sb * c + sa * sc, x],
            [b * sc, sa * sb * sc + a * c, a * sb * sc - sa * c, y],
            [-sb, sa * b, a * b, z],
            [0, 0, 0, 1],
        ]
    )


def of_ouster(text: str, folder: Path) -> tuple[Array, None, None]:
    """Run the line, and read what ouster-cli is given: seven numbers, as its SDK takes them."""
    stub = folder / "bin" / "ouster-cli"
    stub.parent.mkdir(exist_ok=True)
    stub.write_text("#!/bin/sh\nprintf '%s\\0' \"$@\" > said\n")
    stub.chmod(0o755)
    path = f"{stub.parent}:{os.environ['PATH']}"
    subprocess.run(
        ["sh"], input=text.encode(), cwd=folder, env={**os.environ, "PATH": path}, check=True
    )
    words = (folder / "said").read_text(encoding="utf-8").split("\0")[:-1]
    assert words[:2] + words[3:] == ["source", "-e", "SOURCE", "viz"]
    return pose([float(word) for word in words[2].split(" ")]), None, None


OWN_READER: dict[str, Callable[[str, Path], tuple[Array, str | None, str | None]]] = {
    "matrix": of_matrix,
    "json": of_json,
    "yaml": of_yaml,
    "urdf": of_urdf,
    "ros1": of_script,
    "ros2": of_script,
    "launch": of_launch,
    "quaternion": of_lines,
    "rpy": of_lines,
    "cloudcompare": of_cloudcompare,
    "livox": of_livox,
    "rslidar": of_driver,
    "hesai": of_driver,
    "ouster": of_ouster,
}


@pytest.mark.parametrize("fmt", first_of(FORMATS, 5))
def test_every_name_reaches_its_format_as_it_is(
    fmt: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for what, name in NAMES.items():
        for parent, child in ((name, "b"), ("a", name)):
            text = FORMATS[fmt].write(Transform(T, parent, child))
            found, *names = OWN_READER[fmt](text, tmp_path)
            atol = ROUNDING.get(fmt, 1e-12)
            np.testing.assert_allclose(found, T, atol=atol)
            assert names in ([parent, child], [None, None]), what
            assert not (tmp_path / "touched").exists(), what
            path = tmp_path / "exported"
            path.write_text(text, encoding="utf-8")
            back = read_transform(path, fmt=fmt)
            assert (back.parent, back.child) == (parent, child), what
            np.testing.assert_allclose(back.T_parent_child, T, atol=atol)


@pytest.mark.parametrize("what", REFUSED)
def test_what_no_format_can_hold_is_refused_in_one_line(what: str) -> None:
    for names in ((REFUSED[what], "b"), ("a", REFUSED[what])):
        with pytest.raises(UsageError) as refused:
            Transform(T, *names)
        message = str(refused.value)
        assert message.isprintable()
        assert len(message) < 300
        assert ("parent" if names[1] == "b" else "child") in message


@pytest.mark.parametrize(
    ("fmt", "name"),
    [("ros1", "a:=b"), ("ros1", "__name:=x"), ("ros2", "--ros-args"), ("launch", "--ros-args")],
)
def test_what_ros_would_take_out_of_the_arguments_is_refused(fmt: str, name: str) -> None:
    for names in ((name, "b"), ("a", name)):
        with pytest.raises(UsageError, match="name"):
            FORMATS[fmt].write(Transform(T, *names))


@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not installed")
@pytest.mark.parametrize("fmt", ["ros1", "ros2"])
def test_pasting_the_comment_with_the_line_runs_no_name(fmt: str, tmp_path: Path) -> None:
    """At its prompt, zsh takes no comments; nor does bash where it is told so."""
    prompt = ["bash", "--norc", "--noprofile", "-i", "+O", "interactive_comments"]
    for what in ("substitution", "backtick", "double quote", "history", "backslash", "semicolon"):
        text = FORMATS[fmt].write(Transform(T, "a", NAMES[what]))
        assert of_shell(text, tmp_path, prompt)[2] == NAMES[what], what
        assert not (tmp_path / "touched").exists(), what


# --- into a URDF that is there --------------------------------------------------------------------

ENCODINGS = ("utf-8", "utf-16", "iso-8859-1", "us-ascii")


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_every_name_reaches_a_robot_that_is_there(encoding: str) -> None:
    robot = f'<?xml version="1.0" encoding="{encoding}"?>\n<robot name="r">\n  <link name="a"/>\n'
    data = f"{robot}  <!-- last -->\n</robot>\n".encode(encoding)
    for what, name in NAMES.items():
        out = put_into_urdf(data, Transform(T, "a", name))
        root = ElementTree.fromstring(out)
        tags = ["robot", "link", "link", *TAGS_OF_A_JOINT]
        assert [e.tag for e in root.iter()] == tags, what
        child, joint = root.find("joint/child"), root.find("joint")
        assert child is not None
        assert joint is not None
        assert child.attrib == {"link": name}, what
        assert joint.attrib["name"] == f"{name}_joint", what
        # Once more: the joint is found again, and only its origin changes.
        moved = put_into_urdf(out, Transform(np.eye(4), "a", name))
        assert len(moved) <= len(out), what
        assert put_into_urdf(moved, Transform(T, "a", name)) == out, what


def test_xacro_would_evaluate_a_name_with_a_dollar() -> None:
    data = b'<robot name="r" xmlns:xacro="http://ros.org/wiki/xacro"><link name="a"/></robot>'
    assert b"b_joint" in put_into_urdf(data, Transform(T, "a", "b"))
    for name in ("$(touch x)", "${1+1}", "a$b"):
        with pytest.raises(UsageError, match="xacro"):
            put_into_urdf(data, Transform(T, "a", name))
