"""Information of poles and survey about all unknowns of a site: a quadratic form per observation.

About the maximum of the posterior each observation s (a LiDAR's returns in one placement, a
surveyed end of a pole, a sight of a control point) says

    log L_s = g_sᵀ (z − z₀) − ½ (z − z₀)ᵀ N_s (z − z₀)

with z the unknowns of `unknowns`: poses and axes as steps from that maximum, errors as they are.
The observations stay separate, so that each can be tested against all others.

The sum over all observations is a `PoleFactor`. Near the maximum of the posterior the returns on
the poles show

    −log L(x, b) = ½ zᵀ Λ z − ηᵀ z,    z = [x, b],

with x the steps of all poses and b the errors of `systematic`; the axes of the poles are
eliminated (Schur complement). The prior of b is not included, so that the scene can share b. Of a
pair the target's pose is the identity and fixed: it is the frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from scipy.linalg import block_diag

from ..base import se3
from ..base.datatypes import Array, BoolArray, IntArray, PoseEstimate
from ..base.systematic import TAPE, Layout, band_of
from .expansion import MAX_ROUNDS, Average, average_lidar, expand_lidar, find_view, semidefinite
from .maximum import Sight
from .posterior import JointState, Posterior
from .survey import Surveyed, survey_terms
from .unknowns import POSE, Unknowns

OF_SOURCE = np.repeat([False, True], POSE)
"""(12,) which parameters of both poses of a pair are estimated."""


@dataclass(frozen=True, eq=False)
class PoleFactor:
    """Quadratic form of all poses and errors that the poles' returns, and a survey, give.

    Attributes
    ----------
    T
        (L, 4, 4) the poses that the steps x start from.
    unknowns
        Order of poses and errors, K in all.
    free
        (6 L,) which parameters of the poses are estimated; the others are the datum.
    information, vector
        (K, K) Λ and (K,) η.
    redundancy
        Returns more than parameters: the degrees of freedom of their noise; infinite where a
        covariance is given.
    depth
        (K, R) how η moves with each error of the depth of a pole, by its 1 σ (`network`).
    left
        (L, 6, 6) covariance of how far each LiDAR's recordings are from where it rests, over
        rotation and translation, in its axes; empty if none sways.
    """

    T: Array
    unknowns: Unknowns
    free: BoolArray
    information: Array
    vector: Array
    redundancy: float
    depth: Array
    left: Array = field(default_factory=lambda: np.zeros((0, POSE, POSE)))

    def weakened(self, share: float) -> PoleFactor:
        """Give the same with a part of its information."""
        return replace(
            self,
            information=share * self.information,
            vector=share * self.vector,
            depth=np.sqrt(share) * self.depth,
        )

    def with_bands(self, bands: Sequence[IntArray]) -> PoleFactor:
        """Give the same with more bands of elevation of each LiDAR."""
        own = self.unknowns
        unknowns = own.with_bands(bands)
        place = own.places_in(unknowns)
        information, vector = np.zeros((unknowns.kept, unknowns.kept)), np.zeros(unknowns.kept)
        information[np.ix_(place, place)] = self.information
        vector[place] = self.vector
        depth = np.zeros((unknowns.kept, self.depth.shape[1]))
        depth[place] = self.depth
        return replace(self, unknowns=unknowns, information=information, vector=vector, depth=depth)

    def without_bands(self) -> PoleFactor:
        """Give the same as if the errors of single rings were zero."""
        unknowns = Unknowns(tuple(bands[:0] for bands in self.unknowns.bands), 0, 0)
        place = unknowns.places_in(self.unknowns)
        information = self.information[np.ix_(place, place)]
        return replace(
            self,
            unknowns=unknowns,
            information=information,
            vector=self.vector[place],
            depth=self.depth[place],
        )

    def about(self, T: Array) -> PoleFactor:
        """Give the same in steps from other poses (L, 4, 4)."""
        here, by_step = steps_to(self.T, T)
        poses = slice(self.unknowns.poses)
        vector = self.vector - self.information[:, poses] @ here
        vector[poses] = by_step.T @ vector[poses]
        depth = self.depth.copy()
        depth[poses] = by_step.T @ depth[poses]
        information = self.information.copy()
        information[poses] = by_step.T @ information[poses]
        information[:, poses] = information[:, poses] @ by_step
        return replace(self, T=T, information=information, vector=vector, depth=depth)

    @property
    def estimated(self) -> IntArray:
        """Which of the unknowns are estimated: all but the datum."""
        return np.flatnonzero(np.r_[self.free, np.ones(self.unknowns.errors, dtype=bool)])


def steps_to(start: Array, T: Array) -> tuple[Array, Array]:
    """Give the steps (6 L,) from some poses to others, (L, 4, 4) each.

    The second (6 L, 6 L) is their derivative by steps from the others.
    """
    steps = se3.local(start, T)
    return steps.reshape(-1), block_diag(*se3.local_jacobian(steps))


def poses_of_pair(T_target_source: Array) -> Array:
    """(2, 4, 4) poses of both LiDARs of a pair: the target's is the frame."""
    return np.stack([np.eye(4), T_target_source])


