"""Whole sites: accuracy and coverage, blunders, rings that only the loop decides, survey, time.

``python benchmarks/site.py WHAT --seeds 2000:2100 --jobs 2`` with WHAT one of

- ``sites``: sites of 3 to 8 LiDARs, 2 to 4 placements of 2 to 4 poles, field nuisances. Every pose
  within 1° and 0.15 m, or refused; how often the 95 % regions of poses and of pairs hold the truth;
  and the error at 30 m beside that of chaining pairs along the fewest links.
- ``blunders``: one in each: a pole bumped, two files swapped, a control point off by 0.1 m.
- ``slides``: two or three LiDARs and two poles, one of which is pushed by 3 to 15 cm in the plane
  of both: neither their angle nor their distance changes.
- ``rings``: rings whose pairs have two hypotheses or more each.
- ``survey``: four control points of 5 mm; poses in the world.
- ``families``: sites of 3 to 5 LiDARs with 2 placements of 3 poles, each seed under the next of the
  families of errors that `coverage.STATING` has; nothing at sites was set under any but the last,
  which all else here has.
- ``time``: 8 LiDARs, 4 placements, 100,000 points in each recording.

Seeds below 1000 are for tuning, from 2000 on they state the figure. What was set on tuning seeds:
`blunders.BLUNDER`, `patch_pairs.MAX_LEAN`, `verdict.site.LOOP_SIGNIFICANCE`.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from itertools import combinations
from multiprocessing import get_context

import numpy as np

from coverage import STATING
from retropole.adjustment.answer import SiteCalibration
from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.base.errors import Reason
from retropole.base.se3 import joint_of, relative
from retropole.pipeline import Options, calibrate, calibrate_site
from retropole.simulation import FIELD, SimulationError
from retropole.simulation.sites import SimulatedSite, Survey, simulate_site
from site_blunders import Blunder, simulate_blunder

KINDS = ("posts", "crane", "truck")
CHI2_95 = 12.591587243743977
MAX_ROTATION, MAX_TRANSLATION = np.radians(1.0), 0.15
AT = 30.0
SURVEY = Survey(points=4, sigma=0.005)
BLUNDERS = ("pole", "files", "control")
NAMES = {
    "pole": ("pole_moved", "misfit"),
    "files": ("recordings_exchanged",),
    "control": ("survey_outlier",),
}


@dataclass
class Row:
    """What came of one site."""

    seed: int
    words: str
    status: str = ""
    codes: tuple[str, ...] = ()
    right: bool = True
    poses: list[float] = field(default_factory=list)
    pairs: list[float] = field(default_factory=list)
    errors: list[float] = field(default_factory=list)
    chained: list[float] = field(default_factory=list)
    worst: tuple[float, float] = (0.0, 0.0)
    w: float = 0.0
    loop: float = 1.0
    named: bool = False
    seen_once: bool = False
    seconds: float = 0.0
    gigabytes: float = 0.0
    family: str = ""


def numbers(seed: int) -> tuple[np.random.Generator, str, int, int, int]:
    """Draw the kind of a site and how many LiDARs, placements and poles it has."""
    rng = np.random.default_rng(seed)
    kind = KINDS[seed % len(KINDS)]
    return rng, kind, *(int(rng.integers(*bounds)) for bounds in ((3, 9), (2, 5), (2, 5)))


def at_range(step: Array) -> float:
    """Root mean square over directions of how far a pose error moves a point, metres."""
    moved = [np.cross(step[:3], AT * way) + step[3:] for way in (*np.eye(3), *-np.eye(3))]
    return float(np.sqrt(np.mean(np.sum(np.square(moved), axis=1))))


def truth_of(sim: SimulatedSite) -> list[Array]:
    """True poses in the frame of the site: the world where it was surveyed, else the first's."""
    if sim.surveyed or sim.points:
        return list(sim.T_world_lidar)
    return [se3.inverse(sim.T_world_lidar[0]) @ T for T in sim.T_world_lidar]


def compare(row: Row, answer: SiteCalibration, truth: list[Array]) -> None:
    """Hold an answer against the truth."""
    row.status, row.codes = answer.status, tuple(reason.code for reason in answer.reasons)
    if not answer.lidars:
        return
    assert answer.covariance is not None
    T = [one.T_site_lidar for one in answer.lidars]
    for one, true in zip(answer.lidars, truth, strict=True):
        if one.covariance.any():
            step = se3.local(one.T_site_lidar, true)
            row.poses.append(float(step @ np.linalg.solve(one.covariance, step)))
            row.errors.append(at_range(step))
    for i, j in combinations(range(len(T)), 2):
        T_ij, covariance = relative(T[i], T[j], joint_of(answer.covariance, i, j))
        step = se3.local(T_ij, se3.inverse(truth[i]) @ truth[j])
        row.pairs.append(float(step @ np.linalg.solve(covariance, step)))
    apart = [se3.difference(a, b) for a, b in zip(T, truth, strict=True)]
    row.worst = max(one.rotation for one in apart), max(one.translation for one in apart)
    row.right = row.worst[0] < MAX_ROTATION and row.worst[1] < MAX_TRANSLATION
    row.w = max((test.w for test in answer.tests), default=0.0)
    row.loop = min((loop.probability for loop in answer.loops), default=1.0)


