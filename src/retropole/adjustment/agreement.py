"""Whether what was seen agrees: the poles with each other, with the radius, and with the scene."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ..alignment.adjustment import BeamAlignment
from ..alignment.certainty import MAX_NORMAL, SIGNIFICANCE, chi2_limit, normalised
from ..alignment.unknowns import POSE
from ..base.datatypes import Kind, Test
from ..base.errors import Reason, Refusal
from ..base.quantities import error, value, value_and_error
from ..base.uncertainty import RadiusEstimate
from ..hypotheses.placements import PairedPlacement, align
from ..hypotheses.similarity import LEAST_CHANGE
from .refinement import Refinement, refine_by_scene

WARN_MAHALANOBIS_SQ = chi2_limit(POSE, 1.0 - SIGNIFICANCE)
"""Squared Mahalanobis distance of the refined pose from that of the poles above which it is
reported."""

MAX_MAHALANOBIS_SQ = 100.0
"""Above this the answer is refused. In 56 simulated recordings between which a pole was moved by 3
to 15 cm, the refined pose was off by more than 0.1 m or 1° only beyond it, or where the poles were
found inconsistent."""

MAX_AXES_CHI2 = chi2_limit(2, 1.0 - SIGNIFICANCE) / 2
"""Most χ² of the poles' test for each degree of freedom, 6.9. Poles that did not move came up to
2.9 in 166 recordings (benchmarks/coverage.py, tuning families, seeds 0 to 20), and to 5.2 in 189 of
four pairs of sensors (its ordinary noise and its field, seeds 0 to 23 for each pair), there with a
PandarQT, and to 3.1 in 45 with inserted poles (benchmarks/semireal.py, its first seeds)."""

MOST_LEFT_OUT = 6
"""At most this many poles are left out in turn, first those that explain most of the misfit:
each takes an alignment of all others, seconds for a row of posts."""


def without_misplaced(
    paired: Sequence[PairedPlacement],
    aligned: BeamAlignment,
    *,
    radius: float,
    radius_sigma: float,
    scene: bool = True,
) -> tuple[Sequence[PairedPlacement], BeamAlignment]:
    """Leave out the pole, of three or more, that is not where the others imply, if there is one.

    Each is left out in turn, and the others are tested. Two that are left of three fit each other
    easily, so where that mends it for several, the scene says for which: only without the pole that
    moved, or is another object, do the others agree with it.

    Parameters
    ----------
    paired, aligned
        The poles of all placements, paired; and aligned.
    radius, radius_sigma
        Of the poles, and its 1 σ, metres.
    scene
        Whether the scene may be used.

    Raises
    ------
    Refusal
        ``poles_inconsistent``.
    """
    if _have_same_arrangement(aligned):
        return paired, aligned
    T, found = aligned.pose.T_target_source, []
    explained = iter(aligned.axes_test.by_pole)
    least = np.sort(aligned.axes_test.by_pole)[::-1][:MOST_LEFT_OUT][-1]
    for k, each in enumerate(paired):
        for pair in each.hypothesis.match.pairs:
            if next(explained) < least or len(each.target_poles) <= 2:
                continue
            fewer = [*paired[:k], each.without(pair), *paired[k + 1 :]]
            try:
                other = align(fewer, T, radius=radius, radius_sigma=radius_sigma)
            except Refusal:
                continue
            if _have_same_arrangement(other):
                found.append((fewer, other))
    if len(found) > 1:
        found = [one for one in found if scene and _scene_agrees(refine_by_scene(*one))]
    if len(found) != 1:
        check_axes(aligned)
    return found[0]


def _scene_agrees(refined: Refinement | None) -> bool:
    return refined is not None and refined.mahalanobis_sq <= WARN_MAHALANOBIS_SQ


def _have_same_arrangement(aligned: BeamAlignment) -> bool:
    test = aligned.axes_test
    return test.chi2 <= MAX_AXES_CHI2 * test.freedom


def check_axes(aligned: BeamAlignment) -> None:
    """Refuse poles whose arrangement differed between the recordings of the LiDARs.

    Raises
    ------
    Refusal
        ``poles_inconsistent``.
    """
    test = aligned.axes_test
    limit = MAX_AXES_CHI2 * test.freedom
    if not _have_same_arrangement(aligned):
        # Of two poles it is undecidable which one moved.
        worst = int(np.argmax(test.by_pole)) if len(test.by_pole) > 2 else None
        named = "" if worst is None else f", freeing pole {worst} explains most of it"
        raise Refusal(
            "poles_inconsistent",
            "the arrangement of the poles differs between both recordings: χ² is "
            f"{test.chi2:.0f} with {test.freedom} degrees of freedom, {limit:.0f} are allowed"
            f"{named}; did one move between the recordings, or is one another object?",
            {
                "chi2": test.chi2,
                "limit": limit,
                "dof": test.freedom,
                "pole": -1 if worst is None else worst,
            },
        )


def check_contradiction(refined: Refinement | None) -> None:
    """Refuse poles and a scene whose poses differ by far more than both allow.

    Raises
    ------
    Refusal
        ``poles_scene_contradict``.
    """
    if refined is None or refined.mahalanobis_sq <= MAX_MAHALANOBIS_SQ:
        return
    off_poles = refined.from_poles
    raise Refusal(
        "poles_scene_contradict",
        f"the scene has the LiDARs {error(off_poles.translation, 'm')} and "
        f"{error(off_poles.rotation, 'rad')} from where the poles have them, "
        f"{np.sqrt(refined.mahalanobis_sq / 6):.0f} times what their uncertainty allows: did a "
        "pole move between the two recordings, or is one another object?",
        {
            "mahalanobis_sq": refined.mahalanobis_sq,
            "moved_m": off_poles.translation,
            "turned_rad": off_poles.rotation,
        },
    )


def check_radius(radius: RadiusEstimate, contradicted: float) -> Iterator[Reason]:
    """Warn, with the number of σ, where the returns conflict with the given radius."""
    if contradicted > MAX_NORMAL:
        yield Reason(
            "radius_differs",
            f"the returns conflict with the given radius, {value(radius.given, radius.sigma)}, by "
            f"{contradicted:.0f} σ and have "
            f"{value_and_error(radius.estimated, radius.sigma)}: is --radius a diameter? The "
            "answer uses what the returns have",
            {"given_m": radius.given, "estimated_m": radius.estimated, "sigma_m": radius.sigma},
        )


def agreement_tests(aligned: BeamAlignment, refined: Refinement | None) -> Iterator[Test]:
    """Test how well the surfaces of a pair, the given radius and the scale agree with the poles.

    The redundancy of the poles' pose is that of an observation of six unknowns (Baarda 1968): the
    share of it that the surfaces check.
    """

    def test(kind: Kind, name: str, chi2: float, freedom: int, redundancy: float) -> Test:
        w = normalised(chi2, freedom)
        none = None, None, None
        return Test(kind, name, *none, chi2, freedom, w, redundancy, None, None, MAX_NORMAL)

    if refined is not None:
        assert aligned.pose.covariance is not None
        assert refined.pose.covariance is not None
        left = np.linalg.solve(aligned.pose.covariance, refined.pose.covariance)
        checked = float(np.clip(1.0 - np.trace(left) / POSE, 0.0, 1.0))
        name = "surfaces against the poles"
        yield test("surfaces", name, refined.mahalanobis_sq, POSE, checked)
        if refined.scale is not None:
            factor, sigma = refined.scale
            off = (factor - 1.0) / max(sigma, LEAST_CHANGE / MAX_NORMAL)
            yield test("scale", "scale of the source", off**2, 1, 1.0)
    radius = aligned.radius
    checked = float(np.clip(1.0 - (radius.sigma / radius.given_sigma) ** 2, 0.0, 1.0))
    yield test("radius", "radius as given", aligned.radius_conflict**2, 1, checked)


def check_minima(refined: Refinement | None) -> Iterator[Reason]:
    """Warn where the scene converges to different poses within the poles' uncertainty."""
    if refined is not None and refined.other_minima:
        furthest = max(refined.other_minima, key=lambda step: float(np.linalg.norm(step[3:])))
        metres, radians = (float(np.linalg.norm(part)) for part in (furthest[3:], furthest[:3]))
        yield Reason(
            "several_minima",
            "from other starts within the poles' uncertainty the scene leads to another pose, "
            f"{error(metres, 'm')} and {error(radians, 'rad')} away; the one that more of the "
            "scene agrees with is given",
            {"apart_m": metres, "apart_rad": radians, "starts": 1 + len(refined.other_minima)},
        )