def gaussian_factor(pose: PoseEstimate) -> PoleFactor:
    """Give the quadratic form of a pose with a covariance, which gives no information about the
    errors."""
    assert pose.covariance is not None
    return gaussian_factor_of(poses_of_pair(pose.T_target_source), pose.covariance, OF_SOURCE)


def gaussian_factor_of(T: Array, covariance: Array, free: BoolArray) -> PoleFactor:
    """Give the same of poses (L, 4, 4) with a covariance (F, F) of those parameters that are free.

    `free` is (6 L,).
    """
    unknowns = Unknowns(len(T) * (np.zeros(0, dtype=np.int64),), 0, 0)
    information = np.zeros((unknowns.kept, unknowns.kept))
    own = np.flatnonzero(free)
    information[np.ix_(own, own)] = np.linalg.inv(covariance)
    nothing = np.zeros(unknowns.kept)
    return PoleFactor(T, unknowns, free, information, nothing, np.inf, nothing[:, None])


DEPTH_SIGMA = 0.0015
"""1 σ of the depth that all returns of one LiDAR on one pole err by, metres: which part of a beam
that touches an edge returns, and how tape shines, is not known better. However many returns there
are, it stays. At the true poses of recordings with all errors of a field the depth of poles was off
by 1.8 mm RMS where 0.4 was stated of a thousand returns."""


@dataclass(frozen=True, eq=False)
class Observation:
    """Information of one observation about some unknowns.

    Attributes
    ----------
    kind, name
        ``returns`` of a LiDAR in a placement, which have no name, or as in `survey.SurveyTerm`.
    place
        (P,) which unknowns.
    information, gradient
        (P, P) and (P,) of the logarithm of the likelihood at the start.
    lidar, placement
        Whose, and where; None if it is the surveyor's.
    poles
        (K,) the axes that are among the unknowns, in their order; the last entries of `place`.
    returns
        Number of returns on the poles.
    share
        (K,) what part of those that were found on each that is.
    depth
        (P, K) how the gradient moves with the error of the depth of each, by its 1 σ.
    by_value
        Of a single measurement its derivative (M, P) over its 1 σ, its residual (M,) likewise, and
        that 1 σ, metres or rad; None of returns.
    """

    kind: Literal["returns", "survey", "control point", "up", "pose", "side"]
    name: str
    place: IntArray
    information: Array
    gradient: Array
    lidar: int | None = None
    placement: int | None = None
    poles: IntArray | None = None
    returns: float = 0.0
    share: Array | None = None
    depth: Array | None = None
    by_value: tuple[Array, Array, float] | None = None


@dataclass(frozen=True, eq=False)
class Network:
    """All observations but those of the scene.

    Attributes
    ----------
    unknowns
        Their order.
    state
        Where the steps of poses, axes and control points start.
    start
        (Z,) the unknowns there: all zero but for the errors that the state already has.
    observations
        Each with its quadratic form.
    free
        (6 L,) which parameters of the poses are estimated; the others are the datum.
    """

    unknowns: Unknowns
    state: JointState
    start: Array
    observations: tuple[Observation, ...]
    free: BoolArray

    @property
    def redundancy(self) -> float:
        """Returns more than parameters of axes and poses: the freedom of their noise."""
        returns = sum(each.returns for each in self.observations)
        return max(returns - float(self.free.sum()) - 4.0 * self.unknowns.axes, 1.0)

    def total(self) -> tuple[Array, Array]:
        """Information (Z, Z) and gradient (Z,) of all observations at the start."""
        size = self.unknowns.size
        information, gradient = np.zeros((size, size)), np.zeros(size)
        for each in self.observations:
            information[np.ix_(each.place, each.place)] += each.information
            gradient[each.place] += each.gradient
        return information, gradient

    @property
    def depth(self) -> Array:
        """(Z, R) how the gradient moves with each error of the depth of a pole, by its 1 σ."""
        found = [np.zeros((self.unknowns.size, 0))]
        for one in self.observations:
            if one.depth is not None:
                column = np.zeros((self.unknowns.size, one.depth.shape[1]))
                column[one.place] = one.depth
                found.append(column)
        return np.concatenate(found, axis=1)

    def of_lidar(self, lidar: int) -> Network:
        """Give the information from one LiDAR's returns."""
        kept = tuple(
            one for one in self.observations if one.lidar == lidar and one.poles is not None
        )
        return replace(self, observations=kept)

    def with_bands(self, bands: Sequence[IntArray]) -> Network:
        """Give the same with more bands of elevation of each LiDAR."""
        own = self.unknowns
        unknowns = own.with_bands(bands)
        behind = np.arange(own.kept, own.size) + unknowns.kept - own.kept
        place = np.r_[own.places_in(unknowns), behind]
        start = np.zeros(unknowns.size)
        start[place] = self.start
        return replace(
            self,
            unknowns=unknowns,
            start=start,
            observations=tuple(replace(one, place=place[one.place]) for one in self.observations),
        )

    def without(self, left_out: set[int]) -> Network:
        """Give the same without some observations."""
        kept = tuple(one for k, one in enumerate(self.observations) if k not in left_out)
        return replace(self, observations=kept)