def chained(sim: SimulatedSite) -> list[float]:
    """Errors at range of poses that pairs give, composed along the fewest links from the first."""
    count = len(sim.names)
    shared = np.zeros((count, count), dtype=int)
    for own in sim.seen:
        for i, j in combinations(range(count), 2):
            both = int(np.sum(np.logical_and(own[i], own[j])))
            shared[i, j] += both if both > 1 else 0
    shared += shared.T
    known, errors = {0: np.eye(4)}, []
    waiting = [0]
    while waiting:
        here = waiting.pop(0)
        for there in np.argsort(-shared[here]):
            if there in known or not shared[here, there]:
                continue
            T = paired(sim, here, int(there))
            if T is not None:
                known[int(there)] = known[here] @ T
                waiting.append(int(there))
    truth = truth_of(sim)
    for i, T in known.items():
        if i:
            errors.append(at_range(se3.local(T, truth[i])))
    return errors


def paired(sim: SimulatedSite, i: int, j: int) -> Array | None:
    """Pose of one LiDAR for another from all placements in which both see two poles."""
    both = [
        k
        for k, own in enumerate(sim.seen)
        if np.sum(np.logical_and(own[i], own[j])) > 1
        and sim.clouds[i][k] is not None
        and sim.clouds[j][k] is not None
    ]
    target, source = ([sim.clouds[lidar][k] for k in both] for lidar in (i, j))
    answer = calibrate(target, source, options=Options(sensors=(sim.sensors[i], sim.sensors[j])))  # type: ignore[arg-type]
    return answer.T_target_source


def run_site(seed: int) -> Row | None:
    """Simulate and calibrate one site, and chain its pairs."""
    rng, kind, lidars, placements, poles = numbers(seed)
    sim = simulate_site(kind, rng, lidars=lidars, placements=placements, poles=poles, noise=FIELD)
    row = Row(seed, f"{kind} {lidars} × {placements} × {poles}")
    answer = timed(row, sim)
    if answer.lidars:
        row.chained = chained(sim)
    return row


