"""Walks with one carried pole: how many are answered, how far off, and within what is stated?

Usage:
    python benchmarks/carried.py --seeds 12
    python benchmarks/carried.py --seeds 12 --seconds 60 --sensors XT32 VLP-16 --noise field
    python benchmarks/carried.py --seeds 12 --mixed
    python benchmarks/carried.py --seeds 4 --deceive
    python benchmarks/carried.py --seeds 12 --watch 0.03
    python benchmarks/carried.py --seeds 12 --lidars 3

A walk with all errors of a noise model in a street, a harbor or on bare ground, seed by seed: by
the pole alone, and with the surfaces around that every tenth sweep shows. With --deceive each is
spoilt in one way: two poles are carried, the pole never leans, the source's clock jumps, or it
steps by 20 ms. With --mixed sensors and length change from seed to seed, two OS1-128 without ring
numbers among them. An answer is wrong where it is off by more than 5 σ, and by 5 cm or more at
30 m or by 5 ms. With --watch each is watched with that need at 30 m, in metres, until it stops by
itself. With --lidars three or more record a walk, as those of a site, the others with the second
sensor. Seeds below 1000 tune; seeds from 5000 state.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, wait
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from retropole.adjustment.answer import SiteCalibration
from retropole.alignment.certainty import chi2_limit
from retropole.api.watching import Wish
from retropole.api.watching_walk import WalkWatch
from retropole.base import se3
from retropole.base.datatypes import (
    DEFAULT_RADIUS,
    PER_POINT,
    Array,
    Placement,
    PointCloud,
    Scan,
)
from retropole.base.description import Site, SiteLidar
from retropole.base.errors import Refusal
from retropole.base.sensors import Sensor
from retropole.base.uncertainty import predicted_error
from retropole.base.uncertainty.purpose import displacement
from retropole.carried.site import state_walk_of_site
from retropole.carried.statement import state_walk
from retropole.carried.track import find_track
from retropole.carried.walk import calibrate_walk, solve_tracks
from retropole.hypotheses.scans import SiteScans
from retropole.io import Frame
from retropole.result import RunConfig
from retropole.result.watching import WatchDoc
from retropole.simulation import NOISE_MODELS
from retropole.simulation.walks import SimulatedWalk, simulate_walk
from retropole.surfaces.scans import find_poles

SCENES = "street", "harbor", "bare"
DECEPTIONS = "two", "upright", "jump", "step"
SENSORS = (
    ("VLP-16", "VLP-16"),
    ("XT32", "VLP-16"),
    ("OS1-128", "OS1-128"),
    ("OS1-128", "XT32"),
    ("Mid-360", "VLP-16"),
    ("Mid-360", "Mid-360"),
    ("Mid-360", "OS1-128"),
)
SECONDS = 20.0, 40.0, 60.0
WITHOUT_RINGS = "OS1-128", "OS1-128"
AT, WRONG, WRONG_CLOCK, SIGMAS = 30.0, 0.05, 0.005, 5.0
EVERY = 10
"""So many sweeps apart are those that show the surfaces around."""

CHI2 = 12.592
"""95 % of χ² with six degrees of freedom."""

JUMPS = {"jump": 0.4, "step": 0.02}
"""The clock of a source that deceives jumps by so much in the middle, s."""


def jumping(sweeps: Iterable[PointCloud], half: float, by: float) -> Iterator[PointCloud]:
    """Set the clock ahead after a number of sweeps."""
    for k, cloud in enumerate(sweeps):
        assert cloud.time is not None
        yield replace(cloud, time=cloud.time + by * (k > half))


def metered(
    sweeps: Iterable[PointCloud], spent: list[float], kept: list[PointCloud]
) -> Iterator[PointCloud]:
    """Give sweeps, note the CPU time that each took to be simulated, s, and keep some."""
    begun = time.process_time()
    for k, cloud in enumerate(sweeps):
        if k % EVERY == 0:
            kept.append(replace(cloud, frame=np.full(len(cloud), k)))
        spent.append(time.process_time() - begun)
        yield cloud
        begun = time.process_time()


def scene_of(sweeps: Sequence[PointCloud], sensor: Sensor) -> Scan:
    """What stands in some sweeps."""
    columns = ("xyz", *(name for name in PER_POINT if getattr(sweeps[0], name) is not None))
    joined: dict[str, Any] = {
        name: np.concatenate([getattr(each, name) for each in sweeps]) for name in columns
    }
    cloud = replace(sweeps[0], **joined)
    return find_poles(cloud, sensor=sensor, threshold=None, radius=DEFAULT_RADIUS, search=False)


class Walking:
    """A LiDAR before which a pole is carried now, a sweep whenever one is taken."""

    waits_for = ""

    def __init__(self, name: str, sweeps: Iterable[PointCloud]) -> None:
        self.name, self.has_ended = name, False
        self._sweeps = enumerate(sweeps)

    def newest(self, wait: float) -> Frame | None:
        """Give the next sweep."""
        number, cloud = next(self._sweeps, (0, None))
        self.has_ended = cloud is None
        return None if cloud is None else Frame(number, cloud, None, self.name)

    def close(self) -> None:
        """Nothing is held."""


def watched(
    sources: Sequence[Walking], wish: Wish, out: Path
) -> Iterator[tuple[WalkWatch, WatchDoc]]:
    """Watch a walk to its end, as if each solution took no time."""
    now = [0.0]
    watch = WalkWatch(sources, wish, out, lambda: now[0])
    while not watch.is_over:
        said = watch.step()
        now[0] += 0.1
        at_work: list[Future[Any] | None] = [watch._solving, watch._work]
        wait([work for work in at_work if work is not None])
        yield watch, said
    watch.finish()


def watch_walks(args: argparse.Namespace) -> None:
    """Print of each walk when the watch stopped, and whether the need was met then."""
    need, met, stopped = args.watch, 0, list[float]()
    for seed in range(args.first, args.first + args.seeds):
        walk = draw(args, seed, "")
        recorders = walk.recorders
        sources = [
            Walking(f"lidar{k}", walk.record(k, np.random.default_rng([seed, k]))) for k in (0, 1)
        ]
        target, source = (each.sensor.name for each in recorders)
        config = RunConfig(
            carried=True, sensor_target=target, sensor_source=source, need_m=need, at_m=AT
        )
        with TemporaryDirectory() as out:
            *_, (watch, said) = watched(sources, Wish(config), Path(out))
        result = watch.result
        if result is None or result.T_target_source is None or not said.is_good:
            print(f"{seed} not good enough in {args.seconds:g} s: {said.next}", flush=True)
            continue
        off = float(displacement(se3.local(result.T_target_source, walk.T_target_source), AT))
        met += off <= need
        stopped.append(said.seconds)
        print(f"{seed} stopped after {said.seconds:.0f} s: off by {1e3 * off:.1f} mm", flush=True)
    print(
        f"stopped {len(stopped)} of {args.seeds}, after {np.median(stopped or [np.nan]):.0f} s "
        f"in the median; within {1e3 * need:g} mm: {met}"
    )


def walk_of_site(
    args: argparse.Namespace, seed: int
) -> tuple[SimulatedWalk, SiteCalibration, SiteCalibration]:
    """Calibrate all LiDARs before which the walk of a seed goes on, by the pole and with the scene.

    Raises
    ------
    Refusal
        If the walk gives no answer.
    """
    walk = draw(args, seed, "")
    kept: list[list[PointCloud]] = [[] for _ in walk.recorders]
    sensors = [each.sensor for each in walk.recorders]
    tracks = [
        find_track(metered(recorded(args, walk, seed, k), [], kept[k]), sensor)
        for k, sensor in enumerate(sensors)
    ]
    names = [f"lidar{k}" for k in range(len(sensors))]
    rows = [(scene_of(own, sensor),) for own, sensor in zip(kept, sensors, strict=True)]
    lidars = [
        SiteLidar(name, (row[0].cloud,), sensor)
        for name, row, sensor in zip(names, rows, sensors, strict=True)
    ]
    site = Site("walk", tuple(lidars), ("walk",), carried=True)
    scans = SiteScans(tuple(rows), np.zeros((len(rows), 3)))
    solved = solve_tracks(tracks, sensors, DEFAULT_RADIUS, None, names)
    alone, whole = (
        state_walk_of_site(site, scans, solved, {}, scene=scene) for scene in (False, True)
    )
    return walk, alone, whole


def walk_sites(args: argparse.Namespace) -> None:
    """Print of each walk before several LiDARs how far each pose and clock is off."""
    args.sensors += (args.lidars - 2) * args.sensors[1:]
    limit = chi2_limit(6 * (args.lidars - 1), 0.95)
    errors: tuple[list[float], list[float]] = ([], [])
    inside: tuple[list[bool], list[bool]] = ([], [])
    clocks: list[float] = []
    wrong = 0
    for seed in range(args.first, args.first + args.seeds):
        begun = time.process_time()
        try:
            walk, *answers = walk_of_site(args, seed)
        except Refusal as refusal:
            print(f"{seed} refused, {refusal.reason.code}: {refusal}", flush=True)
            continue
        truth, words = walk.T_target_lidar[1:], []
        for k, answer in enumerate(answers):
            assert answer.covariance is not None
            both = list(zip(answer.lidars[1:], truth, strict=True))
            found = [Missed.by(own.T_site_lidar, own.covariance, T) for own, T in both]
            step = np.concatenate([se3.local(own.T_site_lidar, T) for own, T in both])
            chi2 = float(step @ np.linalg.solve(answer.covariance[6:, 6:], step))
            errors[k].extend(each.error for each in found)
            inside[k].append(chi2 <= limit)
            words.append(f"{'; '.join(each.words for each in found)}; together χ² {chi2:.1f}")
        last = answers[-1]
        assert last.walk is not None
        recorders = zip(walk.recorders, last.walk.lidars, strict=True)
        late = [
            own.clock + own.drift * seen.middle_s + seen.clock_offset_s for own, seen in recorders
        ]
        clocks += np.abs(late[1:]).tolist()
        sigmas = [seen.clock_sigma_s for seen in last.walk.lidars]
        is_wrong = any(each.error > max(SIGMAS * each.stated, WRONG) for each in found)
        is_wrong |= bool(np.any(np.abs(late) > np.maximum(SIGMAS * np.array(sigmas), WRONG_CLOCK)))
        wrong += is_wrong
        both_clocks = zip(late[1:], sigmas[1:], strict=True)
        print(
            f"{seed} at {AT:g} m {'. With the scene '.join(words)}, {last.status}; clocks "
            f"{', '.join(f'{1e3 * off:+.2f} ({1e3 * s:.2f})' for off, s in both_clocks)} ms; "
            f"{time.process_time() - begun:.0f} s with simulation{' WRONG' * is_wrong}",
            flush=True,
        )
    print(f"answered {len(inside[0])} of {args.seeds}, wrong {wrong}")
    if not clocks:
        return
    for name, own, within in zip(("pole alone", "with the scene"), errors, inside, strict=True):
        print(
            f"{name}: median {1e3 * np.median(own):.1f} mm at {AT:g} m, largest "
            f"{1e3 * max(own):.1f}; all poses within 95 % together: {sum(within)}"
        )
    print(f"clocks, median {1e3 * np.median(clocks):.2f} ms")


class Missed(NamedTuple):
    """An error at 30 m and what is stated, m, and the error squared in σ."""

    error: float
    stated: float
    squares: float

    @classmethod
    def by(cls, T: Array, covariance: Array, truth: Array) -> Missed:
        """Compare a pose and its covariance with the truth."""
        step = se3.local(T, truth)
        return cls(
            predicted_error(np.outer(step, step), (AT,))[0].sigma_m,
            predicted_error(covariance, (AT,))[0].sigma_m,
            float(step @ np.linalg.solve(covariance, step)),
        )

    @property
    def words(self) -> str:
        """All three."""
        return f"{1e3 * self.error:.1f} mm ({1e3 * self.stated:.1f}), χ² {self.squares:.1f}"


def draw(args: argparse.Namespace, seed: int, deception: str) -> SimulatedWalk:
    """Draw the walk of a seed."""
    mixtures = len(SENSORS) * len(SECONDS)
    scene = (seed + args.mixed * (seed // mixtures)) % len(SCENES)
    return simulate_walk(
        args.scene or SCENES[scene],
        np.random.default_rng(seed),
        seconds=args.seconds,
        sensors=tuple(args.sensors),
        noise=NOISE_MODELS[args.noise],
        stops=args.stops,
        people=2 if deception == "two" else 1,
        lean=1e-3 if deception == "upright" else float(np.radians(14.0)),
    )


def recorded(
    args: argparse.Namespace, walk: SimulatedWalk, seed: int, lidar: int
) -> Iterator[PointCloud]:
    """Record the sweeps of a LiDAR."""
    for cloud in walk.record(lidar, np.random.default_rng([seed, lidar])):
        numbered = not args.mixed or tuple(args.sensors) != WITHOUT_RINGS
        yield cloud if numbered else replace(cloud, ring=None)


def main() -> None:
    """Print a line for each walk, and the sum of all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=12)
    parser.add_argument("--first", type=int, default=5000)
    parser.add_argument("--seconds", type=float, default=40.0)
    parser.add_argument("--scene", choices=SCENES)
    parser.add_argument("--sensors", nargs=2, default=["VLP-16", "VLP-16"])
    parser.add_argument("--noise", choices=sorted(NOISE_MODELS), default="field")
    parser.add_argument("--stops", type=int, default=0)
    parser.add_argument("--mixed", action="store_true")
    parser.add_argument("--deceive", action="store_true")
    parser.add_argument("--lidars", type=int, default=2)
    parser.add_argument("--watch", type=float, metavar="NEED")
    args = parser.parse_args()
    if args.watch is not None:
        watch_walks(args)
        return
    if args.lidars > 2:
        walk_sites(args)
        return
    rows: list[tuple[tuple[Missed, Missed], float, float]] = []
    wrong = 0
    for seed in range(args.first, args.first + args.seeds):
        deception = DECEPTIONS[seed % len(DECEPTIONS)] if args.deceive else ""
        if args.mixed:
            args.sensors, args.seconds = SENSORS[seed % len(SENSORS)], SECONDS[seed % len(SECONDS)]
        walk = draw(args, seed, deception)
        kind = f"{deception} {' '.join(args.sensors)} {args.seconds:g} s".strip()
        spent: list[float] = []
        kept: tuple[list[PointCloud], list[PointCloud]] = ([], [])
        sweeps = [
            metered(recorded(args, walk, seed, lidar), spent, kept[lidar]) for lidar in (0, 1)
        ]
        if deception in JUMPS:
            sweeps[1] = jumping(sweeps[1], 5 * args.seconds, JUMPS[deception])
        begun = time.process_time()
        target, source = walk.recorders
        try:
            sensors = target.sensor, source.sensor
            found = calibrate_walk(*sweeps, sensors=sensors)
            scans = [scene_of(*each) for each in zip(kept, sensors, strict=True)]
            answer = state_walk(found, Placement(scans[0], scans[1]), {}, scene=True)
        except Refusal as refusal:
            print(f"{seed} {kind} refused, {refusal.reason.code}: {refusal}", flush=True)
            continue
        seconds = time.process_time() - begun - sum(spent)
        assert answer.T_target_source is not None
        assert answer.covariance is not None
        truth = walk.T_target_source
        alone = Missed.by(found.T_target_source, found.covariance, truth)
        whole = Missed.by(answer.T_target_source, answer.covariance, truth)
        clock = source.clock + source.drift * found.middle - found.offset
        is_wrong = whole.error > max(SIGMAS * whole.stated, WRONG)
        is_wrong |= abs(clock) > max(SIGMAS * found.offset_sigma, WRONG_CLOCK)
        wrong += is_wrong
        rows.append(((alone, whole), abs(clock), seconds))
        print(
            f"{seed} {kind} at {AT:g} m {alone.words}; with the scene {whole.words}, "
            f"{answer.status}; clock {1e3 * clock:+.2f} ms ({1e3 * found.offset_sigma:.2f}); "
            f"{seconds:.1f} s{' WRONG' * is_wrong}",
            flush=True,
        )
    print(f"answered {len(rows)} of {args.seeds}, wrong {wrong}")
    if not rows:
        return
    for k, name in enumerate(("pole alone", "with the scene")):
        errors = np.array([row[0][k].error for row in rows])
        inside = np.mean([row[0][k].squares <= CHI2 for row in rows])
        print(
            f"{name}: median {1e3 * np.median(errors):.1f} mm at {AT:g} m, largest "
            f"{1e3 * errors.max():.1f}; within 95 %: {inside:.0%}"
        )
    clocks, spent_on = [row[1] for row in rows], [row[2] for row in rows]
    print(f"clock, median {1e3 * np.median(clocks):.2f} ms; {np.mean(spent_on):.1f} s of CPU")


if __name__ == "__main__":
    main()
