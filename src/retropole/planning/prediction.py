"""What poles determine of the poses, and the error to expect: by the code that states it
afterwards.

At the poses as they are known the returns of a pole have an information (`alignment.network`), with
its axis eliminated. Poles add up. An information is kept as its root, with the errors of the
LiDARs in units of what they are drawn to.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..adjustment.descent import RefinementProblem, ScenePair, minimise, scene_pairs
from ..adjustment.solved import parts_of
from ..alignment.adjustment import RADIUS_TOLERANCE
from ..alignment.certainty import budget_of, joint_covariance
from ..alignment.expansion import MAX_ROUNDS, WIDEST
from ..alignment.maximum import Sight
from ..alignment.network import Network, PoleFactor, bands_of, factor_of, observe
from ..alignment.observations import NEXT_TO_POLE, beams_of
from ..alignment.posterior import JointState, Posterior
from ..alignment.survey import Surveyed
from ..alignment.unknowns import POSE, Unknowns
from ..base.datatypes import DEFAULT_RADIUS, Array, BoolArray, IntArray, PointCloud, Pole
from ..base.se3 import joint_of, relative
from ..base.systematic import ErrorModel
from ..base.uncertainty import BudgetEntry
from ..extraction.sensor_pattern import error_sizes
from ..simulation.raycast import Cylinder
from ..simulation.recorded import DIVERGENCE, in_sensor_frame, range_noise
from ..surfaces.patches import surface_patches
from .place import Candidates, Station, beams_hit

LATERAL_NOISE = 0.3
"""Noise of returns sideways, as a part of that in depth: what simulated poles leave in the mean."""

LEAST = 0.01
"""What a pole shows of a direction counts from this part of what is known of it beforehand."""


TOGETHER, ROUNDS = 400, 5
"""Where many poles are compared: returns that are expanded at once, whose noise is found together,
and rounds of each view of the axes. Half of the errors of 200 random pairs are then within 0.4 % of
those of each pole by itself in 30 rounds, and all within 3.3 %; by the poles alone 0.9 % and 12 %
(a street and a kerb)."""


def divergences_of(stations: Sequence[Station]) -> list[float]:
    """Full angle of each LiDAR's beams, rad."""
    return [DIVERGENCE if s.sensor is None else s.sensor.divergence for s in stations]


def seen_by(station: Station, pole: Cylinder, divergence: float) -> tuple[Pole, PointCloud]:
    """Give the beams that a LiDAR would record of a pole in the frame of the scene.

    The returns on it, in the frame of the LiDAR, and the cloud around them.
    """
    (own,) = in_sensor_frame([pole], station.T)
    beams = station.beams
    hits = beams_hit(own, beams, divergence)
    # The same pole is recorded with the same noise: returns without any would be taken for exact.
    noise = range_noise(station.sensor) * np.random.default_rng(0).normal(size=len(hits.beam))
    xyz = (hits.ranges + noise)[:, None] * beams.directions[hits.beam]
    away = float(np.linalg.norm(own.centre))
    reach = min(own.bounding_radius + 3 * NEXT_TO_POLE, 0.99 * away)
    cone = np.sqrt(1 - (reach / away) ** 2)
    near = np.flatnonzero(beams.directions @ (own.centre / away) > cone)
    near = np.setdiff1d(near[np.isfinite(beams.ranges[near])], hits.beam)
    around = beams.ranges[near, None] * beams.directions[near]
    cloud = PointCloud(np.concatenate([xyz, around]), axis=station.cloud.axis)
    rings = len(np.unique(beams.rings[hits.beam]))
    index = np.arange(len(xyz))
    length = float(np.ptp(xyz @ own.axis)) if len(xyz) else 0.0
    found = Pole(xyz.mean(axis=0), own.axis, xyz, length, pole.radius / 2, rings, index)
    return found, cloud


