"""The error to expect of poles that stand so: by the code that states it afterwards."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..adjustment.descent import RefinementProblem, ScenePair, minimise, scene_pairs
from ..adjustment.places import parts_of
from ..alignment.adjustment import RADIUS_TOLERANCE
from ..alignment.certainty import budget_of, joint_covariance
from ..alignment.network import PoleFactor, factor_of
from ..alignment.unknowns import POSE, Unknowns
from ..base.datatypes import DEFAULT_RADIUS, Array, BoolArray, IntArray
from ..base.se3 import joint_of, relative
from ..base.systematic import ErrorModel
from ..base.uncertainty import BudgetEntry
from ..extraction.sensor_pattern import error_sizes
from ..surfaces.patches import surface_patches
from .candidates import Candidates
from .information import network_of
from .place import Station

KNOWN = np.radians(2.0), 0.3
"""1 σ of a pose that the place gave, before the surfaces settle it, rad and m."""


@dataclass(frozen=True, eq=False)
class Surfaces:
    """What the place without poles says of the poses, and of the errors of the LiDARs.

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
    """State the poses as they are known, instead of poles: `KNOWN`, and nothing of the errors."""
    unknowns = Unknowns(tuple(bands), 0, 0)
    information = np.zeros((unknowns.kept, unknowns.kept))
    own = np.arange(POSE, unknowns.poses)
    information[own, own] = np.tile(np.repeat(KNOWN, 3) ** -2.0, len(stations) - 1)
    free = np.repeat(np.arange(len(stations)) > 0, POSE)
    T = np.stack([each.T for each in stations])
    nothing = np.zeros(unknowns.kept)
    return PoleFactor(T, unknowns, free, information, nothing, np.inf, nothing[:, None])


def settled(stations: Sequence[Station], surfaces: Surfaces) -> list[Station]:
    """Settle the poses on the surfaces that the LiDARs share; the first one's stays."""
    factor = known_poses(stations, surfaces.bands)
    end = minimise(problem_of(factor, stations, surfaces))
    return [replace(each, T=T) for each, T in zip(stations, end.T, strict=True)]


def problem_of(
    factor: PoleFactor, stations: Sequence[Station], surfaces: Surfaces, radius: float = 0.02
) -> RefinementProblem:
    """Put poles and surfaces together, as a calibration does."""
    factor = factor.with_bands(surfaces.bands)
    groups = factor.unknowns.groups()
    return RefinementProblem(
        factor, surfaces.scenes, groups, model_of(stations, radius).sigmas(groups)
    )


def scene_information(stations: Sequence[Station], surfaces: Surfaces, unknowns: Unknowns) -> Array:
    """(K, K) what the surfaces say of poses and errors where the LiDARs are settled."""
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
        The LiDARs, settled, and what they share.
    poles, seen, placement
        Those that will stand, (K, L) which LiDAR sees which, (K,) which placement each stands in.

    Returns
    -------
    Prediction, Prediction
        With the surfaces, and by the poles alone.
    """
    network = network_of(stations, poles, seen, placement, surfaces.bands)
    factor = factor_of(network, ridge=1e-6)
    names = [each.name for each in stations] if len(stations) > 2 else None

    def ask(asked: Surfaces) -> Prediction:
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

    return ask(surfaces), ask(Surfaces((), surfaces.bands))