RECORD_MORE = "add a placement of the poles, or record where more objects are around"
"""What to do where one place decides."""


def check_decisive(refined: Refinement | None, helps: str = RECORD_MORE) -> Iterator[Reason]:
    """Warn if a single place determines a direction of the pose, and suggest what helps."""
    for place in () if refined is None else refined.decisive:
        radians, metres = (float(np.linalg.norm(part)) for part in np.split(place.apart, 2))
        x, y, z = (float(v) for v in place.at)
        yield Reason(
            "one_place_decides",
            f"one place {np.linalg.norm(place.at):.0f} m away, at ({x:.1f}, {y:.1f}, {z:.1f}) m of "
            f"the target, gives {place.share:.0%} of the information about the pose along one "
            f"direction; without it the pose lies {error(metres, 'm')} and {error(radians, 'rad')} "
            f"away. The stated uncertainty is that of the rest: {helps}",
            {
                "share": place.share,
                "x_m": x,
                "y_m": y,
                "z_m": z,
                "apart_m": metres,
                "apart_rad": radians,
            },
        )


def check_agreement(refined: Refinement | None, *, is_map: bool = False) -> list[Reason]:
    """Warn where the scene moves the pose further away than the poles' uncertainty allows.

    Of a map, from the pose where the LiDAR was registered to objects that cannot have driven off.
    """
    if refined is None or refined.mahalanobis_sq <= WARN_MAHALANOBIS_SQ:
        return []
    off_poles = refined.from_poles
    before, question = (
        "the poles",
        "did something move between the two recordings, or is --radius wrong?",
    )
    if is_map:
        before = "where all that is high fits best"
        question = "has something moved since the map was made, or is the map distorted?"
    return [
        Reason(
            "poles_and_scene_disagree",
            f"the scene moves the pose {1000 * off_poles.translation:.0f} mm and "
            f"{np.degrees(off_poles.rotation):.2f}° away from {before}, "
            f"{np.sqrt(refined.mahalanobis_sq / 6):.1f} times what their uncertainty allows: "
            f"{question}",
            {
                "pull": refined.mahalanobis_sq,
                "moved_m": off_poles.translation,
                "turned_rad": off_poles.rotation,
            },
        )
    ]
