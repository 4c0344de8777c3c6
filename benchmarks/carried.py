"""Walks with one carried pole: how many are answered, how far off, and within what is stated?

Usage:
    python benchmarks/carried.py --seeds 12
    python benchmarks/carried.py --seeds 12 --seconds 60 --sensors XT32 VLP-16 --noise field
    python benchmarks/carried.py --seeds 12 --mixed
    python benchmarks/carried.py --seeds 4 --deceive
    python benchmarks/carried.py --seeds 12 --watch 0.03
    python benchmarks/carried.py --seeds 12 --lidars 3
    python benchmarks/carried.py --seeds 12 --standing

A walk with all errors of a noise model in a street, a harbor or on bare ground, seed by seed: by
the pole alone, and with the surfaces around that every tenth sweep shows. With --deceive each is
spoilt in one way: two poles are carried, the pole never leans, the source's clock jumps, or it
steps by 20 ms, the person turns on the spot, or walks along a line and leans the pole along it
alone, wears a vest and carries no pole, or is out of the source's view but for 3 s. With --mixed
sensors and length change from seed to seed, two OS1-128 without ring numbers among them. An answer
is wrong where it is off by more than 5 σ, and by 5 cm or more at 30 m or by 5 ms. With --watch each
is watched with that need at 30 m, in metres, until it stops by itself. With --lidars three or more
record a walk, as those of a site, the others with the second sensor. With --standing two poles are
set up in the same place besides, and recorded by the same LiDARs for ten sweeps each. Seeds below
1000 tune; seeds from 5000 state.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, wait
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

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
from retropole.pipeline import Options, calibrate
from retropole.result import RunConfig
from retropole.result.watching import WatchDoc
from retropole.simulation import NOISE_MODELS
from retropole.simulation.devices import TYPICAL
from retropole.simulation.pairs import (
    MAX_POLE_ANGLE,
    MIN_POLE_ANGLE,
    Arrangement,
    Recorders,
    are_in_view,
    record,
)
from retropole.simulation.scenes import draw_poles
from retropole.simulation.walks import GAIT_KNOT, SimulatedWalk, Walk, simulate_walk
from retropole.surfaces.scans import find_poles

SCENES = "street", "harbor", "bare"
DECEPTIONS = "two", "upright", "jump", "step", "still", "line", "vest", "away"
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
NOISES = NOISE_MODELS | {"random": replace(TYPICAL, ring_bias=0.0, retro_bias=0.0)}
"""Noise models by name; the last has no systematic errors."""

AT, WRONG, WRONG_CLOCK, SIGMAS = 30.0, 0.05, 0.005, 5.0
EVERY = 10
"""So many sweeps apart are those that show the surfaces around."""

CHI2 = 12.592
"""95 % of χ² with six degrees of freedom."""

WALKED, STANDING_SWEEPS, MAX_SETUPS = (3.0, 3.0), 10, 100
"""Half extents of the ground on which poles are set up, m, sweeps that record them, and setups that
are drawn until both LiDARs see both."""

STILL = 0.02
"""Part of a walk's extent within which a person turns on the spot."""

AWAY = 30
"""Sweeps of the source in which a person who is then away is in view."""

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
    def is_wrong(self) -> bool:
        """Whether it is off by more than is stated and matters."""
        return self.error > max(SIGMAS * self.stated, WRONG)

    @property
    def words(self) -> str:
        """All three."""
        return f"{1e3 * self.error:.1f} mm ({1e3 * self.stated:.1f}), χ² {self.squares:.1f}"


@dataclass(frozen=True)
class Outcome:
    """What came of a walk: a line, and of its answers by the pole alone and with the scene.

    Attributes
    ----------
    words
        The line.
    found
        Errors of each pose, by each of the answers; none where it is refused.
    inside
        Whether the joint 95 % region of each answer has the truth.
    clocks
        How far each clock is off, s.
    is_wrong
        Whether an answer is wrong.
    seconds
        CPU time, s; of a watched walk when it stopped.
    standing
        Two poles in the same place: errors by these alone and with the scene, where answered.
    """

    words: str
    found: tuple[tuple[Missed, ...], ...] = ()
    inside: tuple[bool, ...] = ()
    clocks: tuple[float, ...] = ()
    is_wrong: bool = False
    seconds: float = 0.0
    standing: tuple[Missed | None, Missed | None] = (None, None)


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


