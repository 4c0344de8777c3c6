"""JSON and YAML: retropole's transform file, result document, truth of a simulation; Autoware.

Autoware keeps the poses of its sensors in ``sensors_calibration.yaml`` as ``parent: child: {x, y,
z, roll, pitch, yaw}``. YAML is written by hand and read with PyYAML, an extra: another parser
would have to know flow mappings, anchors and quotes to read what others wrote. The frames of a site
are written as JSON too, and its LiDARs on the map as GeoJSON.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import msgspec
import numpy as np
from msgspec import structs, to_builtins

from ..base.bounded import LARGEST
from ..base.datatypes import Array
from ..base.description import Frame, Geodetic
from ..base.errors import MissingExtraError, ReadError, said
from ..base.se3 import rigid
from ..base.world import OnWgs84, heading, on_wgs84, pose_in_frame
from ..result import COVARIANCE_ORDER, RESULT_SCHEMA, ResultDoc, plain, refusal_of, verdict_line
from ..result.decoding import check_covariance, decode, decode_site
from ..result.site import SITE_SCHEMA, LidarDoc, SiteDoc
from .text import RPY, RPY_MEANING, TRANSLATION_KEYS, comments, named_lines, pose_of, pose_values
from .transform import (
    ROS_COVARIANCE_ORDER,
    Found,
    Transform,
    covariance_from_ros,
    covariance_to_ros,
    from_quaternion,
    is_name,
    notes_on,
    to_quaternion,
)
from .tree import Tree, found_in_site, grid_of, notes_of

TRANSFORM_SCHEMA, TREE_SCHEMA = "retropole/transform/1", "retropole/tree/1"

LARGEST_YAML, DEEPEST_YAML = 2**19, 20
"""Bytes, and levels; PyYAML takes some 10 s for a million bytes, and longer for each level."""

ROS_COVARIANCE_FRAME = "axes of the parent: t_true = t + [x y z], R_true = Exp([rot]) R; m and rad"
_KEYS = {
    "T_target_source": ("target", "source"),
    "T_source_target": ("source", "target"),
    "T_parent_child": ("parent", "child"),
}
VERDICT = re.compile(r"verdict of the calibration: [a-z0-9_ ,;.%]{1,2000}")
"""What `result.verdict_line` writes: safe in a comment of any format."""

_YAML_PLAIN = re.compile(r"[A-Za-z_][A-Za-z0-9_./]*")
_YAML_WORDS = {"true", "false", "null", "yes", "no", "on", "off", "y", "n"}


def write_json(transform: Transform) -> str:
    """Write the matrix, its parts by name and, where known, the covariance in ROS's order."""
    key = f"T_{'_'.join(transform.roles)}"
    document = {"schema": TRANSFORM_SCHEMA, **transform_fields(transform, key)}
    return json.dumps(document, indent=1, ensure_ascii=False) + "\n"


def transform_fields(transform: Transform, key: str) -> dict[str, Any]:
    """Name all that a transform says, its matrix by the key."""
    T = transform.T_parent_child
    fields: dict[str, Any] = {
        "description": transform.meaning,
        **({"verdict": transform.verdict} if transform.verdict else {}),
        "parent": transform.parent,
        "child": transform.child,
        key: (T + 0.0).tolist(),
        "translation_m": dict(zip("xyz", (T[:3, 3] + 0.0).tolist(), strict=True)),
        "quaternion": dict(zip("xyzw", (to_quaternion(T) + 0.0).tolist(), strict=True)),
    }
    if transform.covariance is not None:
        fields["covariance"] = covariance_to_ros(transform.covariance).tolist()
        fields["covariance_order"] = ROS_COVARIANCE_ORDER
        fields["covariance_frame"] = ROS_COVARIANCE_FRAME
    return fields


def read_json(data: bytes) -> list[Found]:
    """Read a transform file, a result document, or the truth that ``retropole simulate`` writes.

    Of a site's result document, the transforms between any two of its frames.

    Raises
    ------
    Refusal
        If the document is a refused result: it has no transform.
    """
    try:
        document = msgspec.json.decode(data)
    except (msgspec.DecodeError, RecursionError) as error:
        raise ReadError(f"no JSON: {said(error)}") from None
    if not isinstance(document, dict):
        raise ReadError("the JSON is not an object with a key T_target_source")
    result = result_in(data)
    if isinstance(result, SiteDoc):
        return found_in_site(result)
    if result is not None:
        return [found_in_result(result)]
    if document.get("schema") == TREE_SCHEMA:
        entries = document.get("transforms")
        if not isinstance(entries, list) or not all(isinstance(each, dict) for each in entries):
            raise ReadError("transforms is not a list of objects")
        return [_found(entry) for entry in entries]
    return [_found(document)]


