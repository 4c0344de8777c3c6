"""Simulate two scans, calibrate them, compare the answer with the truth, export it for ROS 2.

python examples/simulate_and_export.py --out out
"""

import argparse
from pathlib import Path

import retropole as rp
from retropole.base.files import write_atomically
from retropole.checking.metrics import e_rt
from retropole.export import export_lines

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--out", type=Path, default=Path("out"))
out = parser.parse_args().out

pair = rp.simulate("harbor", seed=7, poles=3)
target, source = pair.sensors
result = rp.calibrate(pair.target, pair.source, sensor=(target.name, source.name))
if result.T_target_source is None:
    raise SystemExit(f"refused: {result.reasons[0].message}")

error = e_rt(result.T_target_source, pair.T_target_source)
print(f"{result.status}, e_rt {100 * error:.2f} cm, returns on the poles:", pair.returns_on_poles)

formats = export_lines(result.T_target_source, "front_lidar", "rear_lidar")
write_atomically(out / "front_to_rear.urdf", formats["urdf"].encode())
print(formats["ros2"])
