"""Recordings of different places, mixed up: how many answers, where none is right.

A wrong pair has its target recorded at one place and its source at another, with the same taped
poles cast into both, as each LiDAR would have seen them had both stood about one pair of LiDARs:
the poles agree with each other exactly, the ground is level under both, and timestamps, which would
tell, are left out. The bearing and the
distance between the LiDARs are those of a right pair, drawn by the seed; half of the draws mix two
recordings of the same rig, a Pandar64 and a PandarQT, the others any two. Every answer is wrong.

Right pairs are those of `semireal`, in two ways. As there, poles stand wherever eight returns meet
them, and where the reference says. Well placed, they stand as poles of a real recording do, in the
scene itself, to which GICP registers the reference first, and as the documentation asks: with
returns and lean enough that no warning about weak poles is due by the way that they were set up.

Prints Markdown tables, shares with their exact 95 % interval (Clopper and Pearson 1934). `data` is
the folder with the recordings. It has few places: the draws vary poles, LiDARs and the way they
stand, not the place. Seeds below 1000 are for tuning, those from 1000 on, where this starts, state
figures.

    python benchmarks/wrong_files.py data --wrong 200 --right 13
"""

from __future__ import annotations

import argparse
import zlib
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from deception import interval
from hard_scenes import FIRST_STATED_SEED
from insertion import insert_poles
from retropole.base import se3
from retropole.base.datatypes import Array, Calibration, PointCloud
from retropole.base.sensors import Sensor, find_sensor
from retropole.io import read_cloud
from retropole.pipeline import Options, calibrate
from retropole.simulation import SimulationError
from retropole.surfaces.registration import prepare, register
from semireal import COMPOSED, DIRECT, PAIRS, UP, WRONG_DEG, WRONG_M, Outcome, load
from semireal import run as run_right

PLACES = {
    "pandaset": "PandaSet sequence 002, a standing vehicle",
    "pandar_scene1": "a car park",
    "pandar_0001": "a road",
    "pjlab_0003": "a wide road",
    "planes_top_front": "three planes",
    "hdl32": "a drive with an HDL-32E, one frame",
}
"""Folders, and what they show. All frames and LiDARs of one folder are of one place."""

ALONE = {"hdl32": ("formats/velodyne/sample_velodyne_hdl32.pcap", "HDL-32E", 1)}
"""Recordings of one LiDAR alone: file, sensor and frame."""

DRAWS = 8
"""Mix-ups that a seed tries before it is given up: not every two have room for the same poles."""

GOOD_RETURNS, GOOD_ANGLE, GOOD_DRAWS = 16, float(np.radians(20.0)), 40
"""Poles are well placed with so many returns of each LiDAR, a third more than `verdict` warns of,
since dim ones at the edges are lost, and so far from parallel, rad; poles that are drawn for it."""

VOXEL, REACH = 0.1, 0.5
"""GICP's voxel and correspondence distance, metres: it moves the references by 0.03° to 0.9° and 8
to 80 mm."""

NEAR, STEEPEST, THICKNESS = (2.0, 12.0), float(np.radians(12.0)), 0.05
"""The ground is looked for so far away, metres, so near to level, and is so thick, metres."""


@dataclass(frozen=True, eq=False)
class Recording:
    """One LiDAR's cloud: up in its frame, and how high it hangs over the ground, metres."""

    name: str
    place: str
    cloud: PointCloud
    sensor: Sensor | None
    up: Array
    height: float


@dataclass(frozen=True)
class Wrong:
    """What came of a wrong pair; how far the answer is from where the poles put it."""

    seed: int
    status: str = "no place"
    codes: tuple[str, ...] = ()
    message: str = ""
    degrees: float = np.nan
    metres: float = np.nan
    names: tuple[str, str] = ("", "")
    places: tuple[str, str] = ("", "")
    is_rig: bool = False


@dataclass(frozen=True)
class Right:
    """What came of a right pair with well-placed poles; how far the answer is off."""

    pair: str
    seed: int
    status: str = "no place"
    codes: tuple[str, ...] = ()
    message: str = ""
    degrees: float = np.nan
    metres: float = np.nan


@cache
def recordings(data: Path) -> dict[str, Recording]:
    """Every recording once."""
    found: dict[str, Recording] = {}
    for pair in PAIRS:
        loaded = load(pair.name, data)
        ups = loaded.up, loaded.T[:3, :3].T @ loaded.up
        clouds = loaded.target, loaded.source
        files = pair.target, pair.source
        for file, cloud, up, sensor in zip(files, clouds, ups, loaded.sensors, strict=True):
            name = f"{pair.folder}/{file}"
            if name not in found:
                found[name] = _standing(name, pair.folder, cloud, sensor, up)
    for place, (file, name, frame) in ALONE.items():
        cloud = read_cloud(data / file)
        assert cloud.frame is not None
        cloud = replace(cloud.select(cloud.frame == frame), frame=None)
        found[file] = _standing(file, place, cloud, find_sensor(name), UP)
    return found