def _found(document: dict[str, Any]) -> Found:
    """Read one transform from a file that we wrote."""
    keys = [key for key in _KEYS if key in document]
    if len(keys) != 1:
        raise ReadError(f"expected one of the keys {', '.join(_KEYS)}, found {len(keys)}")
    covariance = _covariance(document)
    parent, child = _text(document, "parent"), _text(document, "child")
    verdict = _text(document, "verdict") or ""
    verdict = verdict if VERDICT.fullmatch(verdict) else ""
    pose = partial(_pose, document, keys[0])
    roles = _KEYS[keys[0]]
    return Found(parent, child, pose, covariance, roles, verdict, roles != ("parent", "child"))


class _Named(msgspec.Struct):
    schema: str = ""


def is_result(data: bytes, schema: str = RESULT_SCHEMA) -> bool:
    """Recognize a result document of any version by its schema; `decode` checks whether it is
    sound."""
    try:
        named = msgspec.json.decode(data, type=_Named)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return False
    return named.schema.startswith(schema.removesuffix("1"))


def result_in(data: bytes) -> ResultDoc | SiteDoc | None:
    """Read the result document of two LiDARs or of a site; None if the schema is another.

    Raises
    ------
    ReadError
        If it is not sound.
    """
    if is_result(data):
        return decode(data)
    return decode_site(data) if is_result(data, SITE_SCHEMA) else None


def found_in_result(result: ResultDoc) -> Found:
    """Give the transform of a result, between the frames that its recordings name.

    Raises
    ------
    Refusal
        If it was refused.
    """
    T = result.T_target_source
    if T is None:
        prefix = "the calibration was refused, there is no transform: "
        raise refusal_of(result.reasons, prefix)
    # Target and source of each placement, in turn.
    target, source = ({each.frame_id for each in result.inputs[k::2]} for k in (0, 1))
    parent = child = None
    if len(target) == len(source) == 1 and target != source and all(map(is_name, target | source)):
        (parent,), (child,) = target, source
    return Found(
        parent,
        child,
        lambda: T,
        result.covariance,
        verdict=verdict_line(result.status, result.reasons),
        is_of_lidars=True,
    )


def _text(document: dict[str, Any], key: str) -> str | None:
    text = document.get(key)
    if text is not None and not isinstance(text, str):
        raise ReadError(f"{key} is {text!r}, not a name")
    return text


def _pose(document: dict[str, Any], key: str) -> Array:
    """Read the matrix, and check that the quaternion and translation next to it agree."""
    try:
        T = rigid(np.array(document[key], dtype=float))
        if "quaternion" in document and "translation_m" in document:
            t = np.array([document["translation_m"][name] for name in "xyz"], dtype=float)
            q = np.array([document["quaternion"][name] for name in "xyzw"], dtype=float)
            difference = float(np.abs(from_quaternion(t, q) - T).max())
            if difference > 1e-6:
                raise ReadError(f"{key} and quaternion or translation_m differ by {difference:.3g}")
    except (TypeError, ValueError, KeyError, OverflowError) as error:
        raise ReadError(
            f"{key} and its neighbouring keys are not a transform: {said(error)}"
        ) from None
    return T


def _covariance(document: dict[str, Any]) -> Array | None:
    """Read the covariance in the order that it names."""
    if document.get("covariance") is None:
        return None
    given = document.get("covariance_order")
    order = tuple(map(str, given)) if isinstance(given, list) else ()
    if order not in (ROS_COVARIANCE_ORDER, COVARIANCE_ORDER):
        known = f"{ROS_COVARIANCE_ORDER} nor {COVARIANCE_ORDER}"
        raise ReadError(f"covariance_order {given} is neither {known}")
    C = _square(document["covariance"])
    return covariance_from_ros(C) if order == ROS_COVARIANCE_ORDER else C


def _square(values: Any) -> Array:
    try:
        C = np.array(values, dtype=float)
    except (TypeError, ValueError, OverflowError):
        C = np.empty(0)
    if C.shape != (6, 6) or not np.abs(C).max() <= LARGEST:
        raise ReadError(f"the covariance is not 6×6 numbers up to {LARGEST:g}")
    check_covariance("covariance", C)
    return C


def write_yaml(*transforms: Transform, notes: Sequence[str] = ()) -> str:
    """Write Autoware's ``sensors_calibration.yaml``: ``parent: child: x y z roll pitch yaw``.

    Transforms of one parent are adjacent; above all, as comments, notes and what each maps.
    """
    text = comments((*notes, *notes_on(transforms), RPY_MEANING))
    for parent in dict.fromkeys(each.parent for each in transforms):
        text += f"{_yaml_key(parent)}:\n"
        for each in (own for own in transforms if own.parent == parent):
            pose = named_lines(pose_values(each, RPY), "    ")
            text += f"  {_yaml_key(each.child)}:\n{pose}"
    return text