def run_blunder(seed: int) -> Row | None:
    """Simulate and calibrate a site with a blunder; was it named?"""
    rng, kind, lidars, placements, poles = numbers(seed)
    blunder = BLUNDERS[(seed // len(KINDS)) % len(BLUNDERS)]
    sim, wrong = simulate_blunder(
        kind,
        rng,
        blunder,
        lidars=lidars,
        placements=placements,
        poles=max(poles, 3),
        noise=FIELD,
        survey=SURVEY if blunder == "control" else None,
    )
    row = Row(seed, f"{kind} {lidars} × {placements} × {poles}: {blunder}")
    answer = timed(row, sim)
    row.named = is_named(sim, wrong, answer)
    row.seen_once = is_seen_once(sim, wrong, answer)
    row.words += f", {wrong.name}"
    return row


def run_slide(seed: int) -> Row | None:
    """Simulate two poles, one pushed such that the other does not show it; was it named?"""
    rng = np.random.default_rng(seed)
    kind, lidars = KINDS[seed % len(KINDS)], 2 + seed // len(KINDS) % 2
    sim, wrong = simulate_blunder(
        kind, rng, "slide", lidars=lidars, placements=1, poles=2, noise=FIELD
    )
    row = Row(seed, f"{kind} {lidars} × 1 × 2: slide, {wrong.name}")
    row.named = is_named(sim, wrong, timed(row, sim))
    return row


def is_named(sim: SimulatedSite, wrong: Blunder, answer: SiteCalibration) -> bool:
    """Whether the reasons name the blunder: the very pole, recordings or point."""
    for reason in answer.reasons:
        if reason.code not in NAMES[wrong.kind]:
            continue
        if wrong.kind == "files":
            said = {str(reason.values["first"]), str(reason.values["second"])}
            placements = [sim.placements[k] for k in wrong.placements]
            names = [sim.names[i] for i in wrong.lidars]
            true = {f"{name} in placement {place}" for name in names for place in placements}
            # Of two LiDARs with two placements nothing tells in which.
            either = {f"{name} in placement {' or '.join(sim.placements)}" for name in names}
            if said == true or (len(sim.placements) == 2 and said == either):
                return True
            # Nor where two LiDARs alone share the poles of two placements, of which.
            parts = [set(str(reason.values[key]).split(" or ")) for key in ("first", "second")]
            if len(names) == 1 and true <= set.union(*parts) and max(map(len, parts)) == 2:
                return True
        elif wrong.kind == "pole":
            assert wrong.pole is not None
            assert wrong.placements
            placement = wrong.placements[0]
            if (
                "pole" in reason.values
                and str(reason.values["placement"]) == sim.placements[placement]
                and is_at(sim, place_in(reason), placement, wrong.pole)
            ):
                return True
        elif wrong.point is not None and sim.points[wrong.point].name in reason.message:
            return True
        elif wrong.surveyed is not None:
            name = f"{wrong.end} of {sim.surveyed[wrong.surveyed].name}"
            if name in reason.message:
                return True
    return False


def is_seen_once(sim: SimulatedSite, wrong: Blunder, answer: SiteCalibration) -> bool:
    """Whether a bumped pole counts, and no LiDAR found it where it stood before, or none after."""
    if wrong.pole is None:
        return False
    for pole in answer.poles:
        if pole.placement != wrong.placements[0]:
            continue
        if is_at(sim, pole.point, pole.placement, wrong.pole):
            after = set(pole.seen_by) & set(wrong.lidars)
            return not after or after == set(pole.seen_by)
    return False


def place_in(reason: Reason) -> Array:
    """Where a reason says that a pole stands (3,), in the frame of the site."""
    return np.array([float(reason.values[f"at_{axis}_m"]) for axis in "xyz"])


def is_at(sim: SimulatedSite, point: Array, placement: int, pole: int) -> bool:
    """Whether a pole found at a place is the one that was bumped: the nearest of its placement."""
    T = np.eye(4) if sim.surveyed or sim.points else sim.T_world_lidar[0]
    at = se3.apply(T, point[None])[0]
    away = [
        float(np.linalg.norm(np.cross(at - each.centre, each.axis)))
        for each in sim.poles[placement]
    ]
    return int(np.argmin(away)) == pole


def run_ring(seed: int) -> Row | None:
    """Simulate and calibrate a ring of ambiguous pairs."""
    rng = np.random.default_rng(seed)
    lidars = int(rng.integers(3, 7))
    sim = simulate_site("ring", rng, lidars=lidars, noise=FIELD)
    row = Row(seed, f"ring of {lidars}")
    timed(row, sim)
    return row


def run_survey(seed: int) -> Row | None:
    """Simulate and calibrate a site with four control points of 5 mm."""
    rng, kind, lidars, placements, poles = numbers(seed)
    sim = simulate_site(
        kind,
        rng,
        lidars=lidars,
        placements=placements,
        poles=poles,
        noise=FIELD,
        survey=SURVEY,
    )
    row = Row(seed, f"{kind} {lidars} × {placements} × {poles}, surveyed")
    timed(row, sim)
    return row


def run_family(seed: int) -> Row | None:
    """Simulate and calibrate a site under one of the families of errors."""
    rng = np.random.default_rng(seed)
    kind, lidars = KINDS[int(rng.integers(len(KINDS)))], int(rng.integers(3, 6))
    family = list(STATING)[seed % len(STATING)]
    sim = simulate_site(kind, rng, lidars=lidars, placements=2, poles=3, noise=STATING[family])
    row = Row(seed, f"{kind} {lidars} × 2 × 3, {family}", family=family)
    timed(row, sim)
    return row


def timed(row: Row, sim: SimulatedSite) -> SiteCalibration:
    """Calibrate, note the time, and compare with the truth."""
    site = sim.as_site()
    start = time.perf_counter()
    answer = calibrate_site(site)
    row.seconds = time.perf_counter() - start
    row.gigabytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    compare(row, answer, truth_of(sim))
    return answer


def run_time(seed: int) -> Row | None:
    """Eight LiDARs, four placements, two sweeps: 100,000 points in each recording, or more."""
    rng = np.random.default_rng(seed)
    kind = KINDS[seed % len(KINDS)]
    sim = simulate_site(
        kind,
        rng,
        lidars=8,
        placements=4,
        poles=3,
        sensors=("Pandar64", "OS1"),
        noise=FIELD,
        frames=2,
    )
    points = [len(cloud) for own in sim.clouds for cloud in own if cloud is not None]
    row = Row(seed, f"{kind} 8 × 4 × 3, {np.median(points):,.0f} points each")
    timed(row, sim)
    return row


RUNS: dict[str, Callable[[int], Row | None]] = {
    "sites": run_site,
    "blunders": run_blunder,
    "slides": run_slide,
    "rings": run_ring,
    "survey": run_survey,
    "families": run_family,
    "time": run_time,
}


def run(what: str, seed: int) -> Row | None:
    """Run one, or say that it cannot be simulated."""
    try:
        return RUNS[what](seed)
    except SimulationError as error:
        return Row(seed, f"not simulated: {error}", "none")


HEADER = (
    "| kind | answered | beyond 1° or 0.15 m | refused | in the 95 % region: poses | relative | "
    "median χ² of a pose (5.3 is ideal) | median error at 30 m, mm | chained: poses reached | "
    "median of these, mm | of all, mm |"
)


def counted(rows: list[Row], status: str) -> str:
    """Say of which codes the rows of a verdict are, and how many have each."""
    found = Counter(code for row in rows if row.status == status for code in set(row.codes))
    return ", ".join(f"{code} {count}" for code, count in found.most_common())


def report(name: str, rows: list[Row]) -> None:
    """Print what came of some sites, as a row of a table."""
    answered = [row for row in rows if row.status in ("ok", "warn")]
    wrong = sum(not row.right for row in answered)
    cells = [name, f"{len(answered)} of {len(rows)}", str(wrong), counted(rows, "refused")]
    if answered:
        poses, pairs, errors = (
            np.concatenate([getattr(row, name) for row in answered])
            for name in ("poses", "pairs", "errors")
        )
        for squares in (poses, pairs):
            cells.append(f"{np.mean(squares < CHI2_95):.1%} of {len(squares)}")
        cells += [f"{np.median(poses):.1f}", f"{1000 * np.median(errors):.1f}"]
    chains = [row.chained for row in answered if row.chained]
    if chains:
        reached = np.concatenate(chains)
        ours = sum(len(row.errors) for row in answered if row.chained)
        # A pose that no chain reaches counts as farther off than any.
        every = np.r_[reached, np.full(ours - len(reached), np.inf)]
        middles = [f"{1000 * np.median(some):.1f}" for some in (reached, every)]
        cells += [f"{len(reached)} of {ours}", *middles]
    print("| " + " | ".join(cells) + " |")


def report_blunders(rows: list[Row]) -> None:
    """Print how many blunders of each kind were named."""
    print(
        "\n| blunder | sites | named | under ok | of these seen at one place alone | refused for |"
    )
    print("| --- " * 6 + "|")
    for blunder in (*BLUNDERS, "slide"):
        some = [row for row in rows if f": {blunder}" in row.words]
        if some:
            absorbed = [row for row in some if row.status == "ok"]
            others = [row for row in some if not row.named]
            cells = [blunder, len(some), sum(row.named for row in some), len(absorbed)]
            cells += [sum(row.seen_once for row in absorbed), counted(others, "refused")]
            print("| " + " | ".join(map(str, cells)) + " |")


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("what", choices=list(RUNS))
    parser.add_argument("--seeds", default="2000:2010", help="first, one after the last, step")
    parser.add_argument("--jobs", type=int, default=1)
    options = parser.parse_args()
    seeds = range(*(int(each) for each in options.seeds.split(":")))
    rows: list[Row] = []
    with ProcessPoolExecutor(options.jobs, mp_context=get_context("spawn")) as pool:
        running = [pool.submit(run, options.what, seed) for seed in seeds]
        for each in running:
            row = each.result()
            if row is None:
                continue
            rows.append(row)
            print(
                f"{row.seed} {row.words}: {row.status} {' '.join(row.codes)} "
                f"{np.degrees(row.worst[0]):.3f}° {1000 * row.worst[1]:.1f} mm, d² "
                f"{max(row.poses, default=0):.1f} {max(row.pairs, default=0):.1f}, w {row.w:.1f}, "
                f"{row.seconds:.1f} s" + (", named" if row.named else ""),
                flush=True,
            )
    rows = [row for row in rows if row.status != "none"]
    print(f"\nwarned of: {counted(rows, 'warn')}\n\n{HEADER}")
    print("|" + " --- |" * (HEADER.count("|") - 1))
    for name in dict.fromkeys(row.family or options.what for row in rows):
        report(name, [row for row in rows if (row.family or options.what) == name])
    if options.what in ("blunders", "slides"):
        report_blunders(rows)
    if any(row.seconds for row in rows):
        print(
            f"\nseconds: median {np.median([row.seconds for row in rows]):.1f}, most "
            f"{max(row.seconds for row in rows):.1f}; {max(row.gigabytes for row in rows):.2f} GiB"
        )


if __name__ == "__main__":
    main()