def _standing(
    name: str, place: str, cloud: PointCloud, sensor: Sensor | None, up: Array
) -> Recording:
    """Find the ground about a LiDAR whose up is known roughly; times go: the scene has to tell."""
    cloud = replace(cloud, time=None, recorded=None)
    ranges = np.linalg.norm(cloud.xyz - cloud.origin, axis=1)
    points = cloud.xyz[(ranges > NEAR[0]) & (ranges < NEAR[1])] - cloud.origin
    points = points[points @ up < 0]
    rng = np.random.default_rng(0)
    a, b, c = (points[rng.integers(len(points), size=2000)] for _ in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-9)[:, None]
    normals *= np.sign(normals @ up)[:, None]
    level = normals @ up > np.cos(STEEPEST)
    normals, heights = normals[level], -np.einsum("ij,ij->i", a, normals)[level]
    votes = [
        np.count_nonzero(np.abs(points @ normal + height) < THICKNESS)
        for normal, height in zip(normals, heights, strict=True)
    ]
    best = int(np.argmax(votes))
    return Recording(name, place, cloud, sensor, normals[best], float(heights[best]))


def _level(up: Array) -> Array:
    """The shortest turn (4, 4) that takes a direction to z."""
    across = np.cross(up, UP)
    sine = float(np.linalg.norm(across))
    angle = np.arctan2(sine, up @ UP)
    return se3.from_rt(se3.exp_so3(across * (angle / max(sine, 1e-9))), np.zeros(3))


def pose_of(pair: str, target: Recording, source: Recording, data: Path) -> Array:
    """The pose of a right pair, seen from above, of two LiDARs that stand on one level ground."""
    right = load(pair, data)
    flat = _level(right.up) @ right.T @ se3.inverse(_level(right.T[:3, :3].T @ right.up))
    yaw = np.arctan2(flat[1, 0], flat[0, 0])
    shift = np.r_[flat[:2, 3], source.height - target.height]
    planar = se3.from_rt(se3.exp_so3(yaw * UP), shift)
    return se3.inverse(_level(target.up)) @ planar @ _level(source.up)


def mixed_up(rng: np.random.Generator, data: Path) -> tuple[Recording, Recording, str, bool]:
    """Draw a target, a source of another place, and the right pair whose pose they get."""
    own = list(recordings(data).values())
    is_rig = bool(rng.uniform() < 0.5)
    while True:
        target, source = (own[int(k)] for k in rng.integers(len(own), size=2))
        names = [None if one.sensor is None else one.sensor.name for one in (target, source)]
        if target.place == source.place or (is_rig and names != ["Pandar64", "PandarQT"]):
            continue
        pair = PAIRS[int(rng.integers(len(PAIRS)))]
        if not is_rig or pair.sensors == ("Pandar64", "PandarQT"):
            return target, source, pair.name, is_rig


def _said(answer: Calibration) -> tuple[str, tuple[str, ...], str]:
    codes = tuple(reason.code for reason in answer.reasons)
    return answer.status, codes, "; ".join(reason.message for reason in answer.reasons)


def _apart(answer: Calibration, T: Array) -> tuple[float, float]:
    """Degrees and metres from a pose; nan without an answer."""
    if answer.T_target_source is None:
        return np.nan, np.nan
    off = se3.difference(answer.T_target_source, T)
    return float(np.degrees(off.rotation)), off.translation


def run_wrong(job: tuple[int, Path]) -> Wrong:
    seed, data = job
    rng = np.random.default_rng([zlib.crc32(b"wrong files"), seed])
    for _ in range(DRAWS):
        target, source, pair, is_rig = mixed_up(rng, data)
        T = pose_of(pair, target, source, data)
        sensors = target.sensor, source.sensor
        try:
            made = insert_poles(target.cloud, source.cloud, T, rng, sensors=sensors, up=target.up)
        except SimulationError:
            continue
        answer = calibrate(made.target, made.source, options=Options(sensors=sensors))
        names, places = (target.name, source.name), (target.place, source.place)
        return Wrong(seed, *_said(answer), *_apart(answer, T), names, places, is_rig)
    return Wrong(seed)


@cache
def registered(pair: str, data: Path) -> Array:
    """The reference of a right pair, moved onto the scene; between two PandarQT, of both to p64."""
    first, *others = pair.removeprefix("scene1 ").split()
    if next(each for each in PAIRS if each.name == pair).is_composed:
        to_p64 = [registered(f"scene1 p64 {number}", data) for number in (first, others[0])]
        return se3.inverse(to_p64[0]) @ to_p64[1]
    loaded = load(pair, data)
    target, source = (prepare(each.xyz, VOXEL) for each in (loaded.target, loaded.source))
    found = register(target, source, loaded.T, method="GICP", max_correspondence_distance=REACH)
    return found.T_target_source


def run_well_placed(job: tuple[str, int, Path]) -> Right:
    name, seed, data = job
    given, T = load(name, data), registered(name, data)
    rng = np.random.default_rng([zlib.crc32(name.encode()), seed])
    for _ in range(GOOD_DRAWS):
        try:
            made = insert_poles(
                given.target, given.source, T, rng, sensors=given.sensors, up=given.up
            )
        except SimulationError:
            break
        cosine = abs(float(made.poles[0].axis @ made.poles[1].axis))
        if min(map(min, made.returns_on_poles)) < GOOD_RETURNS or cosine > np.cos(GOOD_ANGLE):
            continue
        answer = calibrate(made.target, made.source, options=Options(sensors=made.sensors))
        return Right(name, seed, *_said(answer), *_apart(answer, T))
    return Right(name, seed)


