"""A LiDAR in an existing map: how often it is found, how exactly, and what is said of a wrong map.

A place is recorded by 3 to 8 LiDARs with all the errors of the field. Their clouds are put together
by poses that err as `base.systematic.map_distortion` has it (5 mm, and 5 mm at 30 m), thinned to 5,
10 or 20 cm, and get noise of 5 to 30 mm: the map. Another LiDAR is calibrated to it from a rough
place (2 m, 1 σ), without a heading. In some draws cars were moved since, or something large, and in
a fifth the map is of another place. Prints a Markdown table, and the peak memory. What both share
is counted of what the LiDAR sees off the ground.

    python benchmarks/mapped.py --draws 60
    python benchmarks/mapped.py --real data

With `--real` the map is recorded: one cloud of every real pair that has a reference of its own, of
pandaset the three frames, thinned to 5 cm. The other LiDAR is calibrated to it, and by KISS-Matcher
with GICP (`checking.rivals`), which takes no rough place. The pairs of `0003` tune. `data` is the
folder with the recordings.

Seeds below 1000 are for setting constants; those from 1000 on, where this starts, state figures.
"""

from __future__ import annotations

import argparse
import resource
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from threadpoolctl import threadpool_limits

from detection_hard import WRONG_ANGLE, WRONG_DISTANCE
from hard_scenes import FIRST_STATED_SEED
from no_poles import RIVAL, Right, apart, codes_of, right_table
from retropole.base import se3
from retropole.base.datatypes import Array, PointCloud, PoseEstimate
from retropole.base.errors import Refusal
from retropole.base.sensors import find_sensor
from retropole.base.systematic import map_distortion
from retropole.checking.methods import missing_extra
from retropole.checking.rivals import FUNCTIONS
from retropole.hypotheses.prior import PosePrior
from retropole.io.fields import MapPlace
from retropole.io.maps import as_map
from retropole.pipeline import Options, calibrate
from retropole.simulation import FIELD, Box, Surface, draw_device, scan
from retropole.simulation.scenes import METAL, SURROUNDINGS
from retropole.surfaces.consistency import objects_in
from retropole.surfaces.registration import voxel_downsample
from semireal import PAIRS, distance, load

SCENES = ("street", "harbor", "square")
MODELS = ("VLP-16", "XT32", "OS1", "HDL-32E")
ORIGIN = np.array([412_345.0, 5_654_321.0, 87.0])
THINNING = (0.05, 0.1, 0.2)
NOISE = (0.005, 0.03)
ROUGH = 2.0
"""1 σ of the rough place, metres."""

MOVED, FACADE, ELSEWHERE = 0.5, 0.1, 0.2
"""Shares of the draws: cars moved, of those of the same place; something large moved; elsewhere."""

ENOUGH = 0.3
"""Share of the surfaces that LiDAR and map have in common, from which an answer is wanted."""

ON_THE_MAP = 0.5
"""A point as near to one of the map lies on it, metres."""

KINDS = "same", "cars moved", "large thing moved", "another place"


@dataclass(frozen=True, eq=False)
class Draw:
    """A map, a LiDAR in it, and what is known of it: true and rough."""

    scene: str
    kind: str
    map: PointCloud
    lidar: PointCloud
    T_map_lidar: Array
    rough: Array
    model: str


def pose_in(clear: Array, rng: np.random.Generator) -> Array:
    at = rng.uniform(-1, 1, 2) * np.maximum(np.array(clear) - 0.5, 1.0)
    tilt = Rotation.from_rotvec(np.r_[rng.normal(0, 0.05, 2), 0.0])
    R = (tilt * Rotation.from_euler("z", rng.uniform(0, 2 * np.pi))).as_matrix()
    return se3.from_rt(R, np.r_[at, rng.uniform(2.0, 5.0)])


def cars(clear: Array, rng: np.random.Generator) -> list[Surface]:
    found: list[Surface] = []
    for _ in range(int(rng.integers(3, 7))):
        at = rng.uniform(-1, 1, 2) * np.array([25.0, clear[1]])
        yaw = Rotation.from_euler("z", rng.choice([0, np.pi]) + rng.normal(0, 0.05)).as_matrix()
        found.append(Box(np.r_[at, 0.8], yaw, np.array([2.2, 0.9, 0.7]), METAL))
    return found


