"""The transform in the forms that other programs take, and the way back.

`FORMATS` has a writer and a reader for each; `read_transform` reads any format, a result
document, or the truth that ``retropole simulate`` writes. `TREE_FORMATS` hold the frames of a whole
site, which `read_tree` gives.
"""

from __future__ import annotations

import codecs
import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from ..base import se3
from ..base.datatypes import Array
from ..base.errors import ReadError, UsageError, naming, printable, said
from ..base.files import read_document
from ..base.quantities import error
from ..base.se3 import rigid
from ..result import LEVEL_FILE, ReasonDoc, ResultDoc, any_result_file
from ..result.site import SiteDoc
from .documents import (
    read_json,
    read_yaml,
    result_in,
    write_geojson,
    write_json,
    write_tree,
    write_yaml,
)
from .drivers import (
    HESAI,
    LIVOX,
    OUSTER,
    read_driver,
    read_livox,
    read_ouster,
    write_hesai,
    write_livox,
    write_ouster,
    write_rslidar,
)
from .ros import read_launch, read_ros1, read_ros2, write_launch, write_ros1, write_ros2
from .text import (
    read_matrix,
    read_named,
    write_cloudcompare,
    write_matrix,
    write_quaternion,
    write_rpy,
)
from .transform import Found, choose
from .transform import Transform as Transform
from .transform import inverted as inverted
from .transform import mounted as mounted
from .tree import Tree, notes_of, tree_of
from .urdf import is_xml, read_urdf, read_xml, write_urdf
from .urdf import put_into_urdf as put_into_urdf


class Format(NamedTuple):
    """One form of a transform: what it is, how it is written, how it is read back."""

    title: str
    write: Callable[[Transform], str]
    read: Callable[[bytes], list[Found]]


FORMATS = {
    "matrix": Format("4×4 matrix, text", write_matrix, read_matrix),
    "json": Format("JSON: matrix, parts by name, covariance", write_json, read_json),
    "yaml": Format("YAML: Autoware's sensors_calibration.yaml", write_yaml, read_yaml),
    "urdf": Format("URDF: fixed joint", write_urdf, read_urdf),
    "ros1": Format("ROS 1: static_transform_publisher", write_ros1, read_ros1),
    "ros2": Format("ROS 2: static_transform_publisher", write_ros2, read_ros2),
    "launch": Format("ROS 2: Python launch file", write_launch, read_launch),
    "quaternion": Format("translation and quaternion, text", write_quaternion, read_named),
    "rpy": Format("translation and roll, pitch, yaw, text", write_rpy, read_named),
    "cloudcompare": Format(
        "CloudCompare: Edit > Apply Transformation", write_cloudcompare, read_matrix
    ),
    "livox": Format("Livox: extrinsic_parameter of MID360_config.json", write_livox, read_livox),
    "rslidar": Format("RoboSense: config.yaml of rslidar_sdk", write_rslidar, read_driver),
    "hesai": Format("Hesai: config.yaml of hesai_ros_driver", write_hesai, read_driver),
    "ouster": Format("Ouster: extrinsics for ouster-cli and its SDK", write_ouster, read_ouster),
}


class TreeFormat(NamedTuple):
    """One form of a site's frames: what it is, and how it is written."""

    title: str
    write: Callable[[Tree], str]


def _yaml(tree: Tree) -> str:
    return write_yaml(*tree.edges, notes=notes_of(tree))


def _launch(tree: Tree) -> str:
    return write_launch(*tree.edges, notes=notes_of(tree))


def _urdf(tree: Tree) -> str:
    return write_urdf(*tree.edges, name=printable(tree.name) or "site", notes=notes_of(tree))


