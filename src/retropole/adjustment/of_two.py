"""Two LiDARs that nothing but each other ties, tested as a site is: every observation of poles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..alignment.adjustment import BeamAlignment
from ..alignment.factor import OF_SOURCE
from ..alignment.network import factor_of
from ..alignment.survey import NOTHING_SURVEYED
from ..base import se3
from ..base.datatypes import Array
from ..base.description import Site
from ..base.systematic import ErrorModel
from ..extraction.sensor_pattern import error_sizes
from ..hypotheses.placements import PairedPlacement, left_in
from .datum import Datum, of_lidar
from .descent import RefinementProblem, minimise
from .places import parts_of
from .refinement import Refinement
from .shared import SharedPole, extent_of
from .site import Adjusted, tested


def adjusted_of_two(
    site: Site,
    paired: Sequence[PairedPlacement],
    numbers: Sequence[int],
    aligned: BeamAlignment,
    refined: Refinement | None,
) -> Adjusted:
    """Test the poles of two LiDARs at their answer.

    Parameters
    ----------
    site
        For names.
    paired
        The poles of all placements that were used, paired.
    numbers
        Index of each of them in `Site.placements`.
    aligned, refined
        The poles' pose, and with the scene; None where there is none.
    """
    joint = aligned.joint
    assert joint is not None
    observations = tuple(
        one if one.placement is None else replace(one, placement=numbers[one.placement])
        for one in joint.network.observations
    )
    joint = replace(joint, network=replace(joint.network, observations=observations))
    T = (aligned.pose if refined is None else refined.pose).T_target_source
    poles = _poles(paired, numbers, aligned, T)
    if refined is None:
        scans = paired[0].placement.scans
        left = left_in([each.placement for each in paired])
        sizes = tuple(error_sizes(scan.cloud, scan.sensor) for scan in scans)
        factor = factor_of(joint.network, left=left)
        groups = factor.unknowns.groups()
        model = ErrorModel(sizes, joint.radius_sigma)
        problem = RefinementProblem(factor, (), groups, model.sigmas(groups))
        end = minimise(problem)
        parts = parts_of(problem, end)
    else:
        end, parts = refined.end, refined.parts
        bands = [np.unique(each.bands) for each in refined.surfaces]
        joint = replace(joint, network=joint.network.with_bands(bands))
    words = of_lidar(site.lidars[0].name)
    datum = Datum({0: np.eye(4), 1: T}, poles, NOTHING_SURVEYED, OF_SOURCE, words)
    return tested(site, datum, joint, end, parts)


def _poles(
    paired: Sequence[PairedPlacement], numbers: Sequence[int], aligned: BeamAlignment, T: Array
) -> list[SharedPole]:
    found: list[SharedPole] = []
    for each, placement in zip(paired, numbers, strict=True):
        both = zip(each.target_poles, each.source_poles, strict=True)
        for number, (target, source) in enumerate(both, 1):
            point, direction = aligned.axis_points[len(found)], aligned.axis_directions[len(found)]
            xyz = np.concatenate([target.xyz, se3.apply(T, source.xyz)])
            extent = extent_of(point, direction, xyz)
            seen = {0: target, 1: source}
            found.append(SharedPole(placement, number, seen, point, direction, extent))
    return found