def draw(seed: int) -> Draw:
    rng = np.random.default_rng([77, seed])
    scene = SCENES[seed % 3]
    place = SURROUNDINGS[scene](rng)
    clear = place.clear
    u = rng.uniform()
    kind = (
        "another place"
        if u < ELSEWHERE
        else "large thing moved"
        if u < ELSEWHERE + FACADE
        else ("cars moved" if rng.uniform() < MOVED else "same")
    )
    then = [*place.surfaces, *cars(clear, rng)]
    pieces = []
    for _ in range(int(rng.integers(3, 9))):
        sensor = find_sensor(str(rng.choice(MODELS)))
        pose = pose_in(clear, rng)
        device = draw_device(sensor, FIELD, rng)
        cloud = scan(then, sensor, pose, rng, noise=FIELD, device=device).cloud
        off = rng.multivariate_normal(np.zeros(6), map_distortion())
        pieces.append(se3.apply(se3.retract(pose, off), cloud.xyz))
    xyz = voxel_downsample(np.concatenate(pieces), float(rng.choice(THINNING)))
    xyz = xyz + rng.normal(0, rng.uniform(*NOISE), xyz.shape)
    if kind == "another place":
        now = [*SURROUNDINGS[scene](rng).surfaces, *cars(clear, rng)]
    elif kind == "large thing moved":
        large = [k for k, each in enumerate(place.surfaces) if k and each.bounding_radius > 2.5]
        k = large[int(rng.integers(len(large)))]
        way = rng.uniform(0, 2 * np.pi)
        step = rng.uniform(0.5, 2.0) * np.array([np.cos(way), np.sin(way), 0.0])
        moved = replace(place.surfaces[k], centre=place.surfaces[k].centre + step)
        now = [*place.surfaces[:k], moved, *place.surfaces[k + 1 :], *cars(clear, rng)]
    elif kind == "cars moved":
        now = [*place.surfaces, *cars(clear, rng)]
    else:
        now = then
    model = str(rng.choice(MODELS))
    sensor = find_sensor(model)
    pose = pose_in(clear, rng)
    lidar = scan(now, sensor, pose, rng, noise=FIELD, device=draw_device(sensor, FIELD, rng)).cloud
    rough = pose[:3, 3] + rng.normal(0, ROUGH, 3) * [1, 1, 0.5]
    return Draw(
        scene,
        kind,
        PointCloud(xyz + ORIGIN),
        lidar,
        se3.from_rt(np.eye(3), ORIGIN) @ pose,
        rough + ORIGIN,
        model,
    )


@dataclass(frozen=True)
class Outcome:
    """What came of one draw; ``chi2`` is that of the truth with the stated covariance."""

    kind: str
    seed: int
    status: str
    code: str
    shared: float
    rotation: float = np.nan
    translation: float = np.nan
    at_30m: float = np.nan
    chi2: float = np.nan

    @property
    def is_wrong(self) -> bool:
        """Whether a pose is given that is not right; of another place, whether any is."""
        far = self.rotation > WRONG_ANGLE or self.translation > WRONG_DISTANCE
        return self.status != "refused" and (far or self.kind == "another place")


def share_of(given: PointCloud, lidar: PointCloud, T: Array) -> float:
    """Share of what the LiDAR sees off the ground that lies on the map under a pose (4, 4)."""
    standing = objects_in(lidar, np.random.default_rng(0)).points
    near, _ = cKDTree(given.xyz).query(se3.apply(T, standing), distance_upper_bound=ON_THE_MAP)
    return float(np.mean(near <= ON_THE_MAP)) if len(standing) else 0.0


def run(seed: int) -> Outcome:
    """Draw and calibrate."""
    drawn = draw(seed)
    given = as_map(drawn.map, MapPlace((drawn.rough[0], drawn.rough[1], drawn.rough[2])))
    sensors = None, find_sensor(drawn.model)
    known = Options(sensors=sensors, poles=0, prior=PosePrior(distance_sigma=ROUGH))
    found = calibrate(given, drawn.lidar, options=known)
    code = ", ".join(codes_of(found))
    shared = share_of(given, drawn.lidar, drawn.T_map_lidar)
    if found.T_target_source is None or found.covariance is None:
        return Outcome(drawn.kind, seed, found.status, code, shared)
    off = se3.difference(found.T_target_source, drawn.T_map_lidar)
    step = se3.local(found.T_target_source, drawn.T_map_lidar)
    return Outcome(
        drawn.kind,
        seed,
        found.status,
        code,
        shared,
        off.rotation,
        off.translation,
        float(np.hypot(30.0 * off.rotation, off.translation)),
        float(step @ np.linalg.solve(found.covariance, step)),
    )


