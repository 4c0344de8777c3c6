"""How often the stated 95 % region holds the truth, family of errors by family.

Each family adds one error to the ordinary noise of a scan, drawn once per LiDAR; mixtures have many
at once. Half of the families may set constants (`TUNING`), and state no figure; the others
(`STATING`) are run only to state them, and so are the seeds from 1000 up. Prints Markdown tables.

    python benchmarks/coverage.py --families tuning --runs 40
    python benchmarks/coverage.py --families stating --runs 300 --first 1000
    python benchmarks/coverage.py --families stating --only field --scenes square --runs 100 \
        --first 1000
    python benchmarks/coverage.py --families stating --runs 60 --first 1000 --measured
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from multiprocessing import get_context

import numpy as np
from scipy.stats import chi2

from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.base.sensors import Sensor
from retropole.base.systematic import sizes_of
from retropole.base.uncertainty import predicted_error
from retropole.checking.metrics import e_rt
from retropole.pipeline import Options, calibrate
from retropole.simulation import FIELD, TYPICAL, NoiseModel, SimulationError, simulate_pair

SCENES = ("corridor", "street", "harbor")
SENSORS = (
    (None, None),
    ("VLP-16", "VLP-16"),
    ("XT32", "PandarQT"),
    ("HDL-32E", "OS1"),
)
"""Pairs of sensors, one after the other; None takes the scene's own."""

DEGREE = float(np.radians(1.0))

TUNING: Mapping[str, NoiseModel] = {
    "ordinary noise": TYPICAL,
    "range offset 10 mm": replace(TYPICAL, zero_offset=0.010),
    "encoder 0.03°": replace(TYPICAL, encoder=0.03 * DEGREE),
    "range of rings 6 mm": replace(TYPICAL, ring_bias=0.006),
    "elevation of all beams 0.03°": replace(TYPICAL, elevation=0.03 * DEGREE),
    "elevation by 0.3 % of it": replace(TYPICAL, elevation_scale=0.003),
    "strongest of the footprint": replace(TYPICAL, footprint="strongest"),
    "pointing noise 0.03°": replace(TYPICAL, pointing_noise=0.03 * DEGREE),
    "4 people walking": replace(TYPICAL, movers=4),
    "mixture of these": replace(
        TYPICAL,
        zero_offset=0.007,
        encoder=0.02 * DEGREE,
        ring_bias=0.005,
        footprint="strongest",
        pointing_noise=0.02 * DEGREE,
        movers=2,
    ),
}
"""Families that constants may be set on."""

STATING: Mapping[str, NoiseModel] = {
    "range scale 0.05 %": replace(TYPICAL, scale=5e-4),
    "slanted surfaces": replace(TYPICAL, slant=5e-4),
    "elevation of rings 0.03°": replace(TYPICAL, ring_elevation=0.03 * DEGREE),
    "azimuth of rings 0.03°": replace(TYPICAL, ring_azimuth=0.03 * DEGREE),
    "wobble 0.01°": replace(TYPICAL, wobble=0.01 * DEGREE),
    "bent scan lines 0.02°": replace(TYPICAL, bend=0.02 * DEGREE),
    "range offset on tape 10 mm": replace(TYPICAL, retro_bias=0.010),
    "noise grows with range": replace(TYPICAL, noise_growth=0.5),
    "blooming 0.4°": replace(TYPICAL, blooming=0.4 * DEGREE),
    "wet ground": replace(TYPICAL, wet=0.6),
    "swaying mast 0.05°": replace(TYPICAL, sway=0.05 * DEGREE),
    "intensity falls": replace(TYPICAL, intensity_falloff=True),
    "first of the footprint": replace(TYPICAL, footprint="first"),
    "mixture of these": replace(
        TYPICAL,
        scale=2e-4,
        slant=3e-4,
        ring_elevation=0.015 * DEGREE,
        wobble=0.006 * DEGREE,
        retro_bias=0.006,
        noise_growth=0.25,
        blooming=0.2 * DEGREE,
        wet=0.3,
        intensity_falloff=True,
    ),
    "field, all at once": FIELD,
}
"""Families that state the figures."""

DRAWN = {"zero": "zero_offset", "tape": "retro_bias", "ring_range": "ring_bias"}
"""Names of errors in `NoiseModel`, where they are others than in `Sizes`."""

LEAST_MEASURED = 0.2
"""Part of what is assumed of a sensor, below which nobody measured its errors."""


def measured(sensor: Sensor, noise: NoiseModel) -> Sensor:
    """Say of a sensor how large the errors of a family are, as a file of a user would."""
    errors = {
        name: max(float(getattr(noise, DRAWN.get(name, name))), LEAST_MEASURED * assumed)
        for name, assumed in asdict(sizes_of(sensor)).items()
        if name != "width"
    }
    return replace(sensor, errors=errors)


@dataclass(frozen=True)
class Outcome:
    """What came of one run; for the poles and the refined pose: χ², stated and actual, e_rt."""

    family: str
    scene: str
    seed: int
    status: str
    codes: tuple[str, ...]
    chi2: tuple[float, float]
    stated: tuple[float, float]
    actual: tuple[float, float]
    e_rt: tuple[float, float]


