"""Poles and scene in one problem: the pose that both agree on, with the LiDARs' errors in it.

The poles give a quadratic form of the pose and of the errors of both LiDARs (`alignment.factor`);
the scene adds the distances between surface patches that both LiDARs see, which the same errors
move. Minimised together over the step x and the errors b:

    Σ_i w_i ρ( n_i · (R c_i + t − d_i) + D_i b )  +  ½ zᵀΛz − ηᵀz  +  ½ bᵀB⁻¹b,    z = [x, b]

with c_i the centre of a patch of the source, d_i of the target's surface near it, n_i the mean of
their normals. A direction that the scene does not hold (along a corridor, over open ground) has no
part in the first sum and stays where the poles put it. The sizes of the errors are estimated too,
never below what the manufacturer states. Coarse to fine: a patch looks for its partner as far as
the pose is still uncertain there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..alignment.certainty import Scatter, excess, stated
from ..alignment.factor import POSE, PoleFactor, gaussian_factor
from ..base import se3
from ..base.datatypes import Array, PointCloud, PoseEstimate
from ..base.systematic import DEVICE_KINDS, ErrorModel, Layout, groups_of, joined
from ..base.uncertainty import Uncertainty
from .decisive import Decisive, places_of, without_decisive
from .descent import FEW, End, RefinementProblem, approach, settle, support_of
from .patch_pairs import MIN_PATCHES, prepare_patches, thinned, without_errors
from .patches import Patches, surface_patches
from .starts import SEVERAL, approaches_from_afar, approaches_of_parts, distance_sq, elsewhere

PLACE_BIAS = 0.0005
"""1 σ of what all patches of one place have in common, metres: a wall that is not flat, and the
downsampling, which keeps more of the far tail of the noise than of the middle."""

DOUBT = 6.0
"""Squared Mahalanobis distance from the poles' pose, the mean of χ² with 6 degrees of freedom, from
which the search starts again with other parts of the patches. In 700 recordings of simulated
streets, corridors and harbors it was larger in 6 %."""

DISAGREE = 12.6
"""… and from which it is not taken for chance that the scene has another: the covariance then
covers both."""

SCALE = next(k for k, kind in enumerate(DEVICE_KINDS) if kind.field == "scale")
"""Which of the errors of a whole LiDAR is that of the scale of its ranges."""

MAX_SCALE_SIGMA = 0.1
"""1 σ of that scale from which the surfaces say nothing of it."""

UNSURE = 0.01
"""Part of their information that poles keep when the scene is asked nearly alone: ten times their
1 σ. Of 48 recordings between which a pole was moved by 15 cm three were answered, 11 cm and more
off, two of them with a χ² below 17; asked so, the scene denies the poles."""


@dataclass(frozen=True, eq=False)
class Refinement:
    """The pose that poles and scene agree on.

    Attributes
    ----------
    pose
        Pose, covariance, and RMS residual of the patches.
    uncertainty
        The covariance in its two kinds, and the budget.
    patches
        How many pairs of patches took part.
    mahalanobis_sq
        Squared Mahalanobis distance of the pose from the poles' own: χ² with 6 degrees of freedom
        where the stated uncertainties are right.
    from_poles
        The same step as rotation, rad, and translation, metres at the source's own origin.
    other_minima
        Steps (6,) to where the search ended from other starts within the poles' uncertainty, where
        that is another pose; empty mostly.
    converged, iterations
        Whether the last step was below its tolerance, and how many were taken.
    surfaces
        Patches of the target and the source, each in its own frame.
    corrected
        The same without the errors that were found of the LiDARs.
    scale
        By which factor the source would have to be scaled, and its 1 σ, as if nothing were known of
        the error of its ranges' scale; None where nothing tells.
    decisive
        Places that alone decide a direction of the pose, the most decisive first; empty mostly.
    """

    pose: PoseEstimate
    uncertainty: Uncertainty
    patches: int
    mahalanobis_sq: float
    from_poles: se3.PoseDifference
    other_minima: tuple[Array, ...]
    converged: bool
    iterations: int
    surfaces: tuple[Patches, Patches]
    corrected: tuple[Patches, Patches]
    scale: tuple[float, float] | None = None
    decisive: tuple[Decisive, ...] = ()


def refine(
    target: PointCloud,
    source: PointCloud,
    poles: PoseEstimate,
    *,
    factor: PoleFactor | None = None,
    model: ErrorModel | None = None,
    start: Array | None = None,
    origins_known: bool = False,
) -> Refinement | None:
    """Let the scene sharpen the pose that the poles give.

    Parameters
    ----------
    target, source
        Clouds, each in its own frame.
    poles
        Pose and covariance of the poles.
    factor
        What the poles say of the pose and the errors; None takes `poles` for a normal distribution
        of the pose that says nothing of the errors.
    model
        Sizes of the errors; None takes those of unknown LiDARs.
    start
        (4, 4) where the search starts; None takes the poles' pose.
    origins_known
        Whether the beams of both clouds start where `PointCloud.origin` says; without, the front of
        an object and its back cannot be told apart by their normals.

    Returns
    -------
    Refinement or None
        None where the scene has fewer than `MIN_PATCHES` common patches: it has nothing to say.
    """
    assert poles.covariance is not None
    patches = surface_patches(target), surface_patches(source)
    if min(len(one.centres) for one in patches) < MIN_PATCHES:
        return None
    seen = Layout((np.unique(patches[0].bands), np.unique(patches[1].bands)))
    given = gaussian_factor(poles) if factor is None else factor
    layout = joined(given.layout, seen)
    groups = groups_of(layout)
    known = (ErrorModel() if model is None else model).sigmas(groups)
    sets = prepare_patches(patches[0], patches[1], layout)
    problem = RefinementProblem(
        sets, thinned(sets, FEW), given.within(layout), groups, known, origins_known
    )
    first = poles.T_target_source if start is None else start
    near = approach(problem, first, poles.covariance)
    if near is None:
        return None
    starts = [near, *approaches_from_afar(problem, near, poles, source)]
    settled = _settled(problem, starts, poles.covariance)
    if not settled:
        return None
    best = max(settled, key=support_of)
    mahalanobis_sq = _denial(problem, best, poles)
    if mahalanobis_sq > DOUBT:
        starts = approaches_of_parts(problem, first, settled, poles.covariance)
        settled += _settled(problem, starts, poles.covariance)
        best = max(settled, key=support_of)
        mahalanobis_sq = _denial(problem, best, poles, within=True)
    highest = best
    disagree = mahalanobis_sq > DISAGREE
    if disagree:
        # One of both is wrong by more than it states (Birge 1932): the poles count for as much
        # less.
        share = POSE / mahalanobis_sq
        problem = replace(problem, factor=problem.factor.weakened(share))
        best = _settled_anew(problem, best, poles.covariance / share) or best
        moved = distance_sq(poles.covariance, poles.T_target_source, best.T)
        mahalanobis_sq = max(mahalanobis_sq, moved)
    uncertainty = own = _uncertainty(best, problem, ())
    decisive, by_places = [], np.zeros((POSE, POSE))
    for place, without, rest in without_decisive(problem, best, poles.covariance):
        decisive.append(place)
        less = excess(_uncertainty(rest, without, ()).covariance, own.covariance)
        by_places += less + np.outer(place.apart, place.apart)
    others = [("one place that decides", by_places)] if decisive else []
    if disagree:
        # Which of both is not known: what is stated reaches from one to the other, and as far
        # beyond as the poles alone are unsure. Of 17 poses drawn from the poles' uncertainty under
        # a scene that denied them none was within what the scene and the line between them state.
        e = se3.local(poles.T_target_source, best.T)
        others.append(("poles and scene disagree", np.outer(e, e) + poles.covariance))
    if others:
        uncertainty = _uncertainty(best, problem, others)
    pairs, weights = best.linear.pairs, best.linear.weights
    rms = float(np.sqrt(np.average(pairs.residuals**2, weights=weights)))
    minima = [
        se3.local(highest.T, one.T)
        for one in settled
        if distance_sq(own.covariance, highest.T, one.T) > SEVERAL
    ]
    return Refinement(
        PoseEstimate(best.T, uncertainty.covariance, rms),
        uncertainty,
        len(weights),
        mahalanobis_sq,
        se3.difference(poles.T_target_source, best.T),
        tuple(minima),
        best.converged,
        best.iterations,
        patches,
        without_errors(sets, best.linear.errors),
        _scale_wanted(best, problem),
        tuple(decisive),
    )


def _settled(problem: RefinementProblem, starts: Sequence[End], covariance: Array) -> list[End]:
    """Settle each, and leave out what comes to nothing."""
    ends = [settle(problem, each, covariance) for each in starts]
    return [each for each in ends if each is not None]


def _denial(
    problem: RefinementProblem, best: End, poles: PoseEstimate, *, within: bool = False
) -> float:
    """How far poles and scene are apart, squared, in units of what the poles state.

    Poles that are sure of a wrong pose hold the search where the true surfaces are out of reach:
    the scene is asked again with the poles hardly counted, as far as they may then be off. Asked
    also `within` what the search left, its other minima are no denial where they have less support.
    """
    assert poles.covariance is not None
    T = poles.T_target_source
    apart = distance_sq(poles.covariance, T, best.T)
    alone = replace(problem, factor=problem.factor.weakened(UNSURE))
    reach = [poles.covariance / UNSURE, best.search] if within else [poles.covariance / UNSURE]
    found = [approach(alone, best.T, each) for each in reach]
    far = max((each for each in found if each is not None), key=support_of, default=None)
    if far is None:
        return apart
    # What the scene alone does not hold is no denial.
    return max(apart, distance_sq(poles.covariance + far.search, T, far.T))


def _settled_anew(problem: RefinementProblem, best: End, covariance: Array) -> End | None:
    """Settle under poles that count for less, with as wide a search and without.

    A wider search may leave a good minimum for one with less support.
    """
    again = approach(problem, best.T, covariance)
    starts = [best] if again is None or not elsewhere(again, [best]) else [best, again]
    return max(_settled(problem, starts, covariance), key=support_of, default=None)


def _scale_wanted(end: End, problem: RefinementProblem) -> tuple[float, float] | None:
    """What the data alone say of the scale between the LiDARs' ranges: without its prior.

    ``b`` is normal with the variance ``v`` and has had the prior precision ``p`` about 0: without,
    its information is ``1/v − p``. Mean of freeing the target's and the source's.
    """
    found = []
    for lidar, sign in ((0, 1.0), (1, -1.0)):
        k = problem.factor.layout.device(lidar).start + SCALE
        variance = float(end.linear.inverse[POSE + k, POSE + k])
        information = 1.0 / variance - float(end.linear.precision[k])
        if information * MAX_SCALE_SIGMA**2 < 1.0:
            return None
        found.append((sign * float(end.linear.errors[k]) / variance / information, information))
    return 1.0 + (found[0][0] + found[1][0]) / 2, max(one[1] ** -0.5 for one in found)


def _uncertainty(
    end: End, problem: RefinementProblem, other: Sequence[tuple[str, Array]]
) -> Uncertainty:
    """State the uncertainty of the minimum, of residuals that are far from independent.

    ``Σ_c d_c d_cᵀ``: ``d_c = (S − S_c)⁻¹ g_c`` is how far the answer goes without all residuals at
    one place, which may be correlated in any way (the jackknife over clusters, Bell and McCaffrey
    2002), with the errors b eliminated from S and g.
    """
    linear, inverse = end.linear, end.linear.inverse
    places = places_of(linear)
    without = places.marginal - places.information
    moves = np.linalg.solve(without, places.gradients[:, :, None])[:, :, 0]
    size = np.sum(moves * (moves @ places.marginal), axis=1)
    freedom = float(size.sum() ** 2 / max(float(np.sum(size**2)), 1e-300))
    information = problem.factor.information
    from_poles = inverse[:POSE] @ information @ inverse[:POSE].T
    return stated(
        problem.groups,
        end.sigma,
        linear.precision,
        inverse,
        linear.errors,
        (
            Scatter("scatter of the surfaces", moves.T @ moves, freedom),
            Scatter("scatter of the poles' returns", from_poles, problem.factor.redundancy),
        ),
        (("surfaces that are not flat", places.moves.T @ places.moves * PLACE_BIAS**2), *other),
    )
