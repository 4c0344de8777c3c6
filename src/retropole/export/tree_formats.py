"""What the frames of a whole site are written in: `TREE_FORMATS`."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any, NamedTuple

from msgspec import structs, to_builtins

from ..base.errors import printable
from ..result import plain
from ..result.site_parts import LidarDoc
from ..site.description import Geodetic
from ..site.world import heading, on_wgs84, pose_in_frame
from .documents import TREE_SCHEMA, transform_fields, yaml_of
from .geojson import write_geojson
from .ros import launch_of
from .transform import Transform
from .tree import Tree, grid_of, notes_of
from .urdf import robot_of


class TreeFormat(NamedTuple):
    """One form of a site's frames: what it is, and how it is written."""

    title: str
    write: Callable[[Tree], str]


def _comments(tree: Tree) -> list[str]:
    return [*notes_of(tree), *(edge.meaning for edge in tree.edges)]


def _yaml(tree: Tree) -> str:
    return yaml_of(tree.edges, _comments(tree))


def _launch(tree: Tree) -> str:
    return launch_of(tree.edges, _comments(tree))


def _urdf(tree: Tree) -> str:
    # The meaning of each joint stands above it.
    return robot_of(tree.edges, printable(tree.name) or "site", notes_of(tree))


def _json(tree: Tree) -> str:
    """Write the transforms, and where each LiDAR is in the user's frame and on the earth."""
    frame, grid = tree.frame, grid_of(tree)
    about: dict[str, Any] = to_builtins(frame, enc_hook=plain)
    if grid is not None:
        about |= {
            "scale": grid.scale,
            "height_factor": grid.height_factor,
            "convergence_rad": grid.convergence,
        }
    document = {
        "schema": TREE_SCHEMA,
        "name": tree.name,
        "datum": tree.datum,
        "notes": notes_of(tree),
        "frame": about,
        "lidars": [_lidar(tree, lidar) for lidar in tree.lidars],
        "transforms": [transform_fields(edge, "T_parent_child") for edge in tree.edges],
    }
    return json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def _lidar(tree: Tree, lidar: LidarDoc) -> dict[str, Any]:
    """Where a LiDAR is: exactly in the frame's own coordinates, and on the earth where known."""
    frame, T = tree.frame, _edge(tree, lidar.name).T_parent_child
    about: dict[str, Any] = {"name": lidar.name, "serial": lidar.serial, "sensor": lidar.sensor}
    about["T_frame_lidar"] = pose_in_frame(frame, T).tolist()
    if frame.epsg is None and frame.geodetic is None:
        return about
    found = on_wgs84(frame, T[None, :3, 3])
    about["wgs84"] = structs.asdict(Geodetic(*found.geodetic[0].tolist()))
    about["heading_rad"] = heading(frame, T)
    if found.datum:
        about["datum_operation"], about["datum_accuracy_m"] = found.datum, found.accuracy
    return about


def _edge(tree: Tree, child: str) -> Transform:
    return next(edge for edge in tree.edges if edge.child == child)


TREE_FORMATS = {
    "json": TreeFormat("JSON: transforms, covariances, places in the site's frame", _json),
    "yaml": TreeFormat("YAML: Autoware's sensors_calibration.yaml", _yaml),
    "urdf": TreeFormat("URDF: a robot with a fixed joint for each LiDAR", _urdf),
    "launch": TreeFormat("ROS 2: Python launch file with a publisher for each LiDAR", _launch),
    "geojson": TreeFormat("GeoJSON: the LiDARs on the map (RFC 7946)", write_geojson),
}