def _yaml_key(name: str) -> str:
    if _YAML_PLAIN.fullmatch(name) and name.lower() not in _YAML_WORDS:
        return name
    return json.dumps(name, ensure_ascii=False)


def read_yaml(data: bytes) -> list[Found]:
    """Read every ``parent: child: {x, y, z, roll, pitch, yaw}``; needs the extra ``yaml``.

    Also what ``ros2 topic echo /tf_static`` prints. Without aliases: a few of them write out to
    millions of transforms.
    """
    try:
        import yaml
    except ImportError:
        raise MissingExtraError("yaml", "reading YAML") from None
    if len(data) > LARGEST_YAML:
        raise ReadError(f"{len(data)} bytes of YAML, {LARGEST_YAML} at most are read")
    text = data.decode()
    depth = 0
    try:
        for event in yaml.parse(text, Loader=yaml.SafeLoader):
            depth += isinstance(event, yaml.CollectionStartEvent)
            depth -= isinstance(event, yaml.CollectionEndEvent)
            if isinstance(event, yaml.AliasEvent) or depth > DEEPEST_YAML:
                what = "aliases" if depth <= DEEPEST_YAML else "deeper levels"
                raise ReadError(f"line {event.start_mark.line + 1}: {what} are not read")
        # Nodes, not values: a key given twice would be lost in a dict, and 1e-3 be a string.
        roots = [root for root in yaml.compose_all(text, Loader=yaml.SafeLoader) if root.value]
    except (yaml.YAMLError, RecursionError) as error:
        raise ReadError(f"no YAML: {said(error)}") from None
    # A latched message comes again with every echo.
    found = list(dict.fromkeys(each for root in roots for each in _transforms(_mapping(root))))
    if not found:
        keys = "; ".join(_outline(root) for root in roots[:3]) or "nothing"
        raise ReadError(f"{EXPECTED_YAML}; found {keys}{_NOT_OURS if 'extrinsic_' in text else ''}")
    return found


def _transforms(root: dict[str, Any]) -> list[Found]:
    """Transforms of one document: Autoware's, or as a message of ROS."""
    messages = getattr(root.get("transforms"), "value", None)
    if "child_frame_id" in root:
        return [_stamped(root)]
    if isinstance(messages, list) and all(hasattr(each, "id") for each in messages):
        return [_stamped(_mapping(each)) for each in messages]
    return [
        Found(parent, child, lambda pose=pose: pose_of(_scalars(pose)))  # type: ignore[misc]
        for parent, children in root.items()
        if getattr(children, "id", "") == "mapping"
        for child, pose in _mapping(children).items()
        if not _keys(pose).isdisjoint(TRANSLATION_KEYS)
    ]


def _stamped(message: dict[str, Any]) -> Found:
    """Read a TransformStamped: its header names the parent."""
    try:
        parent = _mapping(message["header"])["frame_id"].value
        child = message["child_frame_id"].value
        parts = _mapping(message["transform"])
        t, q = _scalars(parts["translation"]), _scalars(parts["rotation"])
    except KeyError as error:
        raise ReadError(f"a transform as a ROS message has no {said(error)}") from None
    if not isinstance(parent, str) or not isinstance(child, str):
        raise ReadError("frame_id and child_frame_id are not names")
    values = t | {f"q{name}": q[name] for name in q}
    return Found(parent, child, _Stamped(tuple(values.items())))


@dataclass(frozen=True)
class _Stamped:
    """Numbers of a message by name; equal ones are the same transform."""

    values: tuple[tuple[str, str], ...]

    def __call__(self) -> Array:
        return pose_of(dict(self.values))


EXPECTED_YAML = "expected the YAML to be parent: child: {x, y, z, roll, pitch, yaw}"

_NOT_OURS = (
    "; extrinsic_T and extrinsic_R (FAST-LIO) are the pose of the LiDAR in its IMU, not in a LiDAR"
)


def _keys(node: Any) -> set[str]:
    """Keys of a node, if it is a mapping."""
    pairs = node.value if getattr(node, "id", "") == "mapping" else []
    return {key.value for key, _ in pairs if isinstance(key.value, str)}


def _outline(root: Any) -> str:
    """Describe the top of a document, two levels deep."""
    found = []
    for key, value in root.value[:5]:
        below = ", ".join(sorted(_keys(value))[:4])
        if isinstance(key.value, str):
            found.append(f"{key.value}: {{{below}}}" if below else key.value)
    return ", ".join(found)


def _mapping(node: Any) -> dict[str, Any]:
    """Keys and nodes of a YAML mapping."""
    pairs = getattr(node, "value", None)
    if getattr(node, "id", "") != "mapping" or not isinstance(pairs, list):
        raise ReadError(EXPECTED_YAML)
    out: dict[str, Any] = {}
    for key, value in pairs:
        if not isinstance(key.value, str) or key.value in out:
            raise ReadError(f"line {key.start_mark.line + 1}: no key, or one given twice")
        out[key.value] = value
    return out