def watched_walk(args: argparse.Namespace, seed: int) -> Outcome:
    """When the watch of a walk stopped, and how far off its answer then was."""
    walk = draw(args, seed, "")
    sources = [
        Walking(f"lidar{k}", walk.record(k, np.random.default_rng([seed, k]))) for k in (0, 1)
    ]
    target, source = (each.sensor.name for each in walk.recorders)
    config = RunConfig(
        carried=True, sensor_target=target, sensor_source=source, need_m=args.watch, at_m=AT
    )
    with TemporaryDirectory() as out:
        *_, (watch, said) = watched(sources, Wish(config), Path(out))
    result = watch.result
    if result is None or result.T_target_source is None or not said.is_good:
        return Outcome(f"{seed} not good enough in {args.seconds:g} s: {said.next}")
    step = se3.local(result.T_target_source, walk.T_target_source)
    off = float(displacement(step, AT))
    words = f"{seed} stopped after {said.seconds:.0f} s: off by {1e3 * off:.1f} mm"
    return Outcome(words, ((Missed(off, args.watch, np.nan),),), seconds=said.seconds)


def walk_of_site(args: argparse.Namespace, seed: int) -> Outcome:
    """Calibrate all LiDARs that record the walk of a seed, by the pole and with the scene."""
    begun = time.process_time()
    sensors = args.sensors + (args.lidars - 2) * args.sensors[1:]
    walk = draw(argparse.Namespace(**vars(args) | {"sensors": sensors}), seed, "")
    kept: list[list[PointCloud]] = [[] for _ in walk.recorders]
    models = [each.sensor for each in walk.recorders]
    names = [f"lidar{k}" for k in range(len(models))]
    try:
        tracks = [
            find_track(metered(recorded(args, walk, seed, k), [], kept[k]), sensor)
            for k, sensor in enumerate(models)
        ]
        rows = [(scene_of(own, sensor),) for own, sensor in zip(kept, models, strict=True)]
        lidars = [
            SiteLidar(name, (row[0].cloud,), sensor)
            for name, row, sensor in zip(names, rows, models, strict=True)
        ]
        site = Site("walk", tuple(lidars), ("walk",), carried=True)
        scans = SiteScans(tuple(rows), np.zeros((len(rows), 3)))
        solved = solve_tracks(tracks, models, DEFAULT_RADIUS, None, names)
        answers = [
            state_walk_of_site(site, scans, solved, {}, scene=scene) for scene in (False, True)
        ]
    except Refusal as refusal:
        return Outcome(f"{seed} refused, {refusal.reason.code}: {refusal}")
    truth, found, squares = walk.T_target_lidar[1:], [], []
    for answer in answers:
        assert answer.covariance is not None
        both = list(zip(answer.lidars[1:], truth, strict=True))
        found.append(tuple(Missed.by(own.T_site_lidar, own.covariance, T) for own, T in both))
        step = np.concatenate([se3.local(own.T_site_lidar, T) for own, T in both])
        squares.append(float(step @ np.linalg.solve(answer.covariance[6:, 6:], step)))
    seen = answers[-1].walk
    assert seen is not None
    late = [
        (own.clock + own.drift * each.middle_s + each.clock_offset_s, each.clock_sigma_s)
        for own, each in zip(walk.recorders[1:], seen.lidars[1:], strict=True)
    ]
    words = [
        f"{'; '.join(each.words for each in own)}; together χ² {chi2:.1f}"
        for own, chi2 in zip(found, squares, strict=True)
    ]
    is_wrong = any(each.is_wrong for each in found[-1])
    is_wrong |= any(abs(off) > max(SIGMAS * sigma, WRONG_CLOCK) for off, sigma in late)
    seconds = time.process_time() - begun
    line = (
        f"{seed} at {AT:g} m {'. With the scene '.join(words)}, {answers[-1].status}; clocks "
        f"{', '.join(f'{1e3 * off:+.2f} ({1e3 * s:.2f})' for off, s in late)} ms; "
        f"{seconds:.0f} s with simulation{' WRONG' * is_wrong}"
    )
    limit = chi2_limit(6 * len(truth), 0.95)
    within = tuple(each <= limit for each in squares)
    clocks = tuple(abs(off) for off, _ in late)
    return Outcome(line, tuple(found), within, clocks, is_wrong, seconds)


