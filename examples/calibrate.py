"""Calibrate from Python: read the answer, not only the transform.

python examples/calibrate.py --out out
"""

import argparse
from pathlib import Path

import numpy as np

from retropole.io import read_cloud
from retropole.pipeline import calibrate
from retropole.simulation import simulate_pair, write_pair

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--out", type=Path, default=Path("out"))
out = parser.parse_args().out

# Two recordings; yours come from your LiDARs.
write_pair(simulate_pair("street", np.random.default_rng(1)), out)
target, source = read_cloud(out / "lidar0.pcd"), read_cloud(out / "lidar1.pcd")

answer = calibrate(target, source)
for reason in answer.reasons:
    print(f"{reason.code}: {reason.message}")
if answer.T_target_source is None or answer.covariance is None or answer.weakest is None:
    raise SystemExit(3)

print(answer.status)
print(answer.T_target_source.round(6))
sigma = np.sqrt(np.diag(answer.covariance))
print("1 σ of the rotation, deg:", np.degrees(sigma[:3]).round(4))
print("1 σ of the translation, m:", sigma[3:].round(4))
for distance, error in answer.predicted_error:
    print(f"a point {distance:g} m away is off by {100 * error:.2f} cm (1 σ)")
print("least sure:", answer.weakest.words)

# Source points in the target's frame.
moved = source.transformed(answer.T_target_source)
print("first source point, target frame:", moved.xyz[0].round(3))
