"""The LiDARs of a site as points on the map: GeoJSON (RFC 7946), for QGIS and web maps."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from ..base.datatypes import Array
from ..result.site_parts import LidarDoc
from ..site.description import Frame
from ..site.world import heading, on_wgs84, pose_in_frame
from .transform import ROS_COVARIANCE_ORDER, covariance_to_ros
from .tree import Tree, notes_of

DEGREE_DIGITS, METRE_DIGITS = 10, 5
"""Of a coordinate: 0.01 mm."""

COVARIANCE_FRAME = "axes east, north, up of the site: t_true = t + [x y z], R_true = Exp([rot]) R"


def write_geojson(tree: Tree) -> str:
    """Write a FeatureCollection with a point for each LiDAR, on WGS 84.

    Raises
    ------
    UsageError
        Where nothing ties the frame of the site to the earth.
    MissingExtraError
        Where its frame is projected and pyproj is not installed.
    """
    poses = {edge.child: edge for edge in tree.edges}
    places = np.array([poses[lidar.name].T_parent_child[:3, 3] for lidar in tree.lidars])
    found = on_wgs84(tree.frame, places)
    datum: dict[str, Any] = {}
    if found.datum:
        datum = {"datum_operation": found.datum, "datum_accuracy_m": found.accuracy}
    features = []
    for lidar, at in zip(tree.lidars, found.geodetic, strict=True):
        pose = poses[lidar.name]
        longitude, latitude = np.degrees([at[1], at[0]]).round(DEGREE_DIGITS).tolist()
        about = _properties(tree.frame, lidar, pose.T_parent_child, pose.covariance)
        features.append(
            {
                "type": "Feature",
                "id": lidar.name,
                "geometry": {
                    "type": "Point",
                    "coordinates": [longitude, latitude, round(float(at[2]), METRE_DIGITS)],
                },
                "properties": {**about, **datum},
            }
        )
    document = {
        "type": "FeatureCollection",
        "name": tree.name,
        "description": "; ".join(notes_of(tree)),
        "features": features,
    }
    return json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def _properties(
    frame: Frame, lidar: LidarDoc, T: Array, covariance: Array | None
) -> dict[str, Any]:
    """What a map shows of a LiDAR beside its place; headings in degrees, as maps have them."""
    about: dict[str, Any] = {"name": lidar.name, "serial": lidar.serial, "sensor": lidar.sensor}
    about["heading_deg"] = _degrees(heading(frame, T))
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