TREE_FORMATS = {
    "json": TreeFormat("JSON: transforms, covariances, places in the site's frame", write_tree),
    "yaml": TreeFormat("YAML: Autoware's sensors_calibration.yaml", _yaml),
    "urdf": TreeFormat("URDF: a robot with a fixed joint for each LiDAR", _urdf),
    "launch": TreeFormat("ROS 2: Python launch file with a publisher for each LiDAR", _launch),
    "geojson": TreeFormat("GeoJSON: the LiDARs on the map (RFC 7946)", write_geojson),
}

_SUFFIXES = {
    **{".json": "json", ".yaml": "yaml", ".yml": "yaml", ".urdf": "urdf"},
    **{".py": "launch", ".launch": "launch"},
}

_PUBLISHER = re.compile(r"\b(tf|tf2_ros)\s+static_transform_publisher\b")


_LIVOX = re.compile(rf'"{LIVOX}"\s*:\s*{{'.encode())


def export_lines(
    T: Array, parent: str = "target", child: str = "source", verdict: str = ""
) -> dict[str, str]:
    """Write a transform in every format, ready to copy.

    Parameters
    ----------
    T
        (4, 4) maps points of the child into the parent: ``T_target_source``.
    parent, child
        Names of the frames.
    verdict
        Of the calibration, on one line, for a comment; empty for none.

    Returns
    -------
    dict
        Name of the format (`FORMATS`) to its text.

    Raises
    ------
    ReadError, UsageError
        For a matrix that is not rigid, and for names that no frame can have.
    """
    transform = Transform(rigid(T), parent, child, verdict=verdict)
    return {name: each.write(transform) for name, each in FORMATS.items()}


def read_transform(
    path: Path, *, fmt: str | None = None, parent: str | None = None, child: str | None = None
) -> Transform:
    """Read a transform in any of `FORMATS`, from a result document or from a simulation's truth.

    Parameters
    ----------
    path
        A file, or a folder with ``result.json`` or ``site-result.json``.
    fmt
        Name of the format; None or ``auto`` to recognize it by the suffix and the content.
    parent, child
        Which transform to take where the file names its frames, also over several transforms of it;
        names of the frames if the file has none (``target`` and ``source`` unless given).

    Returns
    -------
    Transform
        ``T_parent_child``, the names, and the covariance where the file has one.

    Raises
    ------
    ReadError
        If the file is not of that format, has none or several transforms that fit, or one
        that is not rigid; the reason says so in numbers.
    UsageError
        If a frame of two LiDARs is given the name of a robot's (`transform.NO_LIDARS`).
    Refusal
        If it is a refused result.
    OSError
        If it cannot be read.
    """
    file = any_result_file(Path(path))
    data = read_document(file)
    with naming(file):
        return choose(_found_in(file, data, fmt), parent, child)


def _found_in(file: Path, data: bytes, fmt: str | None = None) -> list[Found]:
    """Transforms of a file with `data`, by the name of its format or by its content."""
    data = data.removeprefix(codecs.BOM_UTF8)
    try:
        name = fmt if fmt not in (None, "auto") else detect_format(file, data)
        if name not in FORMATS:
            raise UsageError(f"there is no format {name!r}; there are: {', '.join(FORMATS)}")
        return FORMATS[name].read(data)
    except UnicodeDecodeError as fault:
        raise ReadError(f"no text: {said(fault)}") from None


def read_mounting(path: Path, target: str | None) -> Transform:
    """Read where the LiDAR of the target is mounted, in any of `FORMATS`.

    Parameters
    ----------
    path
        The file; it names its frames.
    target
        The frame of the target; None if the file has one transform alone, which names it.

    Raises
    ------
    ReadError
        As `read_transform`.
    UsageError
        If the file does not name its frames.
    OSError
        If it cannot be read.
    """
    file = any_result_file(Path(path))
    data = read_document(file)
    with naming(file):
        found = _found_in(file, data)
        if any(each.parent is None or each.child is None for each in found):
            raise UsageError(
                "does not give the names of the frames of the mounting; write both with: "
                "retropole export FILE --to yaml --parent base_link --child front"
            )
        return choose(found, None, target)


