"""Set the poles up three times: one pose for all, and how far each placement is from the rest.

python examples/several_placements.py --out out
"""

import argparse
from pathlib import Path

import numpy as np

from retropole.evaluation.metrics import e_rt
from retropole.files import write_atomically
from retropole.pipeline import calibrate
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
    answer = calibrate([p.target for p in used], [p.source for p in used], scene=False)
    if answer.T_target_source is None:
        raise SystemExit(f"refused: {answer.reasons[0].message}")
    off, said = e_rt(answer.T_target_source, first.T_target_source), answer.predicted_error[2]
    lines.append(
        f"{len(used)} placements: off by {100 * off:.1f} cm (e_rt), "
        f"predicted at {said[0]:g} m {100 * said[1]:.1f} cm"
    )
for k, placement in enumerate(answer.placements):
    if placement.left_out is not None:
        turned, moved = placement.left_out
        lines.append(
            f"without placement {k}: {np.degrees(turned):.2f}° and {100 * moved:.1f} cm away"
        )
print("\n".join(lines))
write_atomically(out / "placements.txt", "\n".join([*lines, ""]).encode())
