"""The radius of the poles as the returns on them have it, whatever was given."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..base.systematic import ErrorModel
from .certainty import solve_factor
from .error_sizes import considered, prior_precision
from .network import Network, factor_of

RADIUS_MODEL, RADIUS_EDGE = 0.0015, 0.12
"""1 σ of the radius that the beam model itself leaves open, metres, and as a part of the one given:
which returns from the edge of a pole are bright enough is not known. Where intensity falls with
range and incidence (seeds 0 to 99 of that family in benchmarks/coverage.py) the returns alone gave
18.4 mm of 20 mm in the middle and 8.9 mm at the least, 3.0 σ with 0.12 and 3.6 σ with 0.06; with
0.12 all of 24 diameters that were given for the radius are contradicted."""


@dataclass(frozen=True)
class ReturnsRadius:
    """The radius as the returns alone have it, and its 1 σ, metres."""

    value: float
    sigma: float

    def sigmas_below(self, radius: float, sigma: float) -> float:
        """By how many σ the returns want a thinner pole than one with a 1 σ of its own.

        Thicker is no denial: tape glows, and beams beside a pole return as if they had met it.
        """
        return max(radius - self.value, 0.0) / float(np.hypot(self.sigma, sigma))


def radius_of_returns(network: Network, model: ErrorModel, radius: float) -> ReturnsRadius:
    """Ask the returns for the radius without what was given.

    Parameters
    ----------
    network
        About a maximum that was found with a radius, metres.
    model
        Of the errors.
    radius
        That radius.
    """
    factor = factor_of(network)
    groups, own = factor.unknowns.groups(), factor.unknowns.radius
    poses = factor.unknowns.poses
    known = model.sigmas(groups)
    precision = prior_precision(groups, known)
    precision[own - poses] = 0.0
    estimate = solve_factor(factor, precision)
    row = estimate.inverse[own]
    passed = row[poses:] * precision * considered(groups, known)
    variance = float(row[own] + passed @ passed)
    return ReturnsRadius(
        radius + float(estimate.errors[own - poses]),
        float(np.sqrt(variance + RADIUS_MODEL**2 + (RADIUS_EDGE * radius) ** 2)),
    )