def read_result(path: Path) -> ResultDoc | SiteDoc | None:
    """Read a result document, or that in a folder; None for any other file.

    Raises
    ------
    ReadError
        If it is not sound.
    OSError
        If it cannot be read.
    """
    return result_in(read_document(any_result_file(Path(path))))


def read_verdict(path: Path) -> list[ReasonDoc]:
    """Read what a result document warns of: empty for one that is ok, and for any other file."""
    document = read_result(path)
    return [] if document is None else document.reasons


def read_tree(path: Path) -> Tree | None:
    """Read the frames of a site from its result document, or its folder.

    Returns
    -------
    Tree or None
        With the frames of its level, where that is next to it; None if the file is another one.

    Raises
    ------
    ReadError, UsageError, MissingExtraError
        If it is not sound, and as `tree_of`; the message names the file.
    Refusal
        If the site was refused.
    OSError
        If it cannot be read.
    """
    file = any_result_file(Path(path))
    data = read_document(file).removeprefix(codecs.BOM_UTF8)
    with naming(file):
        document = result_in(data)
        if not isinstance(document, SiteDoc):
            return None
    level, level_file = None, file.with_name(LEVEL_FILE)
    if document.status != "refused" and level_file.exists():
        # It loads the steps that made it, which is not needed here otherwise.
        from ..result.level import level_of

        with naming(level_file):
            level = level_of(read_document(level_file), document.lidars)
    with naming(file):
        return tree_of(document, level)


def put_into_robot(file: Path, transform: Transform) -> tuple[bytes, str]:
    """Write a transform into the URDF of a file, as `put_into_urdf` does.

    Returns
    -------
    bytes
        The robot with it.
    str
        Which joint that is, and by how much its pose changes.

    Raises
    ------
    ReadError, UsageError
        As `put_into_urdf`; the message names the file.
    OSError
        If it cannot be read.
    """
    data = read_document(file)
    with naming(file):
        robot = put_into_urdf(data, transform)
    before, after = (
        {each.child: each for each in read_urdf(urdf)}.get(transform.child)
        for urdf in (data, robot)
    )
    assert after is not None
    joint = f"the joint from {after.parent} to {after.child} is"
    if before is None:
        return robot, f"{joint} new"
    try:
        difference = se3.difference(before.pose(), after.pose())
    except ReadError as fault:
        return robot, f"{joint} replaced: before, {fault}"
    change = f"{error(difference.translation)} and {error(difference.rotation, 'rad')}"
    return robot, f"{joint} changed by {change}"


def detect_format(path: Path, data: bytes) -> str:
    """Recognize a format by its suffix, else by the content of the file."""
    if _LIVOX.search(data):
        return "livox"
    if path.suffix.lower() in _SUFFIXES:
        return _SUFFIXES[path.suffix.lower()]
    head = data.lstrip()
    if is_xml(data):
        return "launch" if read_xml(data).tag == "launch" else "urdf"
    if head.startswith(b"{"):
        return "json"
    text = data.decode()
    code = [line.partition("#")[0].rstrip() for line in text.splitlines()]
    if any(line.startswith("def generate_launch_description") for line in code):
        return "launch"
    if any(line.startswith(OUSTER) for line in code):
        return "ouster"
    if any(line.lstrip().startswith(f"{HESAI}:") for line in code):
        return "hesai"
    if any(line.startswith("T_target_source") for line in code):
        return "matrix"
    if any(line.lstrip("- \t").startswith("Translation:") for line in code):
        return "quaternion"
    if any(_PUBLISHER.search(line) for line in code):
        return (
            "ros2" if any("ros2 run" in line or "--frame-id" in line for line in code) else "ros1"
        )
    keys = {line.partition(":")[0] for line in code if ":" in line and "[" not in line}
    if "qw" in keys:
        return "quaternion"
    if not keys.isdisjoint(("yaw", "yaw_deg", "yaw_rad")):
        return "rpy"
    return "yaml" if keys else "matrix"
