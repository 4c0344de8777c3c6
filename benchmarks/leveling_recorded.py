"""The ground that two LiDARs of a real recording see, each by itself, under their reference pose.

For each pair whose reference is measured, both LiDARs are levelled alone. Under the reference they
have one ground: the table has the tilt between the two, and how much higher the source is by its
own ground than by the target's, each with 1 σ of both answers, without that of the reference, which
is in the last column. Where they see different parts of the ground, its shape counts as well.

    python benchmarks/leveling_recorded.py ../shared/data
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from retropole.base import se3
from retropole.base.datatypes import Array, PointCloud
from retropole.base.errors import Refusal
from retropole.base.sensors import Sensor
from retropole.base.systematic import sizes_of
from retropole.ground.level import LidarLevel, level
from retropole.ground.surface import viewer_of
from semireal import PAIRS, load


def alone(cloud: PointCloud, sensor: Sensor | None) -> LidarLevel | str:
    """Level one LiDAR, or say why not."""
    try:
        return level([viewer_of("a", cloud, np.eye(4), sizes_of(sensor))]).lidars[0]
    except Refusal as refusal:
        return str(refusal.reason.code)


def apart(target: LidarLevel, source: LidarLevel, T: Array) -> tuple[float, float, float, float]:
    """Tilt, rad, and height, m, of the source by its own ground against the target's, with 1 σ."""
    T_ground_source = target.T_ground_lidar @ T
    normals = (T_ground_source @ se3.inverse(source.T_ground_lidar))[:2, 2]
    higher = source.height - T_ground_source[2, 3]
    both = [np.diag(each.roll_pitch_height) for each in (target, source)]
    # The target's tilt moves the place of the source.
    away = np.hypot(*T_ground_source[:2, 3])
    height = both[0][2] + both[1][2] + away**2 * both[0][:2].max()
    tilt = both[0][:2].max() + both[1][:2].max()
    return float(np.hypot(*normals)), float(np.sqrt(tilt)), float(higher), float(np.sqrt(height))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path, help="folder with the recordings")
    parser.add_argument("--every", type=int, default=1, help="take every n-th pair only")
    arguments = parser.parse_args()
    print(
        "| pair | target, m | source, m | tilt difference | 1 σ | height difference | 1 σ "
        "| reference |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for pair in [each for each in PAIRS if not each.is_composed][:: arguments.every]:
        given = load(pair.name, arguments.data)
        clouds = given.target, given.source
        with threadpool_limits(1):
            found = [alone(*each) for each in zip(clouds, given.sensors, strict=True)]
        words = [each if isinstance(each, str) else f"{each.height:.3f}" for each in found]
        a, b = found
        row = ["", "", "", ""]
        if not isinstance(a, str) and not isinstance(b, str):
            tilt, tilt_sigma, higher, height_sigma = apart(a, b, given.T)
            row = [f"{np.degrees(tilt):.2f}°", f"{np.degrees(tilt_sigma):.2f}°"]
            row += [f"{1000 * higher:.0f} mm", f"{1000 * height_sigma:.0f} mm"]
        sigma = f"{np.degrees(pair.sigma[0]):.2g}°, {1000 * pair.sigma[1]:.0f} mm"
        print(f"| {' | '.join([pair.name, *words, *row, sigma])} |", flush=True)


if __name__ == "__main__":
    main()
