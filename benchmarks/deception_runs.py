"""One draw of a recording that deceives: drawn, recorded, calibrated, and what the scene says.

For `deception`, which counts what comes of many.
"""

from __future__ import annotations

import time
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.spatial import cKDTree

from coverage import SENSORS
from deception_poles import Drawn
from deception_scenes import KINDS, Kind
from deception_sites import Site, draw_site, is_in_view, recorded
from detection_hard import WRONG_ANGLE, WRONG_DISTANCE
from retropole.base import se3
from retropole.base.datatypes import Array, BoolArray, Calibration, PointCloud
from retropole.base.sensors import Sensor, find_sensor
from retropole.pipeline import Options, calibrate
from retropole.simulation import FIELD, TYPICAL, Device, draw_device
from retropole.simulation.pairs import DEFAULT_SENSORS
from retropole.simulation.scenes import SURROUNDINGS
from retropole.surfaces.visibility import (
    OVERLAP_DISTANCE,
    OWN_VEHICLE,
    SCORING_SAMPLE,
    SCORING_VOXEL,
    cells_of,
    compare_views,
    view_of,
)

PLACES = tuple(SURROUNDINGS)
NOISES = {"typical": TYPICAL, "field": FIELD}
MAX_DRAWS = 2000
"""Draws of an arrangement before a seed is given up."""

IN_THE_WAY, RELATIVE_IN_THE_WAY = 0.15, 0.02
"""A point stands in the way of the other LiDAR where it is this far, metres, and this part of its
range before what that saw: far beyond the noise of both."""


NOON, SWEEP, BETWEEN = 1.7e9, 0.1, 600.0
"""Unix time of a recording, how long it took, and how much later the other was made where something
happened in between, seconds."""

TALL, TALL_DISTANCE = 0.3, 0.3
"""Points from so high above the true ground are not on it, metres, and are near each other where
they are no farther apart."""


@dataclass(frozen=True)
class Scenery:
    """What the scene says of a pose, of several placements the worst: shares of the points.

    ``overlap`` of all points, ``covisible_overlap`` of those that both LiDARs could see, and
    ``violation`` are what hypotheses are scored by. ``in_the_way`` is the share of the ``common``
    points, in whose direction the other LiDAR has a return, that stand before what it saw. The same
    of the points that are not on the ground, which is known here: ``tall_in_the_way`` of
    ``tall_common``; ``tall_apart`` of them have no such point of the other cloud near. In a
    mirrored or scaled cloud the ground is not where it is looked for: there these say little.
    """

    overlap: float
    covisible_overlap: float
    violation: float
    in_the_way: float
    tall_in_the_way: float
    tall_apart: float
    common: int
    tall_common: int


@dataclass(frozen=True)
class Outcome:
    """What came of one draw, and the CPU seconds of its drawing and its calibration.

    ``returns`` are the least that a LiDAR has on a pole. Off by ``rotation``, rad, and
    ``translation``, m: infinite where no answer is right, nan without one. ``from_lie`` is the
    same, from the pose that the poles have as if they had stood: of the answer, or where it is
    refused of the nearest hypothesis. ``chi2`` is the squared Mahalanobis distance of the answer
    from the poles' own pose, ``probability`` what it states of being wrong.
    """

    kind: str
    seed: int
    scene: str
    noise: str
    sensors: tuple[str, str]
    returns: int
    status: str
    codes: tuple[str, ...]
    notes: tuple[str, ...]
    rotation: float
    translation: float
    from_lie: tuple[float, float] | None
    chi2: float | None
    margin: float | None
    probability: float | None
    scenery: Scenery | None
    seconds: tuple[float, float]

    @property
    def answered(self) -> bool:
        """Whether a pose is given."""
        return self.status != "refused"

    @property
    def wrong(self) -> bool:
        """Whether an answer is given that is too far from the truth."""
        far = self.rotation > WRONG_ANGLE or self.translation > WRONG_DISTANCE
        return self.answered and far

    @property
    def verdict(self) -> str:
        """Cell of the table in which the draw counts."""
        return f"{self.status} {'wrong' if self.wrong else 'right'}" if self.answered else "refused"


def draw(
    kind: Kind,
    scene: str,
    sensors: tuple[Sensor, Sensor],
    devices: tuple[Device, Device],
    rng: np.random.Generator,
) -> tuple[Site, Drawn] | None:
    """Draw a site and what is recorded there; None where nothing possible was drawn."""
    for _ in range(MAX_DRAWS):
        site = draw_site(scene, rng, kind.poles, kind.around)
        drawn = None if site is None else kind.draw(site, rng)
        if site is not None and drawn is not None:
            shots = [(k, pair[k]) for pair in drawn.shots for k in (0, 1)]
            if all(is_in_view(shot, sensors[k], devices[k], rng) for k, shot in shots):
                return site, drawn
    return None


