"""Whether another version of the code gives the same answers on 120 pairs and 30 sites.

Pairs of five scenes: among them symmetric places, parallel poles, three poles, several frames, two
placements, a dark pole, tape that is too dim, a wrong radius, places mixed up, a cloud without
intensity, and poles alone. Sites of two to five LiDARs, with a survey, with blunders, in rings, and
such that two LiDARs share nothing. Recordings are drawn and answers kept with one version, and
compared with another:

    python benchmarks/same_answers.py record /tmp/answers.pkl
    python benchmarks/same_answers.py compare /tmp/answers.pkl

The seconds of CPU that both took are printed as well: of one run each, on a machine that may be
busy.
"""

from __future__ import annotations

import argparse
import pickle
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct, structs

from retropole.base import se3
from retropole.base.datatypes import Array, PointCloud
from retropole.base.description import ControlPoint, Frame, Sighting, Site, SiteLidar, SurveyedPole
from retropole.base.sensors import Sensor, find_sensor
from retropole.pipeline import Options, calibrate, calibrate_site
from retropole.simulation import (
    FIELD,
    TYPICAL,
    SimulatedPair,
    SimulationError,
    place_again,
    simulate_pair,
)
from retropole.simulation.sites import SimulatedSite, Survey, simulate_site
from site_blunders import simulate_blunder

PAIRS, SITES, FIRST_SEED = 120, 30, 7000
SCENES = ("corridor", "street", "harbor", "square", "kerb")
BLUNDERS = ("pole", "files", "control", "slide")
KINDS = ("posts", "crane", "truck")
VARIANTS: tuple[dict[str, Any], ...] = (
    {},
    {"noise": FIELD},
    {"symmetric": True},
    {"min_pole_angle": 0.0, "max_pole_angle": float(np.radians(3))},
    {"poles": 3},
    {"frames": 4},
)
CLOUD = ("xyz", "intensity", "ring", "time", "frame", "origin")
MAKERS = {each.__name__: each for each in (Frame, SurveyedPole, ControlPoint, Sighting)}

Plain = dict[str, Any]
"""A recording, a pair or a site as names and arrays, which another version can read."""


def plain_cloud(cloud: PointCloud | None) -> Plain | None:
    return None if cloud is None else {name: getattr(cloud, name) for name in CLOUD}


def cloud_of(plain: Plain | None) -> PointCloud | None:
    return None if plain is None else PointCloud(**plain)


def plain(thing: Any) -> Any:
    """A data class of what was surveyed as names and values."""
    if isinstance(thing, Struct):
        own = {name: plain(each) for name, each in structs.asdict(thing).items()}
        return {"class": type(thing).__name__, **own}
    return tuple(plain(each) for each in thing) if isinstance(thing, tuple) else thing


def made(thing: Any) -> Any:
    """The same back."""
    if isinstance(thing, dict):
        own = {name: made(value) for name, value in thing.items() if name != "class"}
        return MAKERS[thing["class"]](**own)
    return tuple(made(each) for each in thing) if isinstance(thing, tuple) else thing


