"""Table I: intensities from which returns count as the tape's."""

from __future__ import annotations

from ...sensors import SENSORS
from .exhibit import Exhibit

PAPER = {
    "Velodyne": (230, ("VLP-16", "HDL-32E", "VLS-128")),
    "Hesai": (200, ("Pandar64", "PandarQT", "XT32")),
    "Leishen": (200, ("C16", "C32")),
    "RoboSense": (200, ("RS-LiDAR-16", "RS-LiDAR-32")),
}
"""By maker: the paper's threshold, and our models of that maker."""


def thresholds() -> Exhibit:
    """Set the paper's threshold of each maker beside ours of each model."""
    ours = {name: (maker, value) for maker, (value, names) in PAPER.items() for name in names}
    rows = []
    for name, sensor in SENSORS.items():
        maker, value = ours.get(name, ("", None))
        rows.append((maker, name, value, sensor.threshold, sensor.threshold_source))
    return Exhibit(
        "table1_sensors",
        "Table I: thresholds of retro-reflective returns at about 5 m",
        ("maker", "sensor", "paper", "ours", "source of ours"),
        tuple(rows),
        "The paper's are on an 8-bit scale and hold for its own sensors. They do not transfer: a "
        "VLS-128 ends its diffuse returns at 110, an Ouster writes 16 bits. Where no sensor is "
        "named, the threshold comes from the cloud itself.",
    )
