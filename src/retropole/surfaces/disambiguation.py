"""Which hypothesis is right: the poles cannot tell, the scene around them can.

Three measures are taken of every hypothesis, and all are reported:

- the paper's (Xue et al. 2019, Tab. III): run ICP from the hypothesis and see how far it moves,
  ``e_r = ‖log(R_icp)^∨‖`` and ``e_t = ‖t_icp‖``; the one that moves least is right,
- overlap: the share of one cloud's points with a neighbour in the other,
- free-space violation: the share of one LiDAR's returns that stand where the other looked through.

The score is overlap less free-space violation, both as shares of the downsampled points and the
mean of both directions (`visibility`). It needs no ICP. See docs/hypotheses.md.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..base import se3
from ..base.datatypes import Array, Hypothesis, Match, PointCloud
from ..base.errors import Refusal
from ..base.quantities import counted
from .registration import MIN_CLOUD_POINTS, SAMPLE, Surface, as_surface, register
from .visibility import OVERLAP_DISTANCE, compare_views, view_of

SCORING_VOXEL = 0.25
"""Clouds are downsampled to one point per cube of this side, metres, before they are compared."""

ICP_CORRESPONDENCE_DISTANCE = 1.0
"""Largest distance of corresponding points in the paper's ICP, metres. The paper names none."""

SCORING_SAMPLE = SAMPLE
"""Overlap and free space take every n-th downsampled point so that no more are left."""


def score_hypotheses(
    target: PointCloud, source: PointCloud, matches: Sequence[Match]
) -> tuple[Hypothesis, ...]:
    """Score every match of the poles by the scene.

    Parameters
    ----------
    target, source
        The whole clouds, each in its own frame.
    matches
        Candidate poses from `hypotheses.correspondence.match_poles`.

    Returns
    -------
    tuple of Hypothesis
        The best score first; matches whose poles do not fit exactly come after those that do.

    Raises
    ------
    Refusal
        ``too_few_points`` where a cloud is too small to compare.
    """
    views = {
        "target": view_of(target, SCORING_VOXEL, SCORING_SAMPLE),
        "source": view_of(source, SCORING_VOXEL, SCORING_SAMPLE),
    }
    for name, view in views.items():
        if view.size < MIN_CLOUD_POINTS:
            raise Refusal(
                "too_few_points",
                f"the {name} cloud downsampled to {SCORING_VOXEL:g} m has "
                f"{counted(view.size, 'point')}, "
                f"{MIN_CLOUD_POINTS} are needed to tell the hypotheses apart; record a scene with "
                "more in it",
                {"lidar": name, "points": view.size, "needed": MIN_CLOUD_POINTS},
            )
    surface = as_surface(np.asarray(views["target"].tree.data))
    hypotheses = []
    for match in matches:
        T = match.T_target_source
        found = compare_views(
            views["target"],
            views["source"],
            T,
            within=OVERLAP_DISTANCE,
            limit=ICP_CORRESPONDENCE_DISTANCE,
        )
        near = views["source"].points[found.distances <= ICP_CORRESPONDENCE_DISTANCE]
        e_r, e_t = icp_motion(surface, near, T)
        score = found.overlap - found.free_space_violation
        hypotheses.append(
            Hypothesis(
                match,
                e_r,
                e_t,
                found.overlap,
                found.free_space_violation,
                score,
                found.covisible_overlap,
            )
        )
    return tuple(sorted(hypotheses, key=lambda h: (not h.match.exact, -h.score)))


def icp_motion(target: Surface, points: Array, T: Array) -> tuple[float | None, float | None]:
    """How far ICP moves from a hypothesis: e_r (rad) and e_t (m) of the paper's Tab. III.

    Parameters
    ----------
    target
        The prepared target cloud.
    points
        (N, 3) source points with a target neighbour within `ICP_CORRESPONDENCE_DISTANCE` under
        ``T``: ICP uses no others, and looking for the neighbours of far ones is what takes its
        time.
    T
        (4, 4) the hypothesis, target from source.

    Returns
    -------
    e_r, e_t
        None where so few points lie near that ICP has nothing to work with: that it then stays
        where it is says nothing for the hypothesis.
    """
    if len(points) < MIN_CLOUD_POINTS:
        return None, None
    moved_by = register(
        target,
        as_surface(points),
        T,
        method="ICP",
        max_correspondence_distance=ICP_CORRESPONDENCE_DISTANCE,
    ).T_target_source @ se3.inverse(T)
    return se3.rotation_angle(moved_by[:3, :3]), float(np.linalg.norm(moved_by[:3, 3]))
