"""Table I: intensities from which returns count as the tape's."""

from __future__ import annotations

from retropole.base.sensors import SENSORS
from studies.paper.exhibit import Exhibit

PAPER_TABLE_I = {
    "Velodyne": (230, ("VLP-16", "HDL-32E", "VLS-128")),
    "Hesai": (200, ("Pandar64", "PandarQT", "XT32")),
    "Leishen": (200, ("C16", "C32")),
    "RoboSense": (200, ("RS-LiDAR-16", "RS-LiDAR-32")),
}
"""By manufacturer: the paper's threshold, and our models of that manufacturer."""


def thresholds() -> Exhibit:
    """Compare the paper's threshold of each manufacturer with ours of each model."""
    paper = {
        name: (manufacturer, value)
        for manufacturer, (value, names) in PAPER_TABLE_I.items()
        for name in names
    }
    rows = []
    for name, sensor in SENSORS.items():
        manufacturer, value = paper.get(name, ("", None))
        rows.append((manufacturer, name, value, sensor.threshold, sensor.threshold_source))
    return Exhibit(
        "table1_sensors",
        "Table I: thresholds of retro-reflective returns at about 5 m",
        ("manufacturer", "sensor", "paper", "ours", "source of ours"),
        tuple(rows),
        "The paper's are on an 8-bit scale and hold for its own sensors. They do not transfer: "
        "diffuse returns of a VLS-128 end at 110, and an Ouster writes 16 bits. Where no sensor is "
        "named, the threshold comes from the cloud itself.",
    )
