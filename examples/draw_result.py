"""Simulate a street, calibrate it, and draw both clouds before and after.

python examples/draw_result.py docs/images/result.png
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from retropole.pipeline import calibrate
from retropole.report.figures import result_figure
from retropole.simulation import simulate_pair


def main() -> None:
    path = Path(sys.argv[1] if len(sys.argv) > 1 else "result.png")
    pair = simulate_pair("street", np.random.default_rng(1))
    answer = calibrate(pair.target, pair.source)
    if answer.T_target_source is None:
        raise SystemExit(f"refused: {answer.reasons[0].message}")
    (placement,), chosen = answer.placements, answer.hypotheses[0]
    poles = (
        [placement.target.poles[i] for i, _ in chosen.match.pairs],
        [placement.source.poles[j] for _, j in chosen.match.pairs],
    )
    result_figure(pair.target, pair.source, answer.T_target_source, poles).savefig(path)
    print(f"written: {path}")


if __name__ == "__main__":
    main()