def walk_of_pair(args: argparse.Namespace, seed: int) -> Outcome:
    """Calibrate the two LiDARs that record the walk of a seed, by the pole and with the scene."""
    deception = DECEPTIONS[seed % len(DECEPTIONS)] if args.deceive else ""
    if args.mixed:
        mixture = {"sensors": SENSORS[seed % len(SENSORS)], "seconds": SECONDS[seed % len(SECONDS)]}
        args = argparse.Namespace(**vars(args) | mixture)
    walk = draw(args, seed, deception)
    kind = f"{deception} {' '.join(args.sensors)} {args.seconds:g} s".strip()
    spent: list[float] = []
    kept: tuple[list[PointCloud], list[PointCloud]] = ([], [])
    sweeps = [metered(recorded(args, walk, seed, lidar), spent, kept[lidar]) for lidar in (0, 1)]
    if deception == "away":
        sweeps[1] = (cloud for k, cloud in enumerate(sweeps[1]) if k < AWAY)
    if deception in JUMPS:
        sweeps[1] = jumping(sweeps[1], 5 * args.seconds, JUMPS[deception])
    standing: tuple[Missed | None, Missed | None] = (None, None)
    beside = ""
    if args.standing:
        standing = two_standing(walk, np.random.default_rng([seed, 2]))
        words = ["refused" if each is None else each.words for each in standing]
        beside = f"; two standing poles {words[0]}, with the scene {words[1]}"
    begun = time.process_time()
    target, source = walk.recorders
    try:
        sensors = target.sensor, source.sensor
        found = calibrate_walk(*sweeps, sensors=sensors)
        scans = [scene_of(*each) for each in zip(kept, sensors, strict=True)]
        answer = state_walk(found, Placement(scans[0], scans[1]), {}, scene=True)
    except Refusal as refusal:
        line = f"{seed} {kind} refused, {refusal.reason.code}: {refusal}{beside}"
        return Outcome(line, standing=standing)
    seconds = time.process_time() - begun - sum(spent)
    assert answer.T_target_source is not None
    assert answer.covariance is not None
    truth = walk.T_target_source
    alone = Missed.by(found.T_target_source, found.covariance, truth)
    whole = Missed.by(answer.T_target_source, answer.covariance, truth)
    clock = source.clock + source.drift * found.middle - found.offset
    is_wrong = whole.is_wrong or abs(clock) > max(SIGMAS * found.offset_sigma, WRONG_CLOCK)
    line = (
        f"{seed} {kind} at {AT:g} m {alone.words}; with the scene {whole.words}, "
        f"{answer.status}; clock {1e3 * clock:+.2f} ms ({1e3 * found.offset_sigma:.2f}); "
        f"{seconds:.1f} s{beside}{' WRONG' * is_wrong}"
    )
    inside = alone.squares <= CHI2, whole.squares <= CHI2
    return Outcome(line, ((alone,), (whole,)), inside, (abs(clock),), is_wrong, seconds, standing)


def two_standing(
    walk: SimulatedWalk, rng: np.random.Generator
) -> tuple[Missed | None, Missed | None]:
    """Two poles where the walk goes on: errors by these alone and with the scene.

    None where the LiDARs do not both see two poles in any of `MAX_SETUPS` setups, or are refused.
    """
    sensors, devices, poses = zip(
        *((each.sensor, each.device, each.T_world_sensor) for each in walk.recorders), strict=True
    )
    recorders = Recorders(sensors, devices, walk.recorders[0].noise, STANDING_SWEEPS)
    for _ in range(MAX_SETUPS):
        poles = draw_poles(rng, 2, WALKED, (MIN_POLE_ANGLE, MAX_POLE_ANGLE), DEFAULT_RADIUS)
        at = Arrangement(walk.surfaces, poles or (), poses, WALKED)
        if poles and are_in_view(at, recorders, rng):
            break
    else:
        return None, None
    pair = record(at, recorders, rng)
    found: list[Missed | None] = []
    for scene in (False, True):
        answer = calibrate(pair.target, pair.source, options=Options(sensors=sensors, scene=scene))
        if answer.T_target_source is None or answer.covariance is None:
            found.append(None)
        else:
            truth = walk.T_target_source
            found.append(Missed.by(answer.T_target_source, answer.covariance, truth))
    return found[0], found[1]


