"""Score transforms that some other tool found, by the clouds they align.

python examples/evaluate_transform.py --out out
"""

import argparse
from pathlib import Path

import numpy as np

import retropole as rp
from retropole.base import se3
from retropole.base.files import write_atomically
from retropole.export import export_lines

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--out", type=Path, default=Path("out"))
out = parser.parse_args().out

pair = rp.simulate("corridor", seed=4)
T_true = pair.T_target_source
candidates = {
    "true": T_true,
    "rotated by 0.5°": se3.retract(T_true, np.array([0, 0, np.radians(0.5), 0, 0, 0])),
    "translated by 10 cm": se3.retract(T_true, np.array([0, 0, 0, 0.1, 0, 0])),
    "identity": np.eye(4),
}
print(f"{'transform':<20}{'overlap':>9}{'planes':>10}{'entropy sum':>13}")
for name, T in candidates.items():
    # Any file that `retropole export` reads will do: URDF, YAML, a ROS line, a matrix.
    file = out / f"{name.split()[0]}.txt"
    write_atomically(file, export_lines(T)["matrix"].encode())
    found = rp.evaluate(pair.target, pair.source, file)
    residual = "–" if found.plane_residual is None else f"{1000 * found.plane_residual:.1f} mm"
    print(f"{name:<20}{found.overlap:>9.3f}{residual:>10}{found.entropy.sum:>13.5f}")
