"""Judge a transform that some other tool found, by the clouds it aligns.

python examples/judge_transform.py --out out
"""

import argparse
from pathlib import Path

import numpy as np

from retropole import se3
from retropole.evaluation.metrics import evaluate
from retropole.export import export_lines, read_transform
from retropole.files import write_atomically
from retropole.simulation import simulate_pair

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--out", type=Path, default=Path("out"))
out = parser.parse_args().out

pair = simulate_pair("corridor", np.random.default_rng(4))
candidates = {
    "true": pair.T_target_source,
    "turned by 0.5°": se3.retract(pair.T_target_source, np.array([0, 0, np.radians(0.5), 0, 0, 0])),
    "shifted by 10 cm": se3.retract(pair.T_target_source, np.array([0, 0, 0, 0.1, 0, 0])),
    "identity": np.eye(4),
}
print(f"{'transform':<18}{'overlap':>9}{'planes':>10}{'entropy sum':>13}")
for name, T in candidates.items():
    # Any file that `retropole export` reads will do: URDF, YAML, a ROS line, a matrix.
    file = out / f"{name.split()[0]}.txt"
    write_atomically(file, export_lines(T, "target", "source")["matrix"].encode())
    found = evaluate(
        pair.target,
        pair.source,
        read_transform(file).T_parent_child,
        rng=np.random.default_rng(0),
    )
    residual = "–" if found.plane_residual is None else f"{1000 * found.plane_residual:.1f} mm"
    print(f"{name:<18}{found.overlap:>9.3f}{residual:>10}{found.entropy.sum:>13.5f}")