def network_of(
    stations: Sequence[Station],
    candidates: Candidates,
    seen: BoolArray,
    placement: IntArray,
    scene_bands: Sequence[IntArray],
    quickly: bool = False,
) -> Network:
    """Expand what all LiDARs would record of some poles about the poses as they are known.

    Parameters
    ----------
    stations
        The LiDARs; the first one's pose is the datum.
    candidates, seen
        The poles, and (C, L) which LiDAR sees which.
    placement
        (C,) which each is in.
    scene_bands
        Bands of elevation that each LiDAR has other returns in.
    quickly
        As many poles are compared; see `TOGETHER`.
    """
    sweeps, rounds = (TOGETHER, ROUNDS) if quickly else (1, MAX_ROUNDS)
    widths = divergences_of(stations)
    sights = []
    for i, station in enumerate(stations):
        own = np.flatnonzero(seen[:, i])
        found = [seen_by(station, candidates.pole(k), widths[i]) for k in own.tolist()]
        returns = np.cumsum([len(pole.xyz) for pole, _ in found])
        for some in np.split(own, np.flatnonzero(np.diff(returns // sweeps)) + 1):
            first = int(np.searchsorted(own, some[0]))
            beams = beams_of(found[first : first + len(some)], station.sensor)
            sights.append(Sight(i, beams, some))
    noise = np.array([range_noise(s.sensor) for s in stations])
    log_noise = np.log(noise[:, None] * np.array([1.0, LATERAL_NOISE]))
    count = len(stations)
    state = JointState(
        np.stack([each.T for each in stations]),
        np.zeros(count),
        candidates.radius,
        candidates.centre,
        candidates.axis,
        np.zeros((0, 3)),
    )
    none = np.zeros((0, 0))
    at = Posterior(state, log_noise, 0.0, none[0:0], none, none, none, 0.0)
    free = np.repeat(np.arange(count) > 0, POSE)
    bands = bands_of(sights, scene_bands)
    return observe(at, sights, placement, Surveyed(), candidates.radius, bands, free, rounds)


def roots_of(network: Network, count: int, known: Array) -> list[tuple[IntArray, Array]]:
    """Eliminate the axis of each of `count` poles: root (P, R) of its information, and its place.

    Every pole has a separate placement in the network; `known` (K,) is the precision of all
    unknowns before.
    """
    kept = network.unknowns.kept
    own: list[list[int]] = [[] for _ in range(count)]
    for number, one in enumerate(network.observations):
        assert one.placement is not None
        own[one.placement].append(number)
    found = []
    for numbers in own:
        parts = [network.observations[number] for number in numbers]
        place = np.unique(np.concatenate([one.place for one in parts]))
        information = np.zeros((len(place),) * 2)
        for one in parts:
            at = np.searchsorted(place, one.place)
            information[np.ix_(at, at)] += one.information
        shared = int(np.searchsorted(place, kept))
        axis = information[shared:, shared:] + np.eye(len(place) - shared) * WIDEST**-2
        gone = np.linalg.solve(axis, information[shared:, :shared])
        left = information[:shared, :shared] - information[:shared, shared:] @ gone
        scale = np.sqrt(known[place[:shared]])
        size, way = np.linalg.eigh(left / np.outer(scale, scale))
        large = size > LEAST
        root = scale[:, None] * way[:, large] * np.sqrt(size[large])
        found.append((place[:shared], root))
    return found


def prior_of(unknowns: Unknowns, known: Array) -> Array:
    """(E,) precision of the errors, counted whole as in what is stated; `known` is 1 σ of groups.

    What is considered and not estimated (`error_sizes.CONSIDERED`) is treated as if it were
    estimated.
    """
    return np.asarray(known[unknowns.groups().label] ** -2.0)


ROUGH_SIGMA = np.radians(2.0), 0.3
"""1 σ of a pose that the surroundings gave, before the surfaces refine it, rad and m."""


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Information of the scene without poles about the poses, and the errors of the LiDARs.

    Attributes
    ----------
    scenes
        Surfaces that every two LiDARs share.
    bands
        For each LiDAR, the bands of elevation that its surfaces lie in.
    """

    scenes: tuple[ScenePair, ...]
    bands: tuple[IntArray, ...]


def surfaces_of(stations: Sequence[Station]) -> Surfaces:
    """Find the surfaces that the LiDARs share."""
    patches = [surface_patches(each.cloud) for each in stations]
    return Surfaces(
        tuple(scene_pairs(patches, range(len(stations)))),
        tuple(np.unique(each.bands) for each in patches),
    )


def model_of(stations: Sequence[Station], radius: float = DEFAULT_RADIUS) -> ErrorModel:
    """Sizes of the errors of all LiDARs, and of the radius, as a calibration takes them."""
    sizes = tuple(error_sizes(each.cloud, each.sensor) for each in stations)
    return ErrorModel(sizes, RADIUS_TOLERANCE * radius)


def known_poses(stations: Sequence[Station], bands: Sequence[IntArray]) -> PoleFactor:
    """State the poses as they are known, instead of poles: `ROUGH_SIGMA`; nothing of the errors."""
    unknowns = Unknowns(tuple(bands), 0, 0)
    information = np.zeros((unknowns.kept, unknowns.kept))
    own = np.arange(POSE, unknowns.poses)
    information[own, own] = np.tile(np.repeat(ROUGH_SIGMA, 3) ** -2.0, len(stations) - 1)
    free = np.repeat(np.arange(len(stations)) > 0, POSE)
    T = np.stack([each.T for each in stations])
    nothing = np.zeros(unknowns.kept)
    return PoleFactor(T, unknowns, free, information, nothing, np.inf, nothing[:, None])


def refined(stations: Sequence[Station], surfaces: Surfaces) -> list[Station]:
    """Refine the poses on the surfaces that the LiDARs share; the first one's stays."""
    factor = known_poses(stations, surfaces.bands)
    end = minimise(problem_of(factor, stations, surfaces))
    return [replace(each, T=T) for each, T in zip(stations, end.T, strict=True)]


def problem_of(
    factor: PoleFactor, stations: Sequence[Station], surfaces: Surfaces, radius: float = 0.02
) -> RefinementProblem:
    """Combine poles and surfaces, as in a calibration."""
    factor = factor.with_bands(surfaces.bands)
    groups = factor.unknowns.groups()
    return RefinementProblem(
        factor, surfaces.scenes, groups, model_of(stations, radius).sigmas(groups)
    )


def scene_information(stations: Sequence[Station], surfaces: Surfaces, unknowns: Unknowns) -> Array:
    """(K, K) information of the surfaces about poses and errors, for poses that are refined."""
    end = minimise(problem_of(known_poses(stations, unknowns.bands), stations, surfaces))
    information = np.zeros((unknowns.kept, unknowns.kept))
    for term in end.scene:
        information[np.ix_(term.place, term.place)] += term.information
    return information


@dataclass(frozen=True, eq=False)
class Prediction:
    """The error to expect of each LiDAR's pose in the frame of the first.

    Attributes
    ----------
    covariance
        For each LiDAR but the first (6, 6) over ``[φ, δ]``, rad and m, axes of the first.
    budget
        For each of these what it is made of, the largest first.
    """

    covariance: tuple[Array, ...]
    budget: tuple[tuple[BudgetEntry, ...], ...]


def predict(
    stations: Sequence[Station],
    surfaces: Surfaces,
    poles: Candidates,
    seen: BoolArray,
    placement: IntArray,
) -> tuple[Prediction, Prediction]:
    """Predict what a calibration will state.

    Parameters
    ----------
    stations, surfaces
        The LiDARs, their poses refined, and what they share.
    poles, seen, placement
        Those of the plan, (K, L) which LiDAR sees which, (K,) which placement each is in.

    Returns
    -------
    Prediction, Prediction
        With the surfaces, and by the poles alone.
    """
    network = network_of(stations, poles, seen, placement, surfaces.bands)
    factor = factor_of(network, ridge=1e-6)
    names = [each.name for each in stations] if len(stations) > 2 else None

    def predicted_by(asked: Surfaces) -> Prediction:
        problem = problem_of(factor, stations, asked, poles.radius)
        end = minimise(problem)
        parts = parts_of(problem, end)
        covariance = joint_covariance(parts)
        others = range(1, len(stations))
        return Prediction(
            tuple(
                relative(end.T[0], end.T[i], joint_of(covariance, 0, i)).covariance for i in others
            ),
            tuple(budget_of(parts, i, names) for i in others),
        )

    return predicted_by(surfaces), predicted_by(Surfaces((), surfaces.bands))
