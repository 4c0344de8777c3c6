"""Make the recordings of a site where one thing is wrong, whose true poses are known.

Writes what `retropole simulate site` writes; truth.json says what is wrong, too.
docs/evidence/index.md says what each blunder is.

example:
  python benchmarks/blunder.py truck pole --lidars 5 --nuisances field --out s
  retropole site calibrate s
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from retropole.base.datatypes import DEFAULT_RADIUS
from retropole.base.errors import RetropoleError, printable
from retropole.simulation import NOISE_MODELS, SITES, Survey
from site_blunders import BLUNDERS, simulate_blunder, write_blunder


def main(words: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("kind", choices=SITES, help="where the LiDARs stand")
    parser.add_argument("blunder", choices=BLUNDERS, help="what is wrong; control with --survey")
    parser.add_argument("--out", type=Path, default=Path("retropole-site"), help="folder")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--lidars", type=int, default=4)
    parser.add_argument("--placements", type=int, help="of the poles; 2, of a ring one a LiDAR")
    parser.add_argument("--poles", type=int, help="in each placement; 3, of a ring 2")
    parser.add_argument("--sensor", action="append", help="name; several are taken in turn")
    parser.add_argument(
        "--radius", type=float, default=DEFAULT_RADIUS, help="of the poles, m, tape included"
    )
    parser.add_argument("--nuisances", choices=list(NOISE_MODELS), default="typical")
    parser.add_argument(
        "--survey",
        action="store_true",
        help="survey the poles of placement 1 and four control points",
    )
    given = parser.parse_args(words)
    try:
        site, wrong = simulate_blunder(
            given.kind,
            np.random.default_rng(given.seed),
            given.blunder,
            lidars=given.lidars,
            placements=given.placements,
            poles=given.poles,
            sensors=given.sensor,
            radius=given.radius,
            noise=NOISE_MODELS[given.nuisances],
            survey=Survey(placements=(0,), points=4) if given.survey else None,
        )
        write_blunder(site, wrong, given.out)
    except (RetropoleError, OSError) as error:
        parser.exit(2, f"{parser.prog}: error: {printable(str(error))}\n")
    print(f"written: {printable(str(given.out / 'site.toml'))}, truth.json and the recordings")
    print(f"wrong: {wrong.name}")


if __name__ == "__main__":
    main()
