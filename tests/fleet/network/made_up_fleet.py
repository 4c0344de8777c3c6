"""A small fleet of pairs along a street, one of them wrong, its list of nodes, and the truth."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from retropole.base import se3
from retropole.base.datatypes import Array
from tests.fleet.answered import SIGMA, answered_pair, refused_pair, write_answers

POSTS = 6
WRONG = "p1-p3"


class MadeUpFleet(NamedTuple):
    """Where the dataset and the list are, and the true poses of its nodes by name."""

    dataset: str
    nodes: Path
    truth: dict[str, Array]


def write_made_up_fleet(folder: Path) -> MadeUpFleet:
    """Join each post to the next two; three are surveyed, and one pair is wrong by 5 cm."""
    rng = np.random.default_rng(7)
    truth = {f"p{k}": se3.random(rng) for k in range(POSTS)}
    for k, T in enumerate(truth.values()):
        T[:3, 3] = [20.0 * k, 5.0 * (k % 2), 4.0 + k % 3]
    names = list(truth)
    pairs = [(a, b) for d in (1, 2) for a, b in zip(names, names[d:], strict=False)]
    rows, lines = [refused_pair("bad")], ["node,site,lidar,x_m,y_m,z_m,sigma_m"]
    for a, b in pairs:
        name = f"{a}-{b}"
        T = se3.retract(se3.inverse(truth[a]) @ truth[b], SIGMA * rng.normal(size=6))
        if name == WRONG:
            T[:3, 3] += [0.05, 0.0, 0.0]
        rows.append(answered_pair(name, T))
        lines += [f"{a},{name},target,,,,", f"{b},{name},source,,,,"]
    lines += ["p0,bad,target,,,,", "p9,bad,source,,,,"]
    for name in ("p0", "p1", "p5"):
        x, y, z = truth[name][:3, 3]
        lines.append(f"{name},,,{x},{y},{z},0.002")
    nodes = folder / "nodes.csv"
    nodes.write_text("\n".join(lines) + "\n")
    return MadeUpFleet(write_answers(folder / "fleet", rows), nodes, truth)