def row(name: str, own: Sequence[Wrong | Outcome | Right]) -> str:
    """Give a line of either table: draws, verdicts, and the codes of what is not ok."""
    drawn = [o for o in own if o.status != "no place"]
    count = Counter(o.status for o in drawn)
    kinds = ("ok", "warn", "refused")
    cells = [name, len(own) - len(drawn), len(drawn), *(count[kind] for kind in kinds)]
    cells += [interval(count[kind], len(drawn)) for kind in kinds[:2]]
    for kind in kinds[1:]:
        codes = Counter(code for o in drawn if o.status == kind for code in set(o.codes))
        cells.append(", ".join(f"{code} {times}" for code, times in codes.most_common()))
    return "| " + " | ".join(map(str, cells)) + " |"


HEAD = (
    "no place",
    *("draws", "ok", "warn", "refused", "ok, % (95 %)", "warn, % (95 %)"),
    *("codes of warnings", "of refusals"),
)


def table(first: str, groups: Sequence[tuple[str, Sequence[Wrong | Outcome | Right]]]) -> str:
    lines = [f"| {' | '.join((first, *HEAD))} |", "| --- " * (len(HEAD) + 1) + "|"]
    return "\n".join([*lines, *(row(name, own) for name, own in groups if own)])


def wrong_groups(outcomes: Sequence[Wrong]) -> list[tuple[str, Sequence[Wrong]]]:
    places = sorted({o.places for o in outcomes if o.status != "no place"})
    groups: list[tuple[str, Sequence[Wrong]]] = [
        (" ← ".join(each), [o for o in outcomes if o.places == each]) for each in places
    ]
    groups.append(("two of one rig", [o for o in outcomes if o.is_rig]))
    groups.append(("two of different rigs", [o for o in outcomes if not o.is_rig]))
    return [*groups, ("all", outcomes)]


def right_groups(
    outcomes: Sequence[Outcome | Right],
) -> list[tuple[str, Sequence[Outcome | Right]]]:
    groups: list[tuple[str, Sequence[Outcome | Right]]] = [
        (pair.name, [o for o in outcomes if o.pair == pair.name]) for pair in PAIRS
    ]
    composed = {pair.name for pair in PAIRS if pair.is_composed}
    for name, own in ((DIRECT, False), (COMPOSED, True)):
        group = [o for o in outcomes if (o.pair in composed) == own]
        groups.append((name.removeprefix("all "), group))
    return [*groups, ("all", outcomes)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path, help="folder with the recordings")
    parser.add_argument("--wrong", type=int, default=200, help="draws of wrong pairs")
    parser.add_argument("--right", type=int, default=13, help="draws of each right pair")
    parser.add_argument("--first", type=int, default=FIRST_STATED_SEED, help="first seed")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--verbose", action="store_true", help="print every draw as it ends")
    arguments = parser.parse_args()
    first, data = arguments.first, arguments.data
    wrong, right, well = [], [], []
    with ProcessPoolExecutor(
        arguments.processes,
        mp_context=get_context("spawn"),
        initializer=threadpool_limits,
        initargs=(1,),
    ) as pool:
        jobs = [(seed, data) for seed in range(first, first + arguments.wrong)]
        for one in pool.map(run_wrong, jobs):
            wrong.append(one)
            if arguments.verbose:
                print(one, flush=True)
        seeds = range(first, first + arguments.right)
        rights = [(pair.name, seed, data) for pair in PAIRS for seed in seeds]
        for o in pool.map(run_right, rights, chunksize=max(1, arguments.right)):
            right.append(o)
            if arguments.verbose:
                print(o, flush=True)
        for one_right in pool.map(run_well_placed, rights, chunksize=max(1, arguments.right)):
            well.append(one_right)
            if arguments.verbose:
                print(one_right, flush=True)
    pairs = {o.places for o in wrong if o.status != "no place"}
    places = {place for each in pairs for place in each}
    listed = "; ".join(f"{name}: {PLACES[name]}" for name in sorted(places))
    files = {o.names for o in wrong if o.status != "no place"}
    print(
        f"The wrong pairs are of {len(places)} distinct places ({listed}), which make "
        f"{len(pairs)} mix-ups of places and {len(files)} of files: the rest of the variety is "
        "in the poles and in how the LiDARs stand to each other.\n"
    )
    print(table("wrong pair: target ← source", wrong_groups(wrong)))
    print("\n" + table("right pair, well placed", right_groups(well)))
    off = sum(o.degrees > WRONG_DEG or o.metres > WRONG_M for o in well)
    print(f"\n{off} of these answers lie beyond {WRONG_DEG:g}° or {WRONG_M:g} m.\n")
    print(table("right pair, as in semireal", right_groups(right)))


if __name__ == "__main__":
    main()