def draw(args: argparse.Namespace, seed: int, deception: str) -> SimulatedWalk:
    """Draw the walk of a seed."""
    mixtures = len(SENSORS) * len(SECONDS)
    scene = (seed + args.mixed * (seed // mixtures)) % len(SCENES)
    drawn = simulate_walk(
        args.scene or SCENES[scene],
        np.random.default_rng(seed),
        seconds=args.seconds,
        sensors=tuple(args.sensors),
        noise=NOISES[args.noise],
        stops=args.stops,
        people=2 if deception == "two" else 1,
        lean=1e-3 if deception == "upright" else float(np.radians(14.0)),
    )
    return replace(drawn, walks=tuple(spoilt(each, deception) for each in drawn.walks))


def spoilt(walk: Walk, deception: str) -> Walk:
    """Let a person walk otherwise."""
    if deception == "vest":
        return replace(walk, size=(1e-3, 1e-2), wears_vest=True)
    if deception not in ("still", "line"):
        return walk
    times = np.arange(0.0, walk.seconds + 1.0, GAIT_KNOT / 3)
    hand, lean = walk.hand(times), walk.lean(times)
    if deception == "still":
        hand = hand.mean(axis=0) + STILL * (hand - hand.mean(axis=0))
    else:
        # Along x, as far as it was in x.
        hand[:, 1], lean[:, 1] = hand[:, 1].mean(), 0.0
    return replace(walk, hand=CubicSpline(times, hand), lean=CubicSpline(times, lean))


def recorded(
    args: argparse.Namespace, walk: SimulatedWalk, seed: int, lidar: int
) -> Iterator[PointCloud]:
    """Record the sweeps of a LiDAR."""
    for cloud in walk.record(lidar, np.random.default_rng([seed, lidar])):
        numbered = not args.mixed or tuple(args.sensors) != WITHOUT_RINGS
        yield cloud if numbered else replace(cloud, ring=None)


def summed_up(args: argparse.Namespace, outcomes: Sequence[Outcome]) -> Iterator[str]:
    """Say what came of all walks."""
    answered = [each for each in outcomes if each.found]
    if args.watch is not None:
        stopped = [each.seconds for each in answered]
        met = sum(each.found[0][0].error <= args.watch for each in answered)
        yield (
            f"stopped {len(stopped)} of {args.seeds}, after {np.median(stopped or [np.nan]):.0f} s "
            f"in the median; within {1e3 * args.watch:g} mm: {met}"
        )
        return
    wrong = sum(each.is_wrong for each in outcomes)
    yield f"answered {len(answered)} of {args.seeds}, wrong {wrong}"
    if not answered:
        return
    for k, name in enumerate(("pole alone", "with the scene")):
        errors = np.array([each.error for one in answered for each in one.found[k]])
        inside = sum(each.inside[k] for each in answered)
        yield (
            f"{name}: median {1e3 * np.median(errors):.1f} mm at {AT:g} m, largest "
            f"{1e3 * errors.max():.1f}; within 95 %: {inside} of {len(answered)}"
        )
    clocks = np.array([own for each in answered for own in each.clocks])
    yield (
        f"clock, median {1e3 * np.median(clocks):.2f} ms, largest {1e3 * clocks.max():.2f}; "
        f"{np.mean([each.seconds for each in answered]):.1f} s of CPU"
    )
    if not args.standing:
        return
    for k, name in enumerate(("by the poles alone", "with the scene")):
        both = [
            (each.found[k][0].error, own.error)
            for each in answered
            if (own := each.standing[k]) is not None
        ]
        lacking = [each for each in outcomes if each.standing[k] is None]
        gained = sum(bool(each.found) for each in lacking)
        yield (
            f"two standing poles, {name}: of {len(lacking)} places where they are refused, the "
            f"walk is answered in {gained}"
        )
        if both:
            walks, poles = np.median(both, axis=0)
            yield (
                f"in the {len(both)} answered by both, medians of {1e3 * walks:.1f} mm by the walk "
                f"and {1e3 * poles:.1f} mm by the poles: {walks / poles:.2f} times"
            )


def main() -> None:
    """Print a line for each walk, and the sum of all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=12)
    parser.add_argument("--first", type=int, default=5000)
    parser.add_argument("--seconds", type=float, default=40.0)
    parser.add_argument("--scene", choices=SCENES)
    parser.add_argument("--sensors", nargs=2, default=["VLP-16", "VLP-16"])
    parser.add_argument("--noise", choices=sorted(NOISES), default="field")
    parser.add_argument("--stops", type=int, default=0)
    parser.add_argument("--mixed", action="store_true")
    parser.add_argument("--deceive", action="store_true")
    parser.add_argument("--standing", action="store_true")
    parser.add_argument("--lidars", type=int, default=2)
    parser.add_argument("--watch", type=float, metavar="NEED")
    parser.add_argument("--processes", type=int, default=1)
    args = parser.parse_args()
    one = walk_of_site if args.lidars > 2 else walk_of_pair
    outcome_of = partial(one if args.watch is None else watched_walk, args)
    outcomes = []
    with ProcessPoolExecutor(args.processes, get_context("spawn")) as pool:
        for outcome in pool.map(outcome_of, range(args.first, args.first + args.seeds)):
            print(outcome.words, flush=True)
            outcomes.append(outcome)
    print("\n".join(summed_up(args, outcomes)))


if __name__ == "__main__":
    main()
