"""Planned placements of the poles, calibrated many times, beside random ones.

In each place the LiDARs and all their errors are drawn (`field`), the place is recorded without
poles, the poses are known to 4° and 0.4 m on each axis (1 σ), and `plan` says where the poles
should stand. There they are put and calibrated several times, each time with other LiDARs of the
same models; and so are random placements of the same poles that keep the rules of
docs/poles.md: 3 to 7 m from both LiDARs, 1 to 2.5 m apart, one upright and one leaning by 20°.
Tables, one line for each kind of place:

1. places planned and refused; planned poles that a LiDAR does not see along thin, exact beams, that
   stand in something or nearer than 0.3 m to it, or off the ground;
2. the error that was predicted at 30 m over the median of those that came, with the surfaces and by
   the poles alone, and in how many places it is from 0.7 to 1.5;
3. the median error of the planned placement over that of random ones, and the error that was
   predicted over the least of 200 random sets of candidates by the same prediction.

With `--sites` a site of four LiDARs is planned for two placements of three poles, and calibrated
as often; beside it the placements that the simulator draws for it. The error is that of the least
certain LiDAR against the first.

With `--spacing` nothing is planned: the predicted error by the poles alone, 10 m away, of pairs of
poles on bare ground by how far apart they are, the median and the least of pairs at random, one
upright and one leaning by 20°, each 3 to 7 m from both LiDARs.

Seeds 0 to 99 tune, those from 1000 state.

    python benchmarks/plan.py --seeds 1000:1012 --runs 10
    python benchmarks/plan.py --sites --seeds 1000:1005 --runs 5 --kinds posts crane truck
    python benchmarks/plan.py --spacing
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context

import numpy as np
from threadpoolctl import threadpool_limits

from again import record_again
from retropole.adjustment.answer import SiteCalibration
from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.base.description import Frame, Site, SiteLidar
from retropole.base.errors import Refusal
from retropole.base.sensors import find_sensor
from retropole.pipeline import Options, calibrate, calibrate_site
from retropole.planning.choice import error_of, errors_of, rules_of
from retropole.planning.place import Candidates, leaning, survey, who_sees
from retropole.planning.planner import Planned, design_of, plan, worst_at
from retropole.planning.prediction import Surfaces, divergences_of, network_of
from retropole.planning.stations import bare_scan, place_drawn_lidars, place_lidars
from retropole.simulation import (
    FIELD,
    Cylinder,
    SimulatedPair,
    SimulationError,
    draw_device,
    simulate_pair,
)
from retropole.simulation.pairs import Arrangement, Recorders, poles_in_view, record
from retropole.simulation.scanning import scan
from retropole.simulation.site_places import is_clear
from retropole.simulation.sites import DrawnSite, draw_site

KINDS = ("street", "harbor", "square", "camber", "kerb", "bare")
ROUGH = np.radians(4.0), 0.4
AT = 30.0
SETS, DRAWS = 200, 300
LIDARS, PLACEMENTS, SITE_POLES = 4, 2, 3
OFF_GROUND = 0.1
"""A foot that is farther from the ground, metres, is off it."""


@dataclass(frozen=True)
class Found:
    """Of one place: faults of its poles, and ratios; None where nothing was planned."""

    kind: str
    refused: str = ""
    verdict: str = ""
    poles: int = 0
    hidden: int = 0
    in_the_way: int = 0
    off_ground: int = 0
    answered: int = 0
    runs: int = 0
    ratio: float = np.nan
    ratio_alone: float = np.nan
    over_random: float = np.nan
    over_random_alone: float = np.nan
    over_best: float = np.nan


def error_at(T: Array, truth: Array) -> float:
    """Root mean square over all directions of how far a point `AT` away is off, metres."""
    step = se3.local(T, truth)
    return float(np.sqrt(2 / 3 * AT**2 * (step[:3] @ step[:3]) + step[3:] @ step[3:]))


def errors(
    pair: SimulatedPair, poles: Sequence[Cylinder], seed: Sequence[int]
) -> tuple[float, float] | None:
    """With the surfaces and by the poles alone, of one calibration; None where it is refused."""
    devices = [
        draw_device(sensor, FIELD, np.random.default_rng([*seed, k]))
        for k, sensor in enumerate(pair.sensors)
    ]
    poses = pair.T_world_target, pair.T_world_source
    at = Arrangement(pair.surroundings, poles, poses, pair.clear)
    made = record(at, Recorders(pair.sensors, devices, FIELD, 1), np.random.default_rng(seed))
    found = calibrate(made.target, made.source, options=Options(sensors=pair.sensors))
    if found.T_target_source is None or found.poles is None:
        return None
    alone = error_at(found.poles.T_target_source, pair.T_target_source)
    return error_at(found.T_target_source, pair.T_target_source), alone


def stood(
    pair: SimulatedPair, planned: Planned, poles: Candidates, numbers: Sequence[int]
) -> list[Cylinder]:
    """Stand some poles in the world, as somebody does who trusts the plan."""
    T = pair.T_world_target @ se3.inverse(planned.stations[0].T_place_recording)
    return [in_world(poles.pole(k), T) for k in numbers]


def in_world(pole: Cylinder, T: Array) -> Cylinder:
    """Express a pole in another frame by its pose (4, 4)."""
    return replace(pole, centre=se3.apply(T, pole.centre[None])[0], axis=T[:3, :3] @ pole.axis)


def random_sets(planned: Planned, count: int, rng: np.random.Generator) -> list[list[int]]:
    """Draw sets of candidates that may stand together."""
    design = planned.design
    found: list[list[int]] = []
    for _ in range(SETS):
        chosen: list[int] = []
        for k in rng.permutation(len(planned.candidates)).tolist():
            if len(chosen) < count and design.rules.allow(k, chosen):
                chosen.append(k)
        if len(chosen) == count:
            found.append(chosen)
    return found


def pair_by_the_rules(planned: Planned, rng: np.random.Generator) -> Candidates | None:
    """Draw two poles as docs/poles.md has them; None where many draws gave none.

    3 to 7 m from both LiDARs, 1 to 2.5 m apart, one upright and one leaning by 20°, free, and seen.
    """
    feet = planned.place.feet
    away = [np.linalg.norm(feet[:, :2] - each.at[:2], axis=1) for each in planned.stations]
    near = feet[np.all([(each >= 3) & (each <= 7) for each in away], axis=0)]
    if not len(near):
        return None
    poles, widths = planned.candidates, divergences_of(planned.stations)
    for _ in range(DRAWS):
        first = near[rng.integers(len(near))]
        gap = np.linalg.norm(near[:, :2] - first[:2], axis=1)
        others = near[(gap >= 1.0) & (gap <= 2.5)]
        if not len(others):
            continue
        turn, lean = rng.uniform(0, 2 * np.pi), np.radians(20.0)
        leaning = np.r_[np.sin(lean) * np.array([np.cos(turn), np.sin(turn)]), np.cos(lean)]
        drawn = Candidates(
            np.stack([first, others[rng.integers(len(others))]]),
            np.stack([[0.0, 0.0, 1.0], leaning]),
            poles.length,
            poles.radius,
        )
        free = planned.place.are_free(drawn.foot, drawn.axis, drawn.length).all()
        if free and who_sees(drawn, planned.stations, widths).all():
            at = [each.at for each in planned.stations]
            if rules_of(drawn, np.ones((2, 2), dtype=bool), at).allow(0, [1]):
                return drawn
    return None


def run(job: tuple[str, int, int, int]) -> Found | None:
    """Plan for one place, and calibrate there."""
    kind, seed, runs, count = job
    with threadpool_limits(1, user_api="blas"):
        rng = np.random.default_rng(seed)
        try:
            pair = simulate_pair(kind, rng, noise=FIELD)
        except SimulationError:
            return None
        bare = record_again(pair, np.random.default_rng([seed, 1]), poles=False)
        off = se3.from_rt(se3.exp_so3(ROUGH[0] * rng.normal(size=3)), ROUGH[1] * rng.normal(size=3))
        scans = [
            bare_scan(cloud, sensor)
            for cloud, sensor in zip((bare.target, bare.source), pair.sensors, strict=True)
        ]
        try:
            stations = place_lidars(
                ("target", "source"), scans, (np.eye(4), pair.T_target_source @ off)
            )
            planned = plan(stations, poles=count)
        except Refusal as refusal:
            return Found(kind, refused=refusal.code)
        poles = stood(pair, planned, planned.candidates, planned.numbers)
        views = [
            poles_in_view(pair.surroundings, poles, sensor, pose, np.random.default_rng(seed))
            for sensor, pose in zip(
                pair.sensors, (pair.T_world_target, pair.T_world_source), strict=True
            )
        ]
        feet = [pole.centre - (pole.length / 2 + 0.05) * pole.axis for pole in poles]
        ground = pair.surroundings[0]
        # The camber and the kerb have ground of several surfaces: nothing tells its height there.
        known = kind not in ("camber", "kerb")
        lifted = [replace(p, centre=p.centre + 0.2 * p.axis) for p in poles]
        found = [errors(pair, poles, (seed, 2, r)) for r in range(runs)]
        others = []
        for r in range(runs if count == 2 else 0):
            drawn = pair_by_the_rules(planned, np.random.default_rng([seed, 3, r]))
            if drawn is not None:
                others.append(errors(pair, stood(pair, planned, drawn, [0, 1]), (seed, 4, r)))
        own = np.array([each for each in found if each is not None]).reshape(-1, 2)
        there = np.array([each for each in others if each is not None]).reshape(-1, 2)
        middle = np.median(own, axis=0) if len(own) else np.full(2, np.nan)
        beside = np.median(there, axis=0) if len(there) else np.full(2, np.nan)
        sets = random_sets(planned, count, np.random.default_rng([seed, 5]))
        return Found(
            kind,
            verdict=planned.rehearsal.status,
            poles=len(poles),
            hidden=sum(not (a and b) for a, b in zip(*views, strict=True)),
            in_the_way=sum(not is_clear(p, list(pair.surroundings[1:])) for p in lifted)
            if known
            else 0,
            off_ground=sum(abs(foot[2] - ground.centre[2]) > OFF_GROUND for foot in feet)
            if known
            else 0,
            answered=len(own),
            runs=runs,
            ratio=worst_at(planned.predicted, AT) / middle[0],
            ratio_alone=worst_at(planned.alone, AT) / middle[1],
            over_random=middle[0] / beside[0],
            over_random_alone=middle[1] / beside[1],
            over_best=error_of(planned.design, planned.chosen)
            / min((error_of(planned.design, [one]) for one in sets), default=np.nan),
        )


def worst_of(answer: SiteCalibration, poses: Sequence[Array]) -> float | None:
    """Largest error of all LiDARs against the first, metres; None where it is refused."""
    found = [each.T_site_lidar for each in answer.lidars]
    if len(found) < len(poses):
        return None
    first, truth = se3.inverse(found[0]), se3.inverse(poses[0])
    return max(error_at(first @ a, truth @ b) for a, b in zip(found[1:], poses[1:], strict=True))


def site_errors(
    drawn: DrawnSite, placements: Sequence[Sequence[Cylinder]], seed: Sequence[int]
) -> float | None:
    """Of one calibration of a site with other LiDARs of the same models; None if refused."""
    at = drawn.at.place
    devices = [
        draw_device(sensor, FIELD, np.random.default_rng([*seed, k]))
        for k, sensor in enumerate(drawn.sensors)
    ]
    clouds = [
        tuple(
            scan(
                [*at.surroundings, *poles],
                sensor,
                T,
                np.random.default_rng([*seed, 100, k, p]),
                FIELD,
                device=device,
            ).cloud
            for p, poles in enumerate(placements)
        )
        for k, (sensor, T, device) in enumerate(zip(drawn.sensors, at.poses, devices, strict=True))
    ]
    lidars = tuple(
        SiteLidar(f"lidar {k}", own, sensor=sensor)
        for k, (own, sensor) in enumerate(zip(clouds, drawn.sensors, strict=True))
    )
    names = tuple(str(p + 1) for p in range(len(placements)))
    frame = Frame("LiDAR lidar 0")
    answer = calibrate_site(Site("a site", lidars, names, radius=drawn.radius, frame=frame))
    return worst_of(answer, at.poses)


def run_site(job: tuple[str, int, int, int]) -> Found | None:
    """Plan for one site, and calibrate it."""
    kind, seed, runs, _ = job
    with threadpool_limits(1, user_api="blas"):
        rng = np.random.default_rng(seed)
        try:
            drawn = draw_site(kind, rng, lidars=LIDARS, placements=PLACEMENTS, noise=FIELD)
        except SimulationError:
            return None
        poses, surroundings = drawn.at.place.poses, list(drawn.at.place.surroundings)
        scans, rough = [], []
        for k, (sensor, T) in enumerate(zip(drawn.sensors, poses, strict=True)):
            own = np.random.default_rng([seed, 1, k])
            made = scan(surroundings, sensor, T, own, FIELD, device=drawn.devices[k])
            scans.append(bare_scan(made.cloud, sensor))
            off = se3.from_rt(
                se3.exp_so3(ROUGH[0] * rng.normal(size=3)), ROUGH[1] * rng.normal(size=3)
            )
            rough.append(se3.inverse(poses[0]) @ T @ off if k else np.eye(4))
        try:
            stations = place_lidars([f"lidar {k}" for k in range(LIDARS)], scans, rough)
            planned = plan(stations, poles=SITE_POLES, placements=PLACEMENTS)
        except Refusal as refusal:
            return Found(kind, refused=refusal.code)
        T = poses[0] @ se3.inverse(planned.stations[0].T_place_recording)
        standing = [
            [in_world(planned.candidates.pole(k), T) for k in own] for own in planned.chosen
        ]
        poles = [pole for own in standing for pole in own]
        lifted = [replace(pole, centre=pole.centre + 0.2 * pole.axis) for pole in poles]
        found = [site_errors(drawn, standing, (seed, 2, r)) for r in range(runs)]
        others = [site_errors(drawn, drawn.at.poles, (seed, 4, r)) for r in range(runs)]
        hidden = 0
        for k, (sensor, pose) in enumerate(zip(drawn.sensors, poses, strict=True)):
            for own, numbers in zip(standing, planned.chosen, strict=True):
                views = poles_in_view(surroundings, own, sensor, pose, np.random.default_rng(seed))
                hidden += sum(
                    bool(planned.seen[n, k]) and not view
                    for n, view in zip(numbers, views, strict=True)
                )
        own_errors = [each for each in found if each is not None]
        middle = float(np.median(own_errors)) if own_errors else np.nan
        there = [each for each in others if each is not None]
        return Found(
            kind,
            verdict=planned.rehearsal.status,
            poles=len(poles),
            hidden=hidden,
            in_the_way=sum(not is_clear(pole, surroundings[1:]) for pole in lifted),
            answered=len(own_errors),
            runs=runs,
            ratio=worst_at(planned.predicted, AT) / middle,
            over_random=middle / float(np.median(there)) if there else np.nan,
        )


FACING = {
    "side by side, 1 m": ((0.0, 0.0, 1.5, 0.0, 0.0), (0.0, 1.0, 1.5, 0.0, 0.0)),
    "at right angles, 4 m": ((0.0, 0.0, 2.0, 0.0, 0.0), (0.0, 4.0, 2.0, 0.0, 90.0)),
    "facing each other, 8 m": ((0.0, 0.0, 3.0, 15.0, 0.0), (8.0, 0.0, 3.0, 15.0, 180.0)),
}
"""x, y, z, pitch and yaw, metres and degrees, of two LiDARs over bare ground."""

SPACINGS = {0.5: 0.15, 1.0: 0.2, 1.5: 0.25, 2.5: 0.4, 4.0: 0.6, 6.0: 0.8, 8.0: 1.0}
"""How far apart poles are, metres, and by how much more or less."""

FEET, PAIRS, LEAST_PAIRS = 60, 60, 20


def spacing(job: tuple[str, str]) -> str:
    """Write a row: errors of two LiDARs by the spacing of the poles, cm."""
    name, model = job
    poses = [
        se3.from_rt(se3.rotation_from_rpy(np.radians([0.0, pitch, yaw])), np.array([x, y, z]))
        for x, y, z, pitch, yaw in FACING[name]
    ]
    with threadpool_limits(1, user_api="blas"):
        rng = np.random.default_rng(0)
        stations = place_drawn_lidars(("a", "b"), [find_sensor(model)] * 2, poses)
        feet = survey(stations).feet
        away = np.stack([np.linalg.norm(feet[:, :2] - each.at[:2], axis=1) for each in stations])
        feet = rng.permutation(feet[((away >= 3.0) & (away <= 7.0)).all(axis=0)])[:FEET]
        poles = leaning(feet, (np.radians(20.0),), 4, 2.0, 0.02)
        seen = who_sees(poles, stations, divergences_of(stations))
        both = np.asarray(seen.all(axis=1))
        poles, seen = poles.select(both), seen[both]
        none = Surfaces((), (np.zeros(0, dtype=np.int64),) * 2)
        numbers = np.arange(len(poles))
        network = network_of(stations, poles, seen, numbers, none.bands, quickly=True)
        design = design_of(stations, none, poles, seen, network, 10.0)
        upright = poles.axis[:, 2] > 0.99
        gaps = np.linalg.norm(poles.foot[:, None] - poles.foot, axis=2)
        cells = []
        for middle, slack in SPACINGS.items():
            there = np.abs(gaps - middle) <= slack
            pairs = np.argwhere(there & upright[:, None] & ~upright)
            errors = [errors_of(design, [p])[1].max() for p in rng.permutation(pairs)[:PAIRS]]
            middle_cm, best_cm = 100 * np.median(errors or [0.0]), 100 * min(errors, default=0.0)
            cells.append(f"{middle_cm:.1f}, {best_cm:.1f}" if len(errors) >= LEAST_PAIRS else "–")
    return f"{name}, {model} | {' | '.join(cells)}"


def table(header: str, rows: Sequence[str]) -> None:
    print(f"| {header} |\n{'| --- ' * (header.count('|') + 1)}|")
    print("\n".join(f"| {row} |" for row in rows) + "\n", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", default="1000:1010")
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--poles", type=int, default=2)
    parser.add_argument("--kinds", nargs="+", default=list(KINDS))
    parser.add_argument("--sites", action="store_true", help="plan for sites of four LiDARs")
    parser.add_argument("--spacing", action="store_true", help="errors by how far apart poles are")
    parser.add_argument("--models", nargs="+", default=["XT32", "VLP-16"], help="with --spacing")
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    if options.spacing:
        with ProcessPoolExecutor(options.jobs, mp_context=get_context("spawn")) as pool:
            pairs = [(name, model) for name in FACING for model in options.models]
            apart = " | ".join(f"{each:g}" for each in SPACINGS)
            table(f"between the feet of the poles, m | {apart}", list(pool.map(spacing, pairs)))
        return
    first, last = map(int, options.seeds.split(":"))
    jobs = [(k, s, options.runs, options.poles) for k in options.kinds for s in range(first, last)]
    with ProcessPoolExecutor(options.jobs, mp_context=get_context("spawn")) as pool:
        work = run_site if options.sites else run
        every = [one for one in pool.map(work, jobs) if one is not None]
    groups = [(kind, [one for one in every if one.kind == kind]) for kind in options.kinds]
    groups = [(kind, own) for kind, own in [*groups, ("all", every)] if own]

    def counts(own: Sequence[Found]) -> str:
        done = [one for one in own if not one.refused]
        codes = ", ".join(sorted({one.refused for one in own if one.refused})) or "–"
        sums = (sum(getattr(o, name) for o in done) for name in ("hidden", "in_the_way"))
        ok = sum(one.verdict == "ok" for one in done)
        cells = (len(own), len(done), codes, ok, sum(o.poles for o in done), *sums)
        return " | ".join(map(str, [*cells, sum(o.off_ground for o in done)]))

    def middle(own: Sequence[Found], name: str) -> str:
        values = np.array([getattr(o, name) for o in own])
        values = values[np.isfinite(values)]
        return f"{np.median(values):.2f}" if len(values) else "–"

    def within(own: Sequence[Found], name: str, low: float, high: float) -> str:
        values = np.array([getattr(o, name) for o in own])
        values = values[np.isfinite(values)]
        return f"{np.count_nonzero((values >= low) & (values <= high))} of {len(values)}"

    table(
        "place | places | planned | refused as | rehearsal ok | poles | not seen | in the way "
        "| off the ground",
        [f"{kind} | {counts(own)}" for kind, own in groups],
    )
    table(
        "place | answered | predicted over actual | 0.7 to 1.5 | by the poles alone | 0.7 to 1.5",
        [
            f"{kind} | {sum(o.answered for o in own)} of {sum(o.runs for o in own)} | "
            + " | ".join(
                f"{middle(own, name)} | {within(own, name, 0.7, 1.5)}"
                for name in ("ratio", "ratio_alone")
            )
            for kind, own in groups
        ],
    )
    table(
        "place | planned over random | 0.7 or less | by the poles alone | 0.7 or less "
        "| over the best of 200 | 1.15 or less",
        [
            f"{kind} | "
            + " | ".join(
                f"{middle(own, name)} | {within(own, name, 0.0, most)}"
                for name, most in (
                    ("over_random", 0.7),
                    ("over_random_alone", 0.7),
                    ("over_best", 1.15),
                )
            )
            for kind, own in groups
        ],
    )


if __name__ == "__main__":
    sys.exit(main())
