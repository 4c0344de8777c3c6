"""What makes each source of error smaller, by its name in the error budget."""

from __future__ import annotations

from collections.abc import Mapping

SPREAD_OUT = (
    "put poles and surfaces on different sides of the LiDAR and at different distances, or have it "
    "calibrated by itself"
)

REMEDIES: Mapping[str, str] = {
    "scatter of the poles' returns": "stand the poles nearer, further apart and more leaning, "
    "record more frames, or add a placement",
    "scatter of the surfaces": "record more frames, or a wider scene with more walls and ground "
    "that both LiDARs see",
    "surfaces that are not flat": "record a wider scene, with walls on more sides that both LiDARs "
    "see",
    "slanted surfaces": "record a wider scene, with walls that both LiDARs meet head on",
    "one place that decides": "add a placement of the poles, or record where more stands around",
    "poles and scene disagree": "find out first why poles and scene disagree",
    "range offset on tape": "stand poles on different sides of the LiDARs, or use other tape",
    "radius of the poles": "measure the radius with a calliper, and give it with --radius and "
    "--radius-sigma",
    "width of the beam": "stand the poles nearer, or add a placement",
}
"""Of what is no matter of a single LiDAR; all others are errors of one."""


def remedy(source: str, unknown_lidar: str | None = None) -> str:
    """Say what makes a source of error smaller; nothing helps against what no model names.

    Parameters
    ----------
    source
        Its name in the error budget.
    unknown_lidar
        ``target`` or ``source``, where it is an error of a LiDAR whose sensor is not known.
    """
    if unknown_lidar is not None and source not in REMEDIES:
        return f"name the sensor with --sensor-{unknown_lidar}, so that its own figures count"
    return REMEDIES.get(source, SPREAD_OUT)
