"""Set the poles up three times: one pose for all, and how far each placement is from the rest.

python examples/several_placements.py --out out
"""

import argparse
from pathlib import Path

import numpy as np

import retropole as rp
from retropole.base.files import write_atomically
from retropole.checking.metrics import e_rt
from retropole.simulation import place_again, simulate_pair

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--out", type=Path, default=Path("out"))
out = parser.parse_args().out

rng = np.random.default_rng(2)
first = simulate_pair("street", rng)
pairs = [first, place_again(first, rng), place_again(first, rng)]

# Without the scene, to see what the placements do.
lines = []
for used in (pairs[:1], pairs):
    result = rp.calibrate(
        [p.target for p in used], [p.source for p in used], options=rp.RunConfig(refine=False)
    )
    if result.T_target_source is None:
        raise SystemExit(f"refused: {result.reasons[0].message}")
    off, stated = e_rt(result.T_target_source, first.T_target_source), result.predicted_error[2]
    lines.append(
        f"{len(used)} placements: off by {1000 * off:.0f} mm (e_rt), "
        f"predicted at {stated.range_m:g} m {1000 * stated.sigma_m:.2g} mm"
    )
for k, placement in enumerate(result.placements or ()):
    if placement.left_out is not None:
        degrees, cm = np.degrees(placement.left_out.rotation), 100 * placement.left_out.translation
        lines.append(f"the pose without placement {k}: {degrees:.2f}° and {cm:.1f} cm away")
print("\n".join(lines))
write_atomically(out / "placements.txt", "\n".join([*lines, ""]).encode())