def run(job: tuple[str, int], times: bool = False, poles: int | None = None) -> Outcome | None:
    """Draw, record and calibrate; with ``times`` of recording, which overlap where they may."""
    name, seed = job
    kind, start = KINDS[name], time.process_time()
    # Over 32 seeds every scene meets every pair of sensors with either noise.
    scene = kind.scene or PLACES[seed % 4]
    noise_name = tuple(NOISES)[(seed + seed // 4) % 2]
    noise = NOISES[noise_name]
    own = zip(SENSORS[(seed + seed // 8) % 4], DEFAULT_SENSORS[scene], strict=True)
    first, second = (find_sensor(given or usual) for given, usual in own)
    rng = np.random.default_rng([zlib.crc32(name.encode()), seed])
    *for_devices, for_recording = rng.spawn(3)
    devices = draw_device(first, noise, for_devices[0]), draw_device(second, noise, for_devices[1])
    found = draw(kind, scene, (first, second), devices, rng)
    if found is None:
        return None
    site, drawn = found
    recordings = [
        recorded(pair, site.clear, (first, second), devices, noise, for_recording)
        for pair in drawn.shots
    ]
    clouds = [both for both, _ in recordings]
    if times:
        later = 0.0 if kind.at_once else BETWEEN
        clouds = [(timed(target, 0.0), timed(source, later)) for target, source in clouds]
    ready = time.process_time()
    given = map(list, zip(*clouds, strict=True))
    answer = calibrate(*given, options=Options(sensors=(first, second), poles=poles))
    done = time.process_time()
    T = answer.T_target_source
    rotation, translation = np.nan, np.nan
    if T is not None:
        off = [se3.difference(T, truth) for truth in drawn.truths]
        rotation = max((each.rotation for each in off), default=np.inf)
        translation = max((each.translation for each in off), default=np.inf)
    poses = [(pair[0].poses[0], pair[1].poses[0]) for pair in drawn.shots]
    return Outcome(
        name,
        seed,
        scene,
        noise_name,
        (first.name, second.name),
        min(returns for _, returns in recordings),
        answer.status,
        tuple(reason.code for reason in answer.reasons),
        tuple(note.code for note in answer.notes),
        rotation,
        translation,
        None if drawn.lie is None else from_lie(answer, drawn.lie),
        chi2_of(answer),
        answer.margin,
        None if answer.confirmation is None else answer.confirmation.probability_wrong,
        None if T is None else scenery(clouds, poses, T),
        (ready - start, done - ready),
    )


def timed(cloud: PointCloud, after: float) -> PointCloud:
    """Say when a cloud was recorded: so many seconds after some time."""
    return replace(cloud, recorded=(NOON + after, NOON + after + SWEEP))


def from_lie(answer: Calibration, lie: Array) -> tuple[float, float] | None:
    T = answer.T_target_source
    poses = [h.match.T_target_source for h in answer.hypotheses] if T is None else [T]
    if not poses:
        return None
    rotation, translation = min((se3.difference(pose, lie) for pose in poses), key=sum)
    return rotation, translation


def chi2_of(answer: Calibration) -> float | None:
    if answer.T_target_source is None or answer.poles is None or answer.poles.covariance is None:
        return None
    step = se3.local(answer.poles.T_target_source, answer.T_target_source)
    return float(step @ np.linalg.solve(answer.poles.covariance, step))


def scenery(
    clouds: Sequence[tuple[PointCloud, PointCloud]], poses: Sequence[tuple[Array, Array]], T: Array
) -> Scenery:
    """Compare the clouds of every placement; ``poses`` are of the LiDARs in the world."""
    found = [one_scenery(*each, T) for each in zip(clouds, poses, strict=True)]
    least = {"overlap", "covisible_overlap", "common", "tall_common"}
    return Scenery(
        **{
            part.name: (min if part.name in least else max)(
                getattr(each, part.name) for each in found
            )
            for part in fields(Scenery)
        }
    )


def one_scenery(
    clouds: tuple[PointCloud, PointCloud], poses: tuple[Array, Array], T: Array
) -> Scenery:
    target, source = (view_of(cloud, SCORING_VOXEL, SCORING_SAMPLE) for cloud in clouds)
    agreed = compare_views(target, source, T, within=OVERLAP_DISTANCE)
    count = np.zeros(5, dtype=np.int64)
    for k, own, other, pose in ((1, source, target, T), (0, target, source, se3.inverse(T))):
        moved = se3.apply(pose, own.points)
        rays = moved - other.image.origin
        ranges, cells = np.linalg.norm(rays, axis=1), cells_of(rays)
        common = np.linalg.norm(own.points - own.image.origin, axis=1) > OWN_VEHICLE
        common &= other.image.nearest.seen[cells] & (ranges <= other.reach)
        margin = IN_THE_WAY + RELATIVE_IN_THE_WAY * ranges
        before = common & (other.image.nearest.ranges[cells] > ranges + margin)
        tall = common & is_tall(own.points, poses[k])
        theirs = np.asarray(other.tree.data)
        tree = cKDTree(theirs[is_tall(theirs, poses[1 - k])])
        apart = np.isinf(tree.query(moved, distance_upper_bound=TALL_DISTANCE)[0])
        groups = common, before, tall, tall & before, tall & apart
        count += [np.count_nonzero(group) for group in groups]
    shares = count[[1, 3, 4]] / np.maximum(count[[0, 2, 2]], 1)
    return Scenery(
        agreed.overlap,
        agreed.covisible_overlap,
        agreed.free_space_violation,
        *(float(share) for share in shares),
        common=int(count[0]),
        tall_common=int(count[2]),
    )


def is_tall(points: Array, pose: Array) -> BoolArray:
    """Which points (N, 3) of a LiDAR with a pose (4, 4) in the world are not on the ground."""
    return np.asarray(se3.apply(pose, points)[:, 2] > TALL)
