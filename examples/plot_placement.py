"""Draw how certain the poles alone make the pose, by how they are placed.

python examples/plot_placement.py --out placement
"""

import argparse
from pathlib import Path

import numpy as np

from retropole import se3
from retropole.alignment.adjustment import align_beams
from retropole.alignment.observations import beams_of
from retropole.extraction.poles import extract_poles
from retropole.pipeline import DEFAULT_RADIUS
from retropole.report.figures import new_figure, save_figure
from retropole.sensors import find_sensor
from retropole.simulation import TYPICAL, Cylinder, Material, scan
from retropole.uncertainty import predicted_error

TAPE, SENSOR = Material(0.9, retro=True), find_sensor("XT32")
LIDARS = [se3.from_rt(np.eye(3), np.array([0.0, y, 1.2])) for y in (-0.5, 0.5)]


def sigma_at_10_m(angle_deg: float, distance: float, spacing: float, seed: int = 0) -> float:
    """Predict the error at 10 m, metres, of two poles of 2 m that lean away from each other."""
    lean, rng = np.radians(angle_deg) / 2, np.random.default_rng(seed)
    poles = [
        Cylinder(np.array([distance, k * spacing / 2, 1.0]), axis, DEFAULT_RADIUS, 2.0, TAPE)
        for k, axis in ((k, np.array([0, k * np.sin(lean), np.cos(lean)])) for k in (-1, 1))
    ]
    beams = []
    for pose in LIDARS:
        cloud = scan(poles, SENSOR, pose, rng, TYPICAL).cloud
        found = sorted(extract_poles(cloud, sensor=SENSOR).poles, key=lambda pole: pole.point[1])
        beams.append(beams_of([(pole, cloud) for pole in found], SENSOR))
    pose = align_beams(*beams, se3.inverse(LIDARS[0]) @ LIDARS[1], radius=DEFAULT_RADIUS).pose
    return predicted_error(pose.covariance, (10.0,))[0][1]


SWEEPS = {
    "angle between the poles, deg": [(a, 5.0, 2.0) for a in (2, 5, 10, 15, 30, 60)],
    "distance from the LiDARs, m": [(20.0, d, 2.0) for d in (2, 3, 5, 7, 9, 11)],
    "between the poles, m": [(20.0, 5.0, s) for s in (0.3, 0.6, 1, 1.5, 2.5, 4)],
}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("placement"))
    parser.add_argument("--draws", type=int, default=1, help="scans of each placement")
    options = parser.parse_args()
    figure = new_figure(9.0, 3.0)
    for k, (name, placements) in enumerate(SWEEPS.items()):
        draws = [[sigma_at_10_m(*p, n) for n in range(options.draws)] for p in placements]
        x, cm = [p[k] for p in placements], 100 * np.median(draws, axis=1)
        print(f"{name:<30}", *(f"{a:g}: {b:.1f} cm" for a, b in zip(x, cm, strict=True)), sep="  ")
        axes = figure.add_subplot(1, 3, k + 1, xlabel=name, ylabel="1 σ at 10 m, cm", ylim=(0, 8))
        axes.plot(x, cm, "o-", color="#0072b2")
        axes.grid(alpha=0.3)
    save_figure(figure, options.out / "placement.png")