def _scalars(node: Any) -> dict[str, str]:
    values = {name: value.value for name, value in _mapping(node).items()}
    if not all(isinstance(value, str) for value in values.values()):
        raise ReadError(f"expected a number for each of {' '.join((*TRANSLATION_KEYS, *RPY))}")
    return values


COVARIANCE_FRAME = "axes east, north, up of the site: t_true = t + [x y z], R_true = Exp([rot]) R"


def write_tree(tree: Tree) -> str:
    """Write the transforms, and where each LiDAR is in the user's frame and on the earth."""
    frame, grid = tree.frame, grid_of(tree)
    about: dict[str, Any] = to_builtins(frame, enc_hook=plain)
    if grid is not None:
        about |= {
            "scale": grid.scale,
            "height_factor": grid.height_factor,
            "convergence_rad": grid.convergence,
        }
    lidars = []
    for lidar, edge in zip(tree.lidars, tree.lidar_edges, strict=True):
        T = edge.T_parent_child
        placed = {**_named(lidar), "T_frame_lidar": pose_in_frame(frame, T).tolist()}
        if frame.epsg is not None or frame.geodetic is not None:
            found = on_wgs84(frame, T[None, :3, 3])
            placed["wgs84"] = structs.asdict(Geodetic(*found.geodetic[0].tolist()))
            placed |= {"heading_rad": heading(frame, T), **_datum(found)}
        lidars.append(placed)
    return _as_json(
        {
            "schema": TREE_SCHEMA,
            "name": tree.name,
            "datum": tree.datum,
            "verdict": tree.verdict,
            "notes": notes_of(tree),
            "frame": about,
            "lidars": lidars,
            "transforms": [transform_fields(edge, "T_parent_child") for edge in tree.edges],
        }
    )


def write_geojson(tree: Tree) -> str:
    """Write a FeatureCollection (RFC 7946) with a point for each LiDAR, on WGS 84.

    Raises
    ------
    UsageError
        If nothing ties the frame of the site to the earth.
    MissingExtraError
        If its frame is projected and pyproj is not installed.
    """
    found = on_wgs84(tree.frame, tree.places)
    features = []
    for lidar, edge, at in zip(tree.lidars, tree.lidar_edges, found.geodetic, strict=True):
        # To 0.01 mm.
        longitude, latitude = np.degrees([at[1], at[0]]).round(10).tolist()
        place = [longitude, latitude, round(float(at[2]), 5)]
        features.append(
            {
                "type": "Feature",
                "id": lidar.name,
                "geometry": {"type": "Point", "coordinates": place},
                "properties": {**_named(lidar), **_on_map(tree.frame, edge), **_datum(found)},
            }
        )
    return _as_json(
        {
            "type": "FeatureCollection",
            "name": tree.name,
            "description": "; ".join(notes_of(tree)),
            "features": features,
        }
    )


def _as_json(document: dict[str, Any]) -> str:
    return json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def _named(lidar: LidarDoc) -> dict[str, Any]:
    return {"name": lidar.name, "serial": lidar.serial, "sensor": lidar.sensor}


def _datum(found: OnWgs84) -> dict[str, Any]:
    """How another datum was brought to WGS 84."""
    if not found.datum:
        return {}
    return {"datum_operation": found.datum, "datum_accuracy_m": found.accuracy}


def _on_map(frame: Frame, edge: Transform) -> dict[str, Any]:
    """What a map shows of a LiDAR besides its position; headings in degrees, as maps have them."""
    T, covariance = edge.T_parent_child, edge.covariance
    about: dict[str, Any] = {"heading_deg": _degrees(heading(frame, T))}
    if frame.epsg is not None:
        east, north, height = pose_in_frame(frame, T)[:3, 3].tolist()
        about |= {"epsg": frame.epsg, "east_m": east, "north_m": north, "height_m": height}
        about["heading_grid_deg"] = _degrees(heading(frame, T, of_grid=True))
    if covariance is None:
        return about
    level = np.linalg.eigvalsh(covariance[3:5, 3:5])
    about["sigma_horizontal_m"] = float(np.sqrt(max(level[-1], 0.0)))
    about["sigma_vertical_m"] = float(np.sqrt(covariance[5, 5]))
    about["covariance"] = covariance_to_ros(covariance).tolist()
    about["covariance_order"] = ROS_COVARIANCE_ORDER
    about["covariance_frame"] = COVARIANCE_FRAME
    return about


def _degrees(angle: float | None) -> float | None:
    return None if angle is None else round(float(np.degrees(angle)), 6)
