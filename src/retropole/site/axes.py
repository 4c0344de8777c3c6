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
from ..alignment.climb import (
    MAX_POLE_ITERATIONS,
    NOISE_DAMPING,
    POLE_GAIN,
    POLE_SLACK,
    POLE_STEP,
    start_of,
)
from ..alignment.expansion import expand_lidar, semidefinite
from ..alignment.observations import Beams, beams_of
from ..alignment.posterior import SHARED, Posterior, Priors, State, evaluate
from ..alignment.solver import levenberg_marquardt
from ..alignment.unknowns import POSE, Unknowns
from ..alignment.views import MAX_LATERAL_NOISE, MIN_LATERAL_NOISE, MIN_NOISE, find_view
from ..base.datatypes import Array, IntArray, PointCloud, Pole
from ..base.sensors import Sensor
from ..base.systematic import RADIUS, ErrorModel, Layout, band_of, sizes_of

FLOOR_POINT, FLOOR_LEAN = 0.002, 0.001
"""1 σ of an axis across itself and of its direction that no model names, metres and rad: glow
around tape, edges of the beam, poles that are not straight. Of simulated LiDARs with field errors,
67 pairs of one sweep (seeds 0 to 71) and 40 of five (0 to 47), 9 % and 8 % failed the test of
`certification` without it, and 3 % and none with it, where 5 % are meant to."""


@dataclass(frozen=True, eq=False)
class OwnAxes:
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
) -> OwnAxes:
    """Find the axes of the poles that one LiDAR saw, in one or several placements.

    Parameters
    ----------
    seen
        Its poles, each with the cloud that it was found in; all clouds share the beam origin.
    sensor
        What it is, and so the sizes of its errors; None where not known.
    radius, radius_sigma
        Of the poles, and its 1 σ, metres: at least `RADIUS_TOLERANCE` of it.
    """
    beams = beams_of(seen, sensor)
    state, noise = climb_from_lines(beams, radius)
    view = find_view(state, 0, beams, noise)
    nobody: IntArray = np.zeros(0, dtype=np.int64)
    layout = Layout((np.unique(band_of(beams.directions, beams.axis)), nobody))
    information, gradient, _ = expand_lidar(state, 0, beams, view, layout)
    information = semidefinite(information, lambda size: np.maximum(size, 0.0))[POSE:, POSE:]
    unknowns, sizes = Unknowns(layout.bands, 0, 0), sizes_of(sensor)
    groups, order = unknowns.groups(), unknowns.of_layout(layout, (0, 1)) - unknowns.poses
    model = ErrorModel((sizes, sizes), max(radius_sigma, RADIUS_TOLERANCE * radius))
    sigma = model.sigmas(groups)
    precision = prior_precision(groups, sigma)[order]
    errors = len(precision)
    whole = information.copy()
    whole[np.arange(errors), np.arange(errors)] += precision
    # Axes and errors together: what the returns show of an error is taken out of the axes.
    rows = np.linalg.inv(whole)[errors:]
    step = np.r_[np.zeros(SHARED), rows @ gradient[POSE:]]
    passed = rows[:, :errors] * precision * sigma[groups.label][order]
    of_radius = passed[:, RADIUS].copy()
    passed[:, RADIUS] = 0.0
    floor = np.diag(np.tile([FLOOR_POINT, FLOOR_POINT, FLOOR_LEAN, FLOOR_LEAN], len(seen)))
    return OwnAxes(
        state.moved(step),
        noise,
        np.asarray(rows @ information @ rows.T),
        np.hstack([passed, floor]),
        of_radius,
    )


def climb_from_lines(
    beams: Beams, radius: float, log_noise: Array | None = None
) -> tuple[State, Array]:
    """Climb as `climb_alone` does from lines fitted to the returns.

    Parameters
    ----------
    beams
        Of the LiDAR.
    radius
        Of the poles, metres.
    log_noise
        As there; None is what the lines leave.
    """
    # Both are the same LiDAR: what is said of the second is not used.
    start, by_lines = start_of(beams, beams, np.eye(4), radius)
    return climb_alone(start, beams, by_lines[0] if log_noise is None else log_noise)


def climb_alone(state: State, beams: Beams, log_noise: Array) -> tuple[State, Array]:
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
    priors = Priors((0.0, 0.0), state.radius, 0.0)

    def advance(now: Posterior[State], step: Array, damping: float) -> Posterior[State]:
        noise = now.log_noise + now.noise_step / (1.0 + damping)
        depth = max(noise[0, 0], np.log(MIN_NOISE))
        bounds = depth + np.log([MIN_LATERAL_NOISE, MAX_LATERAL_NOISE])
        noise[0] = depth, np.clip(noise[0, 1], *bounds)
        return evaluate(now.state.moved(step), noise, [beams], priors)

    start = evaluate(state, np.tile(log_noise, (2, 1)), [beams], priors)
    found = levenberg_marquardt(
        start,
        advance,
        lambda step: step.gain < POLE_GAIN,
        tolerance=POLE_STEP,
        damping=NOISE_DAMPING,
        min_damping=NOISE_DAMPING,
        slack=POLE_SLACK,
        max_iterations=MAX_POLE_ITERATIONS,
    )
    return found.point.state, np.exp(found.point.log_noise[0])