def draw_pair(k: int) -> Plain:
    """Draw a pair: clouds of each placement, sensors, and how it is calibrated."""
    options = VARIANTS[(k // len(SCENES)) % len(VARIANTS)]
    pair = tried(lambda rng: simulate_pair(SCENES[k % len(SCENES)], rng, **options), k)
    pairs = [pair, *other_placement(pair, k)]
    given: Plain = {
        "target": [plain_cloud(each.target) for each in pairs],
        "source": [plain_cloud(each.source) for each in pairs],
        "sensors": [sensor.name if k % 2 else None for sensor in pair.sensors],
        "options": {},
    }
    if k % 7 == 3:
        given["options"]["radius_sigma"] = 0.002
    if k % 11 == 5:
        given["options"]["radius"] = 0.04
    if k % 13 == 6:
        given["options"]["scene"] = False
    if k % 17 == 8:
        dim = given["target"][0]
        dim["intensity"] = np.minimum(dim["intensity"], 50.0)
    if k % 29 == 11:
        given["source"][0]["intensity"] = None
    return given


def tried(draw: Callable[[np.random.Generator], Any], k: int) -> Any:
    """Draw with one generator after the other until something comes of it."""
    for again in range(20):
        try:
            return draw(np.random.default_rng([FIRST_SEED + k, again]))
        except SimulationError:
            continue
    raise SimulationError(f"20 draws of number {k} came to nothing")


def other_placement(pair: SimulatedPair, k: int) -> list[SimulatedPair]:
    """A second placement of the poles of every tenth pair."""
    if k % 10 != 4:
        return []
    try:
        return [place_again(pair, np.random.default_rng(FIRST_SEED + k))]
    except SimulationError:
        return []


def draw_site(k: int) -> Plain:
    """Draw a site, two of three with a blunder."""
    blunder = (None, None, *BLUNDERS)[k // 2 % 6]
    few = blunder == "slide"
    options: dict[str, Any] = {"lidars": 2 if few else 2 + k % 4, "noise": (TYPICAL, FIELD)[k % 2]}
    options |= {"placements": 1, "poles": 2} if few else {"placements": 2, "poles": 3}
    if blunder == "control" or (k % 5 == 1 and not few):
        options["survey"] = Survey(points=4, sigma=0.005)
    if k % 10 == 9:
        site = tried(lambda rng: simulate_site("ring", rng, lidars=3 + k % 3), k).as_site()
    else:
        # On a truck hardly a push is hidden.
        kinds = KINDS[:2] if few else KINDS
        kind = kinds[k % len(kinds)]
        make = partial(simulated, kind, blunder, options)
        site = tried(make, k).as_site()
    clouds = [[plain_cloud(cloud) for cloud in lidar.clouds] for lidar in site.lidars]
    if k % 12 == 7:
        # The last LiDAR recorded none of the first placement, and no pole of the others.
        clouds[-1] = [None, *clouds[-1][1:]]
        for each in filter(None, clouds[-1]):
            each["intensity"] = np.minimum(each["intensity"], 20.0)
    return {
        "name": site.name,
        "names": [lidar.name for lidar in site.lidars],
        "sensors": [None if s.sensor is None else s.sensor.name for s in site.lidars],
        "clouds": clouds,
        "placements": site.placements,
        "radius": site.radius,
        "surveyed": [plain(each) for each in (site.frame, site.poles, site.points)],
    }


def simulated(
    kind: str, blunder: str | None, options: dict[str, Any], rng: np.random.Generator
) -> SimulatedSite:
    if blunder is None:
        return simulate_site(kind, rng, **options)
    return simulate_blunder(kind, rng, blunder, **options)[0]


def answer_pair(given: Plain) -> Plain:
    """Calibrate a pair: what is held against another version's answer."""
    target, source = ([cloud_of(c) for c in given[name]] for name in ("target", "source"))
    sensors = tuple(sensor_of(name) for name in given["sensors"])
    found = calibrate(target, source, options=Options(sensors=sensors, **given["options"]))  # type: ignore[arg-type]
    poses = [pose for pose in (found.poles, found.refined) if pose is not None]
    return {
        "verdict": (found.status, sorted(reason.code for reason in found.reasons)),
        "poses": [(pose.T_target_source, pose.covariance) for pose in poses],
        "margin": found.margin,
    }


def answer_site(given: Plain) -> Plain:
    """Calibrate a site: what is held against another version's answer."""
    frame, poles, points = (made(each) for each in given["surveyed"])
    lidars = tuple(
        SiteLidar(name, tuple(cloud_of(cloud) for cloud in clouds), sensor=sensor_of(sensor))
        for name, clouds, sensor in zip(
            given["names"], given["clouds"], given["sensors"], strict=True
        )
    )
    site = Site(given["name"], lidars, given["placements"], radius=given["radius"])
    found = calibrate_site(replace(site, frame=frame, poles=poles, points=points))
    return {
        "verdict": (found.status, sorted(reason.code for reason in found.reasons)),
        "poses": [
            (one.T_site_lidar, one.covariance) for one in found.lidars if one.covariance.any()
        ],
        "margin": None,
    }


def sensor_of(name: str | None) -> Sensor | None:
    return None if name is None else find_sensor(name)


STEPS: dict[str, tuple[int, Callable[[int], Plain], Callable[[Plain], Plain]]] = {
    "pairs": (PAIRS, draw_pair, answer_pair),
    "sites": (SITES, draw_site, answer_site),
}


def record(file: Path, share: float) -> None:
    """Draw everything or a share of it, answer it, and keep both."""
    kept = {}
    for name, (count, draw, answer) in STEPS.items():
        drawn = [draw(k) for k in range(round(share * count))]
        start = time.process_time()
        answers = [answer(each) for each in drawn]
        kept[name] = drawn, answers, time.process_time() - start
        verdicts = [each["verdict"][0] for each in answers]
        counts = ", ".join(f"{verdicts.count(s)} {s}" for s in ("ok", "warn", "refused"))
        print(f"{len(drawn)} {name}: {counts}", flush=True)
    file.write_bytes(pickle.dumps(kept))


def compare(file: Path) -> None:
    """Answer again, and print what differs."""
    kept = pickle.loads(file.read_bytes())
    for name, (_, _, answer) in STEPS.items():
        drawn, before, seconds = kept[name]
        start = time.process_time()
        after = [answer(each) for each in drawn]
        took = time.process_time() - start
        pose = sigma = margin = 0.0
        for k, (old, new) in enumerate(zip(before, after, strict=True)):
            if old["verdict"] != new["verdict"] or len(old["poses"]) != len(new["poses"]):
                print(f"{name} {k}: {old['verdict']} before, {new['verdict']} now")
                continue
            for (T, C), (T_new, C_new) in zip(old["poses"], new["poses"], strict=True):
                pose = max(pose, mahalanobis(se3.local(T, T_new), C))
                sigma = max(sigma, float(np.abs(C_new - C).max() / np.abs(C).max()) / 2)
            if old["margin"] is not None:
                margin = max(margin, abs(old["margin"] - new["margin"]))
        print(
            f"{len(before)} {name}: poses within {pose:.1e} σ, σ within {sigma:.1e}, margins "
            f"within {margin:.1e}; {took:.0f} s of CPU, {seconds:.0f} s before"
        )


def mahalanobis(step: Array, covariance: Array) -> float:
    return float(np.sqrt(max(step @ np.linalg.solve(covariance, step), 0.0)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("record", "compare"))
    parser.add_argument("file", type=Path)
    parser.add_argument("--share", type=float, default=1.0, help="of what is recorded")
    arguments = parser.parse_args()
    if arguments.what == "record":
        record(arguments.file, arguments.share)
    else:
        compare(arguments.file)


if __name__ == "__main__":
    main()