def bands_of(sights: Sequence[Sight], scene_bands: Sequence[IntArray]) -> tuple[IntArray, ...]:
    """Combine the bands of elevation of each LiDAR's returns on poles and on surfaces."""
    found = list(scene_bands)
    for sight in sights:
        own = band_of(sight.beams.directions, sight.beams.axis)
        found[sight.lidar] = np.union1d(found[sight.lidar], own).astype(np.int64)
    return tuple(found)


def observe(
    end: Posterior[JointState],
    sights: Sequence[Sight],
    placement: IntArray,
    surveyed: Surveyed,
    radius: float,
    bands: tuple[IntArray, ...],
    free: BoolArray,
    rounds: int = MAX_ROUNDS,
) -> Network:
    """Expand every observation about the maximum of the posterior.

    Parameters
    ----------
    end
        The maximum.
    sights, surveyed
        What was seen of the poles, and what else is known.
    placement
        (K,) index of that of each pole.
    radius
        Of the poles as it was given, metres.
    bands
        From `bands_of`.
    free
        (6 L,) which parameters of the poses are estimated.
    rounds
        At most this many for the view of the axes by each LiDAR (`find_view`).
    """
    state = end.state
    unknowns = Unknowns(bands, len(placement), len(state.control))
    start = np.zeros(unknowns.size)
    start[unknowns.radius] = state.radius - radius
    for lidar in range(unknowns.lidars):
        start[unknowns.device(lidar)[TAPE]] = state.offsets[lidar]
    found: list[Observation] = []
    for sight in sights:
        noise = np.exp(end.log_noise[sight.lidar])
        at = state.of(sight.lidar, sight.own)
        view = find_view(at, 1, sight.beams, noise, rounds)
        averages = average_lidar(at, 1, sight.beams, view)
        own = placement[sight.own]
        for p in np.unique(own):
            some = np.flatnonzero(own == p)
            found.append(_returns(state, sight, some, averages, int(p), unknowns))
    for term in survey_terms(state, surveyed):
        J, residual = term.jacobian / term.sigma[:, None], term.residual / term.sigma
        found.append(
            Observation(
                term.kind,
                term.name,
                _of_unknowns(term.place, state, unknowns),
                J.T @ J,
                -J.T @ residual,
                lidar=term.lidar,
                by_value=(J, residual, float(term.sigma[0])),
            )
        )
    return Network(unknowns, state, start, tuple(found), free)


def _returns(
    state: JointState,
    sight: Sight,
    some: IntArray,
    averages: tuple[Average, Average],
    placement: int,
    unknowns: Unknowns,
) -> Observation:
    """Expand a LiDAR's returns in one placement: on some of its poles."""
    beams, own = sight.beams.of_poles(some), sight.own[some]
    on, passed = averages
    part = (
        on.part(np.isin(sight.beams.pole, some)),
        passed.part(np.isin(sight.beams.passed_pole, some)),
    )
    # The site is the target of a pair that has no returns.
    none = np.zeros(0, dtype=np.int64)
    layout = Layout((none, np.unique(band_of(beams.directions, beams.axis))))
    information, gradient, inliers = expand_lidar(
        state.of(sight.lidar, own), 1, beams, part, layout
    )
    # Where one recording alone curves upwards, others hold the answer against its slope: without
    # any information there, the test of it would be as large as rounding is small.
    information = semidefinite(information, np.abs)
    information, gradient, depth = _with_depth(information, gradient, state, sight.lidar, own)
    errors = unknowns.of_layout(layout, (None, sight.lidar))
    place = np.r_[unknowns.pose(sight.lidar), errors, unknowns.axis(own)]
    kept = np.flatnonzero(place >= 0)
    return Observation(
        "returns",
        "",
        place[kept],
        information[np.ix_(kept, kept)],
        gradient[kept],
        sight.lidar,
        placement,
        own,
        float(inliers.sum()),
        inliers / np.bincount(beams.pole, minlength=len(own)),
        depth[kept],
    )