def run(job: tuple[str, NoiseModel, int, tuple[str, ...], str]) -> Outcome:
    family, noise, seed, scenes, named = job
    scene = scenes[seed % len(scenes)]
    target, source = SENSORS[(seed // len(SCENES)) % len(SENSORS)]
    if scene not in SCENES:
        target = source = None
    nothing = (np.nan, np.nan)
    try:
        pair = simulate_pair(
            scene,
            np.random.default_rng(seed),
            sensor_target=target,
            sensor_source=source,
            noise=noise,
        )
    except SimulationError:
        return Outcome(family, scene, seed, "no scene", (), nothing, nothing, nothing, nothing)
    sensors: tuple[Sensor | None, Sensor | None] = pair.sensors
    if named != "by name":
        sensors = (None, None)
    if named == "measured":
        sensors = measured(pair.sensors[0], noise), measured(pair.sensors[1], noise)
    answer = calibrate(pair.target, pair.source, options=Options(sensors=sensors))
    codes = tuple(reason.code for reason in answer.reasons)
    if answer.poles is None:
        return Outcome(
            family, scene, seed, answer.status, codes, nothing, nothing, nothing, nothing
        )
    rows = []
    for pose in (answer.poles, answer.refined or answer.poles):
        assert pose.covariance is not None
        off = se3.local(pose.T_target_source, pair.T_target_source)
        rows.append(
            (
                float(off @ np.linalg.solve(pose.covariance, off)),
                at_30m(pose.covariance),
                at_30m(np.outer(off, off)),
                e_rt(pose.T_target_source, pair.T_target_source),
            )
        )
    columns = [(a, b) for a, b in zip(*rows, strict=True)]
    return Outcome(family, scene, seed, answer.status, codes, *columns)


def at_30m(covariance: Array) -> float:
    return predicted_error(covariance, (30.0,))[0].sigma_m


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--families", choices=["tuning", "stating"], default="tuning")
    parser.add_argument("--only", nargs="+", help="names of families, or parts of them")
    parser.add_argument("--scenes", nargs="+", default=SCENES, help="of retropole simulate")
    parser.add_argument("--runs", type=int, default=40, help="of each family")
    parser.add_argument("--first", type=int, default=0, help="first seed; from 1000 up to state")
    parser.add_argument("--processes", type=int, default=2)
    known = parser.add_mutually_exclusive_group()
    for flag, text in (
        ("unknown", "do not name the sensors"),
        ("measured", "say how large the errors of each family are"),
    ):
        known.add_argument(
            f"--{flag}",
            dest="named",
            action="store_const",
            const=flag,
            default="by name",
            help=text,
        )
    parser.add_argument("--verbose", action="store_true", help="print the runs outside the region")
    arguments = parser.parse_args()
    families = TUNING if arguments.families == "tuning" else STATING
    jobs = [
        (name, noise, arguments.first + k, tuple(arguments.scenes), arguments.named)
        for name, noise in families.items()
        if not arguments.only or any(part in name for part in arguments.only)
        for k in range(arguments.runs)
    ]
    outcomes: dict[str, list[Outcome]] = {}
    with ProcessPoolExecutor(arguments.processes, mp_context=get_context("spawn")) as pool:
        for outcome in pool.map(run, jobs, chunksize=4):
            outcomes.setdefault(outcome.family, []).append(outcome)
    head = ["family", "places", "sensors", "answered", "poles: 95 % region", "refined: 95 % region"]
    for what in ("χ²", "stated / actual at 30 m", "e_rt m"):
        head += [f"median {what}, {of}" for of in ("poles", "refined")]
    head.append("off by > 0.3 m at 30 m")
    print("| " + " | ".join(head) + " |\n" + "| --- " * len(head) + "|")
    limit = chi2.ppf(0.95, 6)
    for family, group in outcomes.items():
        name = f"| {family} | {', '.join(arguments.scenes)} | {arguments.named} |"
        there = [o for o in group if np.isfinite(o.chi2[0])]
        if not there:
            print(f"{name} 0 of {len(group)} |")
            continue
        cells = [f"{len(there)} of {len(group)}"]
        for values in (
            [f"{100 * np.mean([o.chi2[k] < limit for o in there]):.1f} %" for k in (0, 1)],
            [f"{np.median([o.chi2[k] for o in there]):.1f}" for k in (0, 1)],
            [f"{np.median([o.stated[k] / o.actual[k] for o in there]):.2f}" for k in (0, 1)],
            [f"{np.median([o.e_rt[k] for o in there]):.4f}" for k in (0, 1)],
        ):
            cells += values
        cells.append(str(sum(o.status != "refused" and o.actual[1] > 0.3 for o in there)))
        print(f"{name} " + " | ".join(cells) + " |", flush=True)
    codes = Counter(code for group in outcomes.values() for o in group for code in o.codes)
    print("\n" + ", ".join(f"{code} {count}" for code, count in codes.most_common()))
    if arguments.verbose:
        for group in outcomes.values():
            for o in group:
                if max(o.chi2) > limit:
                    print(o)


if __name__ == "__main__":
    main()
