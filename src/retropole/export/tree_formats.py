"""What the frames of a whole site are written in: `TREE_FORMATS`."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from msgspec import structs, to_builtins

from ..base.description import Frame, Geodetic
from ..base.errors import printable
from ..result import plain
from ..result.site import LidarDoc
from ..world.world import OnWgs84, heading, on_wgs84, pose_in_frame
from .documents import TREE_SCHEMA, transform_fields, write_yaml
from .ros import write_launch
from .transform import ROS_COVARIANCE_ORDER, Transform, covariance_to_ros
from .tree import Tree, grid_of, notes_of
from .urdf import write_urdf

DEGREE_DIGITS, METRE_DIGITS = 10, 5
"""Of a coordinate: 0.01 mm."""

COVARIANCE_FRAME = "axes east, north, up of the site: t_true = t + [x y z], R_true = Exp([rot]) R"


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
    lidars = []
    for lidar, edge in zip(tree.lidars, tree.lidar_edges, strict=True):
        T = edge.T_parent_child
        placed = {**_named(lidar), "T_frame_lidar": pose_in_frame(frame, T).tolist()}
        if frame.epsg is not None or frame.geodetic is not None:
            found = on_wgs84(frame, T[None, :3, 3])
            placed["wgs84"] = structs.asdict(Geodetic(*found.geodetic[0].tolist()))
            placed |= {"heading_rad": heading(frame, T), **_datum(found)}
        lidars.append(placed)
    return _text(
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
        Where nothing ties the frame of the site to the earth.
    MissingExtraError
        Where its frame is projected and pyproj is not installed.
    """
    found = on_wgs84(tree.frame, tree.places)
    features = []
    for lidar, edge, at in zip(tree.lidars, tree.lidar_edges, found.geodetic, strict=True):
        longitude, latitude = np.degrees([at[1], at[0]]).round(DEGREE_DIGITS).tolist()
        place = [longitude, latitude, round(float(at[2]), METRE_DIGITS)]
        features.append(
            {
                "type": "Feature",
                "id": lidar.name,
                "geometry": {"type": "Point", "coordinates": place},
                "properties": {**_named(lidar), **_on_map(tree.frame, edge), **_datum(found)},
            }
        )
    return _text(
        {
            "type": "FeatureCollection",
            "name": tree.name,
            "description": "; ".join(notes_of(tree)),
            "features": features,
        }
    )


def _text(document: dict[str, Any]) -> str:
    return json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def _named(lidar: LidarDoc) -> dict[str, Any]:
    return {"name": lidar.name, "serial": lidar.serial, "sensor": lidar.sensor}


def _datum(found: OnWgs84) -> dict[str, Any]:
    """How another datum was brought to WGS 84."""
    if not found.datum:
        return {}
    return {"datum_operation": found.datum, "datum_accuracy_m": found.accuracy}


def _on_map(frame: Frame, edge: Transform) -> dict[str, Any]:
    """What a map shows of a LiDAR beside its place; headings in degrees, as maps have them."""
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


TREE_FORMATS = {
    "json": TreeFormat("JSON: transforms, covariances, places in the site's frame", _json),
    "yaml": TreeFormat("YAML: Autoware's sensors_calibration.yaml", _yaml),
    "urdf": TreeFormat("URDF: a robot with a fixed joint for each LiDAR", _urdf),
    "launch": TreeFormat("ROS 2: Python launch file with a publisher for each LiDAR", _launch),
    "geojson": TreeFormat("GeoJSON: the LiDARs on the map (RFC 7946)", write_geojson),
}
