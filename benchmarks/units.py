"""How often clouds that are both in feet, inches, centimetres or millimetres are told as such.

Simulated corridors, streets and harbors in turn, sensors and noise by turns; every pair is read as
if it were in metres. Beside these, pairs in metres that must not be told to be anything else:
ordinary ones, ones without poles, and ones whose poles are thicker than --radius says, where the
hint names that as well. Prints a Markdown table: what was refused and why, which unit was named by
``calibrate``, and which by ``info`` for each of the two clouds alone.

    python benchmarks/units.py --seeds 1000:1036

Seeds below 1000 are for setting constants; those from 1000 on state figures.
"""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import replace

import numpy as np

from again import record_again
from retropole.base.datatypes import PointCloud
from retropole.io.fields import METRES, Unit
from retropole.pipeline import Options, calibrate
from retropole.simulation import NOISE_MODELS, simulate_pair
from retropole.verdict.similarity import unit_of_one

SCENES = "corridor", "street", "harbor"
SENSORS = ("XT32", "VLP-16"), ("Pandar64", "OS1"), ("HDL-32E", "PandarQT"), ("VLP-32C", "XT32")
NOISE = "typical", "field"
RADIUS = 0.02
THICK = 0.03, 0.05, 0.066
KINDS: dict[str, tuple[Unit, float, bool]] = {
    "feet": ("ft", RADIUS, True),
    "inches": ("in", RADIUS, True),
    "centimetres": ("cm", RADIUS, True),
    "millimetres": ("mm", RADIUS, True),
    "metres": ("m", RADIUS, True),
    "metres, no poles": ("m", RADIUS, False),
    **{f"metres, radius {1000 * r:g} mm, {1000 * RADIUS:g} given": ("m", r, True) for r in THICK},
}
"""The unit, the radius of the poles, and whether there are any."""


def counted(cloud: PointCloud, unit: Unit) -> PointCloud:
    """Count the coordinates of a cloud in a unit."""
    size = METRES[unit]
    return replace(cloud, xyz=cloud.xyz / size, origin=cloud.origin / size)


def pair_of(kind: str, seed: int) -> tuple[PointCloud, PointCloud]:
    """Draw a pair, its coordinates as they are given."""
    unit, radius, with_poles = KINDS[kind]
    target, source = SENSORS[seed // 3 % 4]
    rng = np.random.default_rng(seed)
    pair = simulate_pair(
        SCENES[seed % 3],
        rng,
        sensor_target=target,
        sensor_source=source,
        radius=radius,
        noise=NOISE_MODELS[NOISE[seed // 12 % 2]],
    )
    if not with_poles:
        pair = record_again(pair, rng, poles=False)
    return counted(pair.target, unit), counted(pair.source, unit)


def by_poles(cloud: PointCloud) -> str:
    """The unit that ``retropole info`` names of one cloud, if any."""
    shown = unit_of_one(cloud, RADIUS)
    return "" if shown is None else shown[0]


def outcome(pair: tuple[PointCloud, PointCloud]) -> tuple[str, str]:
    """What came of a pair: its verdict, and the unit that is named, if any."""
    answer = calibrate(*pair, options=Options(radius=RADIUS))
    if answer.status != "refused":
        return "answered", ""
    reason = answer.reasons[0]
    return reason.code, str(reason.values.get("unit") or reason.values.get("units") or "")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seeds", default="1000:1036", help="FIRST:END")
    parser.add_argument("--kinds", nargs="*", choices=list(KINDS), default=list(KINDS))
    options = parser.parse_args()
    first, end = map(int, options.seeds.split(":"))
    header = (
        *("coordinates", "pairs", "answered", "`calibrate` names", "refused otherwise"),
        *("clouds", "`info` names"),
    )
    print("| " + " | ".join(header) + " |\n" + "| --- " * len(header) + "|")
    for kind in options.kinds:
        answered = 0
        named, other, alone = Counter[str](), Counter[str](), Counter[str]()
        for seed in range(first, end):
            pair = pair_of(kind, seed)
            code, unit = outcome(pair)
            alone.update(filter(None, map(by_poles, pair)))
            answered += code == "answered"
            if unit:
                named[unit] += 1
            elif code != "answered":
                other[code] += 1
        said = [
            ", ".join(f"{words} {n}" for words, n in each.most_common())
            for each in (named, other, alone)
        ]
        pairs = end - first
        cells = kind, pairs, answered, said[0], said[1], 2 * pairs, said[2]
        print("|", " | ".join(map(str, cells)), "|", flush=True)


if __name__ == "__main__":
    main()
