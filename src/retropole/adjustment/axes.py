"""The axes of poles as one LiDAR alone has them, and how certain each is: no other LiDAR comes in.

The beam model of `alignment`, with one LiDAR and no pose. A line fitted to the returns would run in
front of the axis, towards the LiDAR, and so for each LiDAR on another side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..alignment.adjustment import RADIUS_TOLERANCE
from ..alignment.certainty import prior_precision
from ..alignment.expansion import average_lidar, expand_lidar, find_view, semidefinite
from ..alignment.maximum import JointPriors, Sight, evaluate_joint, lines_of, maximise, start_noise
from ..alignment.observations import Beams, beams_of
from ..alignment.posterior import SHARED, JointState, Posterior, State
from ..alignment.survey import NOTHING_SURVEYED
from ..alignment.unknowns import POSE, Unknowns
from ..base.datatypes import Array, IntArray, PointCloud, Pole
from ..base.sensors import Sensor
from ..base.systematic import ErrorModel, Layout, band_of, sizes_of

FLOOR_POINT, FLOOR_LEAN = 0.002, 0.001
"""1 σ of an axis across itself and of its direction that are not modelled, metres and rad: glow
around tape, edges of the beam, poles that are not straight. Of simulated LiDARs with field errors,
67 pairs of one sweep (seeds 0 to 71) and 40 of five (0 to 47), 9 % and 8 % failed the test of
`certification` without it, and 3 % and none with it, where 5 % are meant to."""


@dataclass(frozen=True, eq=False)
class LidarAxes:
    """Axes of K poles in the frame of the LiDAR that saw them, and how certain they are.

    Steps of an axis are those of `alignment.posterior.State`: two of its point across it, metres,
    then two of its direction, rad.

    Attributes
    ----------
    state
        The axes; its pose and its offsets are none.
    noise
        (2,) 1 σ of the returns, along the beam and across it, metres.
    random
        (4 K, 4 K) covariance from the scatter of the returns (type A of the GUM, JCGM 100).
    systematic
        (4 K, B) how far 1 σ of each systematic error of the LiDAR moves the axes, and what no model
        names of each axis (type B).
    radius
        (4 K,) how far 1 σ of the poles' radius moves them: the same poles for another LiDAR.
    """

    state: State
    noise: Array
    random: Array
    systematic: Array
    radius: Array


def find_axes(
    seen: Sequence[tuple[Pole, PointCloud]],
    *,
    sensor: Sensor | None,
    radius: float,
    radius_sigma: float,
) -> LidarAxes:
    """Find the axes of the poles that one LiDAR saw, in one or several placements.

    Parameters
    ----------
    seen
        Its poles, each with the cloud that it was found in; all clouds share the beam origin.
    sensor
        What it is, and so the sizes of its errors; None if not known.
    radius, radius_sigma
        Of the poles, and its 1 σ, metres: at least the fraction `RADIUS_TOLERANCE`.
    """
    beams = beams_of(seen, sensor)
    state, noise = maximise_from_lines(beams, radius)
    view = find_view(state, 1, beams, noise)
    # As the source of a pair whose target has no returns.
    nobody: IntArray = np.zeros(0, dtype=np.int64)
    unknowns = Unknowns((np.unique(band_of(beams.directions, beams.axis)),), 0, 0)
    layout = Layout((nobody, unknowns.bands[0]))
    averages = average_lidar(state, 1, beams, view)
    information, gradient, _ = expand_lidar(state, 1, beams, averages, layout)
    place = unknowns.of_layout(layout, (None, 0))
    errors = np.argsort(place)[np.count_nonzero(place < 0) :]
    kept = POSE + np.r_[errors, np.arange(len(place), len(gradient) - POSE)]
    information = semidefinite(information[np.ix_(kept, kept)], lambda size: np.maximum(size, 0.0))
    groups, count = unknowns.groups(), unknowns.errors
    model = ErrorModel((sizes_of(sensor),), max(radius_sigma, RADIUS_TOLERANCE * radius))
    sigma = model.sigmas(groups)
    precision = prior_precision(groups, sigma)
    whole = information.copy()
    whole[np.arange(count), np.arange(count)] += precision
    # Axes and errors together: what the returns show of an error is removed from the axes.
    rows = np.linalg.inv(whole)[count:]
    step = np.r_[np.zeros(SHARED), rows @ gradient[kept]]
    passed = rows[:, :count] * precision * sigma[groups.label]
    of_radius = passed[:, -1].copy()
    passed[:, -1] = 0.0
    floor = np.diag(np.tile([FLOOR_POINT, FLOOR_POINT, FLOOR_LEAN, FLOOR_LEAN], len(seen)))
    return LidarAxes(
        state.moved(step),
        noise,
        np.asarray(rows @ information @ rows.T),
        np.hstack([passed, floor]),
        of_radius,
    )


def maximise_from_lines(
    beams: Beams, radius: float, log_noise: Array | None = None
) -> tuple[State, Array]:
    """Find the maximum from lines fitted to the returns.

    Parameters
    ----------
    beams
        Of the LiDAR.
    radius
        Of the poles, metres.
    log_noise
        As there; None is what the lines leave.
    """
    start = State(np.eye(4), np.zeros(2), radius, *lines_of(beams, radius))
    by_lines = np.full(2, start_noise(start, 1, beams))
    return maximise_alone(start, beams, by_lines if log_noise is None else log_noise)


def maximise_alone(state: State, beams: Beams, log_noise: Array) -> tuple[State, Array]:
    """Let axes go to where one LiDAR's returns have them, and their noise with them.

    Parameters
    ----------
    state
        The start; nothing but its axes moves.
    beams
        Of the LiDAR.
    log_noise
        (2,) logarithm of the noise, in depth and sideways, metres, to start from.

    Returns
    -------
    state, noise
        There, and the noise (2,), metres.
    """
    own = np.arange(len(state.points))
    joint = JointState(
        np.eye(4)[None],
        state.offsets[1:],
        state.radius,
        state.points,
        state.directions,
        np.zeros((0, 3)),
    )
    sights, constrained = [Sight(0, beams, own)], np.zeros(POSE, dtype=bool)
    priors = JointPriors(joint.T, np.zeros(1), state.radius, 0.0, constrained)

    def at(state: JointState, log_noise: Array) -> Posterior[JointState]:
        return evaluate_joint(state, log_noise, sights, NOTHING_SURVEYED, priors)

    found = maximise(joint, log_noise[None], at)
    return found.point.state.of(0, own), np.exp(found.point.log_noise[0])