def row(name: str, own: Sequence[Outcome]) -> str:
    answered = [o for o in own if o.status != "refused"]
    inside = sum(o.chi2 <= chi2.ppf(0.95, 6) for o in answered)
    refused = Counter(o.code for o in own if o.status == "refused")
    cells = (
        name,
        len(own),
        len(answered),
        sum(o.status == "ok" for o in own),
        sum(o.is_wrong for o in own),
        f"{1000 * np.median([o.at_30m for o in answered]):.0f}" if answered else "",
        f"{inside} of {len(answered)}" if answered else "",
        ", ".join(f"{code} {count}" for code, count in refused.most_common()),
    )
    return "| " + " | ".join(map(str, cells)) + " |"


def map_of(name: str, data: Path) -> PointCloud:
    """Put the frames of a standing LiDAR together, or take the one that there is, and thin them."""
    frames = [each.name for each in PAIRS if each.folder == "pandaset" == name.split()[0]]
    xyz = np.concatenate([load(each, data).target.xyz for each in frames or [name]])
    return PointCloud(voxel_downsample(xyz[np.isfinite(xyz).all(axis=1)], THINNING[0]))


def run_real(name: str, data: Path, rng: np.random.Generator) -> Right:
    """Calibrate a real pair whose target is a map."""
    given = load(name, data)
    rough = given.T[:3, 3] + rng.normal(0, ROUGH, 3) * [1, 1, 0.5]
    target = as_map(map_of(name, data), MapPlace((rough[0], rough[1], rough[2])))
    known = Options(
        sensors=(None, given.sensors[1]), poles=0, prior=PosePrior(distance_sigma=ROUGH)
    )
    answer = calibrate(target, given.source, options=known)
    nothing = np.nan, np.nan
    off, stated, squared, rival = nothing, nothing, np.nan, nothing
    if answer.T_target_source is not None and answer.covariance is not None:
        off = apart(answer.T_target_source, given.T)
        sigma = np.sqrt(np.diag(answer.covariance))
        stated = float(np.degrees(np.linalg.norm(sigma[:3]))), float(np.linalg.norm(sigma[3:]))
        of_reference = next(pair.sigma for pair in PAIRS if pair.name == name)
        found = PoseEstimate(answer.T_target_source, answer.covariance, 0.0)
        squared = distance(found, given.T, np.diag(np.repeat(of_reference, 3) ** 2))
    if missing_extra(RIVAL) is None:
        with suppress(Refusal):
            match = FUNCTIONS[RIVAL](target, given.source, np.random.default_rng(0))
            rival = apart(match.T_target_source, given.T)
    return Right(name, answer.status, codes_of(answer), off, stated, squared, rival)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=300)
    parser.add_argument("--first", type=int, default=FIRST_STATED_SEED, help="first seed")
    parser.add_argument("--real", type=Path, metavar="DATA", help="folder with the recordings")
    parser.add_argument("--every", type=int, default=1, help="take every n-th real pair only")
    parser.add_argument("--verbose", action="store_true", help="print every draw as it ends")
    arguments = parser.parse_args()
    if arguments.real is not None:
        names = [pair.name for pair in PAIRS if not pair.is_composed][:: arguments.every]
        rng = np.random.default_rng(arguments.first)
        with threadpool_limits(1):
            real = [run_real(name, arguments.real, rng) for name in names]
        print(right_table(real, "in the map"))
        return
    outcomes = []
    with threadpool_limits(1):
        for seed in range(arguments.first, arguments.first + arguments.draws):
            outcomes.append(run(seed))
            if arguments.verbose:
                print(outcomes[-1], flush=True)
    print(
        "| the map | draws | answered | ok | wrong | error at 30 m, mm, median | in the 95 % "
        "region | refused for |\n| --- |" + " --- |" * 7
    )
    for kind in KINDS:
        print(row(kind, [o for o in outcomes if o.kind == kind]))
    right = [o for o in outcomes if o.kind != "another place"]
    print(row(f"shares {ENOUGH:.0%}", [o for o in right if o.shared >= ENOUGH]))
    print(row("all", outcomes))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    shares = np.quantile([o.shared for o in right], [0.0, 0.5, 1.0]) if right else np.zeros(3)
    print("\nshared surfaces: least, median, most: " + ", ".join(f"{each:.0%}" for each in shares))
    print(f"peak memory: {peak:.0f} MB")


if __name__ == "__main__":
    main()
