"""Simulate two scans, calibrate them, hold the answer against the truth, export it for ROS 2.

python examples/simulate_and_export.py --out out
"""

import argparse
from pathlib import Path

import numpy as np

from retropole.evaluation.metrics import e_rt
from retropole.export import export_lines
from retropole.files import write_atomically
from retropole.pipeline import calibrate
from retropole.simulation import simulate_pair

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--out", type=Path, default=Path("out"))
out = parser.parse_args().out

pair = simulate_pair("harbor", np.random.default_rng(7), poles=3)
answer = calibrate(pair.target, pair.source, sensors=pair.sensors)
if answer.T_target_source is None:
    raise SystemExit(f"refused: {answer.reasons[0].message}")

error = e_rt(answer.T_target_source, pair.T_target_source)
print(f"{answer.status}, e_rt {100 * error:.2f} cm, poles seen:", pair.returns_on_poles)

forms = export_lines(answer.T_target_source, "front_lidar", "rear_lidar")
write_atomically(out / "front_to_rear.urdf", forms["urdf"].encode())
print(forms["ros2"])
