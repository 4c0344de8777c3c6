"""How many taped poles are found, and how many other things are taken for one.

Simulates scenes whose every return has a label, and prints a Markdown table.

    python benchmarks/detection.py --seeds 50
"""

from __future__ import annotations

import argparse
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context

import numpy as np

from retropole import se3
from retropole.datatypes import Array, Detection, PointCloud
from retropole.extraction.poles import extract_poles
from retropole.simulation import SimulatedPair, simulate_pair

ENOUGH_RETURNS, ENOUGH_RINGS = 6, 3
"""A pole with so many returns above the threshold, on so many rings, ought to be found."""

PURE, WHOLE = 0.8, 0.6
"""A detected pole is a true one if so much of it lies on one, and holds so much of its returns."""


@dataclass(frozen=True)
class Outcome:
    """What came of one scan."""

    scene: str
    seed: int
    sensor: str
    known: bool
    visible: int
    found: int
    false: int
    angle: tuple[float, ...]
    offset: tuple[float, ...]
    seconds: float
    points: int
    retro: int
    misses: tuple[str, ...]


def score(pair: SimulatedPair, which: int, detection: Detection, cloud: PointCloud) -> tuple:  # type: ignore[type-arg]
    """Count poles that were visible, found, and falsely reported; errors of the found lines."""
    labels = pair.labels[which]
    first = len(pair.surfaces) - len(pair.poles)
    T_sensor_world = se3.inverse((pair.T_world_target, pair.T_world_source)[which])
    assert cloud.intensity is not None
    bright = cloud.intensity >= detection.threshold
    taken: set[int] = set()
    angles, offsets, misses = [], [], []
    visible = found = 0
    for k, truth in enumerate(pair.poles):
        on_it = (labels == first + k) & bright
        count = int(np.count_nonzero(on_it))
        rings = count if cloud.ring is None else len(np.unique(cloud.ring[on_it]))
        if count < ENOUGH_RETURNS or rings < ENOUGH_RINGS:
            continue
        visible += 1
        for j, pole in enumerate(detection.poles):
            share = float(np.mean(labels[pole.index] == first + k))
            if j not in taken and share >= PURE and share * len(pole.index) >= WHOLE * count:
                taken.add(j)
                found += 1
                axis = T_sensor_world[:3, :3] @ truth.axis
                angles.append(_angle(pole.direction, axis))
                centre = se3.apply(T_sensor_world, truth.centre[None])[0]
                offset = pole.point - centre
                offsets.append(float(np.linalg.norm(offset - (offset @ axis) * axis)))
                break
        else:
            ours = np.flatnonzero(on_it)
            why = [r.reason for r in detection.rejected if np.isin(ours, r.index).mean() > 0.3]
            misses.append(f"missed pole: {count} returns, {rings} rings: {'; '.join(why)}")
    strays = [p for j, p in enumerate(detection.poles) if j not in taken]
    for pole in strays:
        on, counts = np.unique(labels[pole.index], return_counts=True)
        parts = ", ".join(
            f"{n} on {type(pair.surfaces[s]).__name__} {s - first}"
            for s, n in zip(on, counts, strict=True)
        )
        misses.append(f"false: {pole.length:.2f} m, {parts}")
    return visible, found, len(strays), angles, offsets, misses


def _angle(a: Array, b: Array) -> float:
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), abs(a @ b)))


def run(job: tuple[str, int, tuple[str, str] | None, bool, int, bool]) -> list[Outcome]:
    scene, seed, sensors, known, poles, moved = job
    names = {} if sensors is None else dict(zip(("sensor_target", "sensor_source"), sensors))  # noqa: B905
    pair = simulate_pair(scene, np.random.default_rng(seed), poles=poles, **names)
    outcomes = []
    for which, cloud in enumerate((pair.target, pair.source)):
        if moved:
            # As another program would leave it: points turned and shifted, origin forgotten.
            T = se3.random(np.random.default_rng([seed, which]), 20.0)
            shown = PointCloud(se3.apply(T, cloud.xyz), cloud.intensity)
        else:
            T, shown = np.eye(4), cloud
        sensor = pair.sensors[which]
        start = time.perf_counter()
        detection = extract_poles(shown, sensor=sensor if known else None)
        seconds = time.perf_counter() - start
        counted = score(_moved(pair, which, T), which, detection, cloud)
        outcomes.append(
            Outcome(
                scene,
                seed,
                sensor.name,
                known,
                *counted[:3],
                tuple(counted[3]),
                tuple(counted[4]),
                seconds,
                len(cloud),
                detection.retro_points,
                tuple(counted[5]),
            )
        )
    return outcomes


def _moved(pair: SimulatedPair, which: int, T: Array) -> SimulatedPair:
    from dataclasses import replace

    name = ("T_world_target", "T_world_source")[which]
    return replace(pair, **{name: getattr(pair, name) @ se3.inverse(T)})


def table(outcomes: list[Outcome]) -> str:
    lines = [
        "| scene | sensor | scans | poles seen | recall | precision | scans with a false pole "
        "| angle, median / 95 % | to the axis, median | time, median / most |",
        "| --- |" + " --- |" * 9,
    ]
    keys = sorted({(o.scene, o.sensor) for o in outcomes})
    for key in [*keys, ("all", "all")]:
        group = [o for o in outcomes if key == ("all", "all") or (o.scene, o.sensor) == key]
        visible, found = sum(o.visible for o in group), sum(o.found for o in group)
        false = sum(o.false for o in group)
        angles = np.degrees([a for o in group for a in o.angle])
        offsets = [1000 * a for o in group for a in o.offset]
        seconds = [1000 * o.seconds for o in group]
        cells = [
            *key,
            str(len(group)),
            str(visible),
            f"{found / max(visible, 1):.2%}",
            f"{found / max(found + false, 1):.2%}",
            f"{sum(o.false > 0 for o in group) / len(group):.2%}",
            f"{np.median(angles):.2f}° / {np.quantile(angles, 0.95):.2f}°" if found else "–",
            f"{np.median(offsets):.1f} mm" if found else "–",
            f"{np.median(seconds):.0f} / {max(seconds):.0f} ms",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--scenes", nargs="+", default=["corridor", "street", "harbor"])
    parser.add_argument("--sensors", nargs=2, metavar=("TARGET", "SOURCE"))
    parser.add_argument("--poles", type=int, default=2)
    parser.add_argument("--moved", action="store_true", help="turn the clouds, forget the origin")
    parser.add_argument(
        "--known", action="store_true", help="tell the sensor instead of asking the cloud"
    )
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--verbose", action="store_true", help="print every miss and false pole")
    arguments = parser.parse_args()
    sensors = tuple(arguments.sensors) if arguments.sensors else None
    seeds = range(arguments.first, arguments.first + arguments.seeds)
    jobs = [
        (scene, seed, sensors, arguments.known, arguments.poles, arguments.moved)
        for scene in arguments.scenes
        for seed in seeds
    ]
    with ProcessPoolExecutor(arguments.processes, mp_context=get_context("spawn")) as pool:
        outcomes = [o for group in pool.map(run, jobs, chunksize=4) for o in group]
    if arguments.verbose:
        for o in outcomes:
            for miss in o.misses:
                print(f"{o.scene} {o.seed} {o.sensor}: {miss}")
    print(table(outcomes))


if __name__ == "__main__":
    main()