def _with_depth(
    information: Array, gradient: Array, state: JointState, lidar: int, own: IntArray
) -> tuple[Array, Array, Array]:
    """Add an error of a LiDAR in the depth of each pole, by `DEPTH_SIGMA`: that error is
    eliminated.

    With ``N, g`` what the returns show as if it were zero, ``E`` its derivative and ``D`` its
    variance, ``N' = N − N E (D⁻¹ + Eᵀ N E)⁻¹ Eᵀ N``; an error of 1 σ moves ``g'`` by
    ``N E (D⁻¹ + Eᵀ N E)⁻¹ D^(−½)``.
    """
    some = state.of(lidar, own)
    ray = some.points - state.T[lidar][:3, 3]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    along = np.zeros((len(gradient), len(own)))
    for k in range(len(own)):
        first = len(gradient) - 4 * (len(own) - k)
        along[first : first + 2, k] = some.tangents[k].T @ ray[k]
    moved = information @ along
    inner = np.linalg.inv(np.eye(len(own)) / DEPTH_SIGMA**2 + along.T @ moved)
    by = moved @ inner
    return information - by @ moved.T, gradient - by @ (along.T @ gradient), by / DEPTH_SIGMA


def _of_unknowns(place: IntArray, state: JointState, unknowns: Unknowns) -> IntArray:
    """Indices of parameters of a step of the state among the unknowns: poses, axes and points."""
    behind = unknowns.kept - state.first_axis
    return np.asarray(np.where(place < POSE * len(state.T), place, place + behind))


def about(network: Network, T: Array) -> Network:
    """Express the same observations in steps from other poses, as the scene's terms are.

    Parameters
    ----------
    network
        The observations.
    T
        (L, 4, 4) the poses.
    """
    unknowns = network.unknowns
    others = unknowns.size - unknowns.poses
    away_by_pose, by_pose = steps_to(network.state.T, T)
    here, by_step = np.r_[away_by_pose, np.zeros(others)], block_diag(by_pose, np.eye(others))

    def moved(one: Observation) -> Observation:
        J, away = by_step[np.ix_(one.place, one.place)], here[one.place]
        value = one.by_value
        if value is not None:
            value = (value[0] @ J, value[1] + value[0] @ away, value[2])
        return replace(
            one,
            information=J.T @ one.information @ J,
            gradient=J.T @ (one.gradient - one.information @ away),
            depth=None if one.depth is None else J.T @ one.depth,
            by_value=value,
        )

    observations = tuple(moved(one) for one in network.observations)
    return replace(network, state=replace(network.state, T=T), observations=observations)


def factor_of(network: Network, ridge: float = 0.0, left: Sequence[Array] = ()) -> PoleFactor:
    """Eliminate axes and control points: information of poles and survey about poses and errors.

    Parameters
    ----------
    network
        The observations.
    ridge
        Precision of axes and points with little or no information, such as an axis of which only
        one end was surveyed.
    left
        What is left of the sway of each LiDAR; see `PoleFactor`.
    """
    information, gradient = network.total()
    unknowns = network.unknowns
    if ridge:
        parts = [unknowns.axis(np.array([k])) for k in range(unknowns.axes)]
        parts += [unknowns.control_point(q) for q in range(unknowns.control)]
        for own in parts:
            if np.linalg.matrix_rank(information[np.ix_(own, own)], hermitian=True) < len(own):
                information[own, own] += ridge
    kept, gone = slice(0, unknowns.kept), slice(unknowns.kept, None)
    eliminated = np.linalg.solve(information[gone, gone], information[gone, kept])
    reduced = information[kept, kept] - information[kept, gone] @ eliminated
    vector = gradient[kept] - eliminated.T @ gradient[gone]
    depth = network.depth
    return PoleFactor(
        network.state.T,
        replace(unknowns, axes=0, control=0),
        network.free,
        (reduced + reduced.T) / 2,
        np.asarray(vector + reduced @ network.start[kept]),
        network.redundancy,
        depth[kept] - eliminated.T @ depth[gone],
        np.array(left),
    )
