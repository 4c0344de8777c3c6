"""Whether another version of the code gives the same answers on 60 simulated pairs.

Three scenes; among the pairs are symmetric places, parallel poles, three poles, several frames, a
dark pole, two places mixed up and a cloud without intensity. Pairs are drawn and answers recorded
with one version, and compared with another:

    python benchmarks/same_answers.py record /tmp/answers.pkl
    python benchmarks/same_answers.py compare /tmp/answers.pkl
"""

from __future__ import annotations

import argparse
import pickle
from pathlib import Path
from typing import Any

import numpy as np

from retropole import se3
from retropole.datatypes import PointCloud
from retropole.pipeline import calibrate
from retropole.sensors import find_sensor
from retropole.simulation import simulate_pair

PAIRS, FIRST_SEED = 60, 7000
SCENES = ("corridor", "street", "harbor")
FIELDS = ("xyz", "intensity", "ring", "time", "frame", "origin")
VARIANTS: tuple[dict[str, Any], ...] = (
    {"symmetric": True},
    {"min_pole_angle": 0.0, "max_pole_angle": float(np.radians(3))},
    {"poles": 3},
    {"frames": 4},
)


def draw() -> list[dict[str, Any]]:
    """Draw the pairs as plain arrays, so that another version reads them."""
    pairs = []
    for k in range(PAIRS):
        options = VARIANTS[(k // 3) % 4] if k >= 48 else {}
        rng = np.random.default_rng(FIRST_SEED + k)
        pair = simulate_pair(SCENES[k % 3], rng, **options)
        clouds = [{n: getattr(c, n) for n in FIELDS} for c in (pair.target, pair.source)]
        pairs.append({"clouds": clouds, "sensors": [s.name for s in pair.sensors]})
    dark = pairs[3]["clouds"][0]
    dark["intensity"] = np.minimum(dark["intensity"], 50.0)
    pairs[7]["clouds"][1] = pairs[20]["clouds"][1]
    pairs[11]["clouds"][1]["intensity"] = None
    return pairs


def answer(k: int, pair: dict[str, Any]) -> dict[str, Any]:
    """Calibrate: every other pair with its sensors named, every fifth with its radius estimated."""
    known = [find_sensor(name) for name in pair["sensors"]] if k % 2 else [None, None]
    found = calibrate(
        *(PointCloud(**cloud) for cloud in pair["clouds"]),
        sensors=(known[0], known[1]),
        radius_sigma=0.002 if k % 5 == 0 else 0.0,
    )
    poses = [
        None if pose is None else (pose.T_target_source, pose.covariance)
        for pose in (found.poles, found.refined)
    ]
    return {
        "verdict": (found.status, [r.code for r in found.reasons], len(found.hypotheses)),
        "poses": poses,
        "margin": found.margin,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("record", "compare"))
    parser.add_argument("file", type=Path)
    arguments = parser.parse_args()
    if arguments.what == "record":
        pairs = draw()
        answers = [answer(k, pair) for k, pair in enumerate(pairs)]
        arguments.file.write_bytes(pickle.dumps((pairs, answers)))
        return
    pairs, before = pickle.loads(arguments.file.read_bytes())
    other = []
    most = {"pose over stated sigma": 0.0, "covariance, relative": 0.0, "margin": 0.0}
    for k, (pair, old) in enumerate(zip(pairs, before, strict=True)):
        new = answer(k, pair)
        if new["verdict"] != old["verdict"] or (new["margin"] is None) != (old["margin"] is None):
            other.append((k, old["verdict"], new["verdict"]))
            continue
        if new["margin"] is not None:
            most["margin"] = max(most["margin"], abs(new["margin"] - old["margin"]))
        for (T, C), (T_new, C_new) in (
            (a, b) for a, b in zip(old["poses"], new["poses"], strict=True) if a is not None
        ):
            step = np.abs(se3.local(T, T_new)) / np.sqrt(np.diag(C))
            relative = np.abs(C_new - C).max() / np.abs(C).max()
            most["pose over stated sigma"] = max(most["pose over stated sigma"], step.max())
            most["covariance, relative"] = max(most["covariance, relative"], relative)
    print(f"{len(pairs)} pairs, {len(other)} with another verdict {other}")
    print(", ".join(f"{name}: {value:.1e}" for name, value in most.items()))


if __name__ == "__main__":
    main()
