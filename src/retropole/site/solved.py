"""All unknowns of a site at the answer, axes and control points too, and what is known of them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from .. import se3
from ..alignment.certainty import considered
from ..datatypes import Array
from ..systematic import Groups
from .network import Network, Observation
from .refinement import SiteEnd


@dataclass(frozen=True, eq=False)
class Solved:
    """All unknowns of a site at the answer.

    Attributes
    ----------
    network
        The observations.
    values
        (Z,) the unknowns.
    inverse
        (Z, Z) of all information; zero where the datum holds a pose.
    wide
        (Z, R) errors that are considered and not estimated, each of 1 σ.
    sigma
        (B,) 1 σ of each error.
    """

    network: Network
    values: Array
    inverse: Array
    wide: Array
    sigma: Array

    @cached_property
    def by_wide(self) -> Array:
        """(Z, R) how far the errors that are considered move the slope of all observations."""
        return np.asarray(self.network.total()[0] @ self.wide)

    def slope(self, one: Observation) -> Array:
        """(P,) slope of an observation's log-likelihood at the answer."""
        away = (self.values - self.network.start)[one.place]
        return np.asarray(one.gradient - one.information @ away)


def solved(network: Network, end: SiteEnd, groups: Groups) -> Solved:
    """Solve for all unknowns, axes and control points too, at the answer.

    Parameters
    ----------
    network, end
        What was adjusted, and where it ended.
    groups
        The errors.
    """
    unknowns, poses = network.unknowns, network.unknowns.poses
    information, gradient = network.total()
    steps = [se3.local(a, b) for a, b in zip(network.state.T, end.T, strict=True)]
    kept = np.r_[np.concatenate(steps), end.errors]
    gone = slice(unknowns.kept, None)
    start = network.start
    pull = gradient[gone] - information[gone, : unknowns.kept] @ (kept - start[: unknowns.kept])
    values = np.r_[kept, start[gone] + np.linalg.solve(information[gone, gone], pull)]
    index = np.arange(poses, unknowns.kept)
    information[index, index] += end.precision
    for term in end.scene:
        information[np.ix_(term.place, term.place)] += term.information
    free = np.flatnonzero(np.r_[network.free, np.ones(unknowns.size - poses, dtype=bool)])
    inverse = np.zeros_like(information)
    inverse[np.ix_(free, free)] = np.linalg.inv(information[np.ix_(free, free)])
    sigma = considered(groups, end.sigma)
    which = np.flatnonzero(sigma)
    wide = np.zeros((unknowns.size, len(which)))
    wide[poses + which, np.arange(len(which))] = sigma[which]
    return Solved(network, values, inverse, wide, end.sigma[groups.label])
