"""Draw how certain the poles alone make the pose, by how they are placed.

python examples/plot_placement.py --out placement --sensor VLP-16
"""

import argparse
from pathlib import Path

import numpy as np

from retropole.alignment.adjustment import align_beams
from retropole.alignment.observations import beams_of
from retropole.base import se3
from retropole.base.sensors import find_sensor
from retropole.base.uncertainty import predicted_error
from retropole.extraction.poles import extract_poles
from retropole.report.figures import new_figure
from retropole.simulation import TYPICAL, Cylinder, Material, scan

LIDARS = [se3.from_rt(np.eye(3), np.array([0.0, y, 1.2])) for y in (-0.5, 0.5)]


def sigma_at_10_m(degrees: float, distance: float, spacing: float, seed: int, name: str) -> float:
    """Predict the error at 10 m, metres, of two poles of 2 m that lean away from each other."""
    sensor, lean, rng = find_sensor(name), np.radians(degrees) / 2, np.random.default_rng(seed)
    tape, radius = Material(0.9, retro=True), 0.02
    poles = [
        Cylinder(np.array([distance, k * spacing / 2, 1.0]), axis, radius, 2.0, tape)
        for k, axis in ((k, np.array([0, k * np.sin(lean), np.cos(lean)])) for k in (-1, 1))
    ]
    beams = []
    for pose in LIDARS:
        cloud = scan(poles, sensor, pose, rng, TYPICAL).cloud
        found = sorted(extract_poles(cloud, sensor=sensor).poles, key=lambda pole: pole.point[1])
        beams.append(beams_of([(pole, cloud) for pole in found], sensor))
    pose = align_beams(*beams, se3.inverse(LIDARS[0]) @ LIDARS[1], radius=radius).pose
    return predicted_error(pose.covariance, (10.0,))[0].sigma_m


SWEEPS = {
    "angle between the poles, deg": [(a, 5.0, 2.0) for a in (5, 10, 15, 30, 60)],
    "distance from the LiDARs, m": [(20.0, d, 2.0) for d in (2, 3, 5, 7, 9, 11)],
    "between the poles, m": [(20.0, 5.0, s) for s in (0.3, 0.6, 1, 1.5, 2.5, 4)],
}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("placement"))
    parser.add_argument("--sensor", default="XT32", help="of both LiDARs")
    parser.add_argument("--draws", type=int, default=1, help="scans of each placement")
    options, figure = parser.parse_args(), new_figure(9.0, 3.0)
    for k, (name, placements) in enumerate(SWEEPS.items()):
        jobs = [(*p, n, options.sensor) for p in placements for n in range(options.draws)]
        cm = 100 * np.median(np.reshape([sigma_at_10_m(*j) for j in jobs], (-1, options.draws)), 1)
        at, said = (" | ".join(f"{x:.1f}" for x in row) for row in ([p[k] for p in placements], cm))
        print(f"| {name} | {at} |\n{'| --- ' * (1 + len(cm))}|\n| {options.sensor} | {said} |\n")
        axes = figure.add_subplot(1, 3, k + 1, xlabel=name, ylabel="1 σ at 10 m, cm", ylim=(0, 14))
        axes.plot([p[k] for p in placements], cm, "o-")
    options.out.mkdir(parents=True, exist_ok=True)
    figure.savefig(options.out / "placement.png")
