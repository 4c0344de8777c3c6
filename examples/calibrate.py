"""Calibrate from Python: read the answer, not only the transform.

python examples/calibrate.py --out out
"""

import argparse
from pathlib import Path

import numpy as np

import retropole as rp
from retropole.base import se3
from retropole.simulation import write_pair

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--out", type=Path, default=Path("out"))
out = parser.parse_args().out

# Two recordings; yours come from your LiDARs.
write_pair(rp.simulate("street", seed=1), out)

result = rp.calibrate(out / "lidar0.pcd", out / "lidar1.pcd")
for reason in result.reasons:
    print(f"{reason.code}: {reason.message}")
T, covariance = result.T_target_source, result.covariance
if T is None or covariance is None:
    raise SystemExit(3)

print(result.status)
print(T.round(6))
sigma = np.sqrt(np.diag(covariance))
print("1 σ of the rotation, deg:", np.degrees(sigma[:3]).round(4))
print("1 σ of the translation, m:", sigma[3:].round(4))
for each in result.predicted_error:
    print(f"a point {each.range_m:g} m away is off by {1000 * each.sigma_m:.2g} mm (1 σ)")
if result.document.weakest is not None:
    print("least certain:", result.document.weakest.words)

# Source points in the target's frame; arrays (N, 4) would do for `calibrate` as well.
source = rp.read_cloud(out / "lidar1.pcd")
print("first source point, target frame:", se3.apply(T, source.xyz[:1]).round(3))

result.save(out / "result")
print(rp.load_result(out / "result"))
