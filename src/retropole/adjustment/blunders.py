"""Blunders: which observation does not fit is named, left out, and the rest adjusted again.

A blunder draws the tests of its neighbours along. So each of the worst is left out by turns, and
the one without which everything fits is the blunder.

Where poles do not check each other, the surroundings show a pole that moved: they coincide without
it. Two poles fit each other wherever one of them is pushed within the freedom that the other
leaves, and the surfaces, weighed by their distance, follow. Of three poles any two may be
the pair that fits. But under the pose that a moved pole gives walls do not coincide that do without
it. Most of what is seen is ground, which coincides with itself wherever it slides to: only what two
answers place differently distinguishes them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..alignment.certainty import chi2_limit
from ..alignment.unknowns import POSE
from ..base import se3
from ..base.datatypes import Test
from ..base.description import Site
from ..base.errors import Reason, Refusal
from ..hypotheses.by_place import LEAN_ANOTHER, is_constrained
from ..surfaces.patch_pairs import pair_patches
from .agreement import MAX_AXES_CHI2, MOST_LEFT_OUT, WARN_MAHALANOBIS_SQ
from .datum import Datum, Dependent, without_poles, without_survey
from .descent import CLOSE, FEW, End, SceneTerm
from .refinement import distance_sq
from .shared import SharedPole
from .site import Adjusted, Recorded, adjust, find_links, without_observations
from .snooping import POOR

PLACED_DIFFERENTLY = 2 * CLOSE
"""Answers place a patch differently that they move by more than this across its surface, metres."""

MORE_PATCHES, TIMES_PATCHES = 5.0, 2.0
"""This many more patches must coincide under another answer, and this many times as many. Without a
pole that did not move no patch was placed differently, and of every fourth up to 32 where none
coincided either way (tuning seeds 3 to 40 of tests/adjustment/test_blunders.py, 30 to 90 of
benchmarks/site.py). Without one that made 33 answers of the former wrong by 0.15 m or more, and
passed all tests, 9 to 716 more coincided, 19 times as many or more."""


def more_coincide(before: End, after: End, near: frozenset[int] | None = None) -> float:
    """Count how many more patches coincide under another answer, of those it places differently.

    Each counts by how small its distance is, less what the estimated errors of both LiDARs make of
    it. How certain the answers are has no part in it: neither in how far a patch looks for another,
    nor in what is small.

    Parameters
    ----------
    before, after
        The answer, and the other one; the patches that the other one took are counted under both.
    near
        LiDARs on one side of a link: only pairs across it count then.

    Returns
    -------
    float
        0 where they are not `TIMES_PATCHES` times as many.
    """
    sets = {term.lidars: term.sets for term in after.scene}
    was = [replace(term, sets=sets.get(term.lidars, term.sets)) for term in before.scene]
    count = _coinciding(before, was, after, near)
    left = _coinciding(after, after.scene, before, near)
    return left - count if left > TIMES_PATCHES * count else 0.0


def _coinciding(
    end: End, terms: Sequence[SceneTerm], other: End, near: frozenset[int] | None
) -> float:
    """Count coincident patches under an answer, of those that another one places differently."""
    count = 0.0
    for term in terms:
        i, j = term.lidars
        if near is not None and len(near & {i, j}) != 1:
            continue
        T, T_other = (se3.inverse(each.T[i]) @ each.T[j] for each in (end, other))
        patches = pair_patches(term.sets, T, np.zeros((POSE, POSE)), False)
        if patches is None:
            continue
        errors = end.errors[term.place[2 * POSE :] - POSE * len(end.T)]
        offsets = patches.residuals + patches.by_errors(errors)
        weights = patches.agreement / (1.0 + (offsets / CLOSE) ** 2)
        differ = np.abs(patches.jacobian @ se3.local(T, T_other)) > PLACED_DIFFERENTLY
        count += float(np.sum(weights[differ]))
    return count


def least_conflicting(ends: Sequence[End]) -> int:
    """Find the answer that the surroundings conflict with least; of equals the first."""
    against = [
        max((more_coincide(one, other) for other in ends if other is not one), default=0.0)
        for one in ends
    ]
    # Less than a patch gives no information.
    return int(np.argmin(np.floor(against)))


def conflicting_poles(
    recorded: Recorded, adjusted: Adjusted
) -> Iterator[tuple[int, Adjusted, float]]:
    """Find the poles without which far more of the surroundings coincides.

    Only where two poles alone link some LiDARs to all others: more check each other.

    Parameters
    ----------
    recorded, adjusted
        What was recorded, and the adjustment that passes its tests.

    Yields
    ------
    int, Adjusted, float
        Index of the pole, everything adjusted without it, and how many more patches coincide.
    """
    weak = [link for link in find_links(adjusted) if len(link.poles) == 2]
    for k in sorted({k for link in weak for k in link.poles}):
        across = [link.near for link in weak if k in link.poles]
        found = _contradicted(recorded, adjusted, without_poles(adjusted.datum, {k}), across)
        if found is not None:
            yield k, *found


def check_poles_of_dependent(recorded: Recorded, adjusted: Adjusted) -> Iterator[Reason]:
    """Refuse LiDARs that depend on poles without which far more of the surroundings coincides.

    One pole conflicts with nothing across itself, where it alone decides and surfaces look for
    their partners no farther than it allows. So it is split: each side has it at a separate
    position, and the surroundings constrain the pose.

    Yields
    ------
    Reason
        ``not_checked`` where the surroundings alone do not hold the pose, and no push of the pole
        would show.

    Raises
    ------
    Refusal
        ``site_inconsistent``.
    """
    datum, site = adjusted.datum, recorded.site
    for each in datum.dependent:
        across = each.across(datum.poles)
        others = tuple(one for one in datum.dependent if one is not each)
        without = replace(datum, dependent=others, poles=each.split_across(datum.poles))
        some = _without(recorded, adjusted, without, [each.lidars], few=True)
        if some is not None and some[1] < MORE_PATCHES / FEW and _is_constrained(each, some[0]):
            continue
        every = _without(recorded, adjusted, without, [each.lidars], few=False)
        names = ", ".join(datum.poles[k].name(site) for k in across)
        if every is not None and every[1] >= MORE_PATCHES:
            raise Refusal(
                "site_inconsistent",
                f"{names} moved between the recordings of {each.names(site)}, which no other "
                f"recording links: without it {every[1]:.0f} more patches of their surroundings "
                "coincide; record the placement again",
                {"poles": names, "more": every[1], "allowed": MORE_PATCHES},
            )
        if every is None or not _is_constrained(each, every[0]):
            yield Reason(
                "not_checked",
                f"{names} alone determines a part of the pose between {each.names(site)}, and the "
                f"surroundings do not check it: a push of it would not show; {LEAN_ANOTHER}",
                {"lidar": site.lidars[each.far].name, "poles": names},
            )


def _is_constrained(dependent: Dependent, found: Adjusted) -> bool:
    return is_constrained(dependent.covariance(found.end.T, found.covariance))


def _contradicted(
    recorded: Recorded, adjusted: Adjusted, datum: Datum, across: Sequence[frozenset[int]]
) -> tuple[Adjusted, float] | None:
    """Adjust without some poles, and count how many more patches coincide; None where few do."""
    # A part of the patches is enough to see that nothing moved, but may hold too little.
    some = _without(recorded, adjusted, datum, across, few=True)
    if some is not None and some[1] < MORE_PATCHES / FEW:
        return None
    every = _without(recorded, adjusted, datum, across, few=False)
    return every if every is not None and every[1] >= MORE_PATCHES else None


def _without(
    recorded: Recorded,
    adjusted: Adjusted,
    datum: Datum,
    across: Sequence[frozenset[int]],
    *,
    few: bool,
) -> tuple[Adjusted, float] | None:
    """Adjust what is left, and count how many more patches coincide; None where it is refused."""
    # The poles alone have not far to go from where all fit each other.
    near = replace(datum, poses=dict(enumerate(adjusted.end.T)))
    try:
        rest = adjust(recorded, near, few=few)
    except Refusal:
        return None
    return rest, max(more_coincide(adjusted.end, rest.end, near) for near in across)


BLUNDER = 6.5
"""Normalised residual (w) from which an observation is a blunder. Of 11 sound sites the largest w
was 5.9 (benchmarks/site.py sites, seeds 0 to 12); of 20 with a pole that was bumped by 3 cm or 1°
and more 16 came to more than 6.5, 2 to more than `POOR`, and 2 were refused before (blunders, seeds
0 to 59)."""

MOST_BLUNDERS = 3
"""At most this many are left out."""

SEPARABLE = chi2_limit(2)
"""Of two suspects either of which explains what does not fit, the one whose χ² is less by no more
than this is not distinguished: it is up to a hundred times less likely, 2 ln 100, χ² with two
degrees of freedom."""

TAKES_ALONG = "survey of a pole", "pole", "placement"
"""What goes with what is left out, the least first: a single point of the survey removes nothing
more, both ends of a pole what its survey implies for the frame."""


@dataclass(frozen=True, eq=False)
class Suspect:
    """What may be the blunder: the reason to give, the datum without it, and its χ².

    `point` names the surveyed point that it is about; None of poles and recordings.
    """

    reason: Reason
    without: Datum
    chi2: float
    point: str | None = None


def worst_test(tests: Sequence[Test], above: float = BLUNDER) -> Test | None:
    """Find the test that fits worst, of those that do not fit."""
    poor = significant(tests, above)
    return max(poor, key=lambda test: test.chi2 - 2 * test.freedom, default=None)


def significant(tests: Sequence[Test], above: float = BLUNDER) -> list[Test]:
    """Tests of what does not fit: whose w is above a limit."""
    return [test for test in tests if is_poor(test.w, test.chi2, test.freedom, above)]


def is_poor(w: float, chi2: float, freedom: int, above: float = POOR) -> bool:
    """Whether a test with this χ² shows a misfit, by a limit of its w."""
    return w > above and chi2 > MAX_AXES_CHI2 * freedom


def without_blunders(recorded: Recorded, first: Adjusted) -> tuple[Adjusted, list[Reason]]:
    """Leave out what does not fit, one after the other, until the rest does.

    Parameters
    ----------
    recorded, first
        What was recorded, and everything adjusted together.

    Returns
    -------
    Adjusted, list of Reason
        The rest, and what was left out.

    Raises
    ------
    Refusal
        ``site_inconsistent`` where no few observations explain it.
    """
    site, now = recorded.site, first
    reasons: list[Reason] = []
    for _ in range(MOST_BLUNDERS):
        if worst_test(now.tests) is None:
            contradicted = sorted(conflicting_poles(recorded, now), key=lambda each: -each[2])
            if not contradicted:
                return now, reasons
            pole, rest, more = contradicted[
                least_conflicting([rest.end for _, rest, _ in contradicted])
            ]
            reasons.append(_conflicting(site, now.datum.poles[pole], more))
            now = rest
            continue
        tried: list[tuple[float, Adjusted, Suspect]] = []
        for suspect in _suspects(site, now):
            try:
                rest = adjust(recorded, suspect.without)
            except Refusal:
                continue
            worst = worst_test(rest.tests)
            tried.append((0.0 if worst is None else worst.chi2, rest, suspect))
            if worst is None and suspect.point is None and _is_checked(rest):
                break
        if not tried:
            break
        _check_points([suspect for chi2, _, suspect in tried if chi2 == 0.0])
        now, suspect = _likeliest(tried)
        reasons.append(suspect.reason)
    worst = worst_test(now.tests)
    if worst is None:
        return now, reasons
    worst = worst_test(first.tests)
    assert worst is not None
    raise Refusal(
        "site_inconsistent",
        f"{worst.name} does not fit the others (w {worst.w:.1f}, {BLUNDER:g} is the most to "
        "expect), and no few observations explain it: did poles move between the recordings, or "
        "is a file of another placement?",
        {"w": worst.w, "chi2": worst.chi2, "allowed": BLUNDER},
    )


def _is_checked(adjusted: Adjusted) -> bool:
    """Whether the poles of every link check each other."""
    return all(link.is_checked for link in find_links(adjusted))


def _likeliest(tried: Sequence[tuple[float, Adjusted, Suspect]]) -> tuple[Adjusted, Suspect]:
    """Choose the suspect without which all else fits, and most of the surroundings coincides.

    What is left of two poles or three fits easily, whichever goes; the surroundings decide, and
    where they do not the first is chosen. Where something else does not fit either, what is left
    hardly does: of those that leave about as little, the one that itself fits worst is.

    Raises
    ------
    Refusal
        ``site_inconsistent`` where another pole may as well have moved, and the poses without it
        are others.
    """
    least = min(chi2 for chi2, _, _ in tried)
    if least > 0.0:
        near = [each for each in tried if each[0] <= least + SEPARABLE]
        _, rest, suspect = max(near, key=lambda each: each[2].chi2)
        return rest, suspect
    fitting = [(rest, suspect) for chi2, rest, suspect in tried if not chi2]
    rest, suspect = fitting[least_conflicting([rest.end for rest, _ in fitting])]
    for other, rival in fitting:
        if (
            rival.reason.code == suspect.reason.code == "pole_moved"
            and (chi2 := _apart(rest, other)) > WARN_MAHALANOBIS_SQ
            and more_coincide(other.end, rest.end) < 1.0
        ):
            names = f"{suspect.reason.values['pole']} or {rival.reason.values['pole']}"
            raise Refusal(
                "site_inconsistent",
                f"{names} moved, and neither poles nor surroundings show which: add a pole, or "
                "record the placement again",
                {"poles": names, "chi2": chi2, "allowed": WARN_MAHALANOBIS_SQ},
            )
    return rest, suspect


def _apart(a: Adjusted, b: Adjusted) -> float:
    """Largest χ² between the poses of two answers, given the uncertainty of both."""
    found = 0.0
    for i, (T, T_other) in enumerate(zip(a.end.T, b.end.T, strict=True)):
        own = slice(POSE * i, POSE * (i + 1))
        covariance = a.covariance[own, own] + b.covariance[own, own]
        if covariance.any():
            found = max(found, distance_sq(covariance, T, T_other))
    return found


def _check_points(clean: Sequence[Suspect]) -> None:
    """Refuse if one surveyed point explains the misfit nearly as well as another.

    With few points the tests of two go together, and the worse one need not be the wrong one.

    Raises
    ------
    Refusal
        ``site_inconsistent``.
    """
    points = [suspect for suspect in clean if suspect.point is not None]
    if len(points) < 2:
        return
    best = max(points, key=lambda suspect: suspect.chi2)
    others = {
        str(each.point)
        for each in points
        if each.point != best.point and each.chi2 > best.chi2 - SEPARABLE
    }
    if others:
        raise Refusal(
            "site_inconsistent",
            f"{' or '.join([str(best.point), *sorted(others)])} does not fit, and without any one "
            "of them all else does: check their coordinates, or survey one more point",
            {"points": ", ".join([str(best.point), *sorted(others)]), "chi2": best.chi2},
        )


def _suspects(site: Site, now: Adjusted) -> Iterator[Suspect]:
    """What to leave out by turns, each once: of the worst, what takes least along comes first.

    Without a pole its survey is gone, too, and without a recording all its poles: they explain
    whatever a single point does.
    """
    order = sorted(significant(now.tests), key=lambda test: 2 * test.freedom - test.chi2)
    found: dict[tuple[object, ...], Test] = {}
    for test in order:
        if test.kind == "lidar":
            continue
        key: tuple[object, ...] = ("pole", test.pole)
        if test.kind == "placement":
            key = ("placement", test.lidar, test.placement)
        elif test.kind != "pole":
            key = (test.kind, test.name)
        found.setdefault(key, test)
    # Two poles alone fit each other as badly, whichever moved; where they fit each other and not
    # the surroundings, only the tests of LiDARs and recordings show it.
    no_pole = not any(key[0] == "pole" for key in found)
    for link in find_links(now):
        if not link.is_checked and (no_pole or any(("pole", k) in found for k in link.poles)):
            for k in link.poles:
                own = [test for test in now.tests if test.kind == "pole" and test.pole == k]
                if own:
                    found.setdefault(("pole", k), max(own, key=lambda test: test.chi2))
    worst = list(found.values())[:MOST_LEFT_OUT]
    suspects: list[tuple[str, Test]] = [(test.kind, test) for test in worst]
    # A pole that only one LiDAR sees has no separate test: those of its ends replace it.
    of_end = {end.name: end.axis for end in now.datum.surveyed.ends}
    of_pole: dict[int, Test] = {}
    for test in sorted(worst, key=lambda test: test.kind != "pole"):
        pole = test.pole if test.kind == "pole" else of_end.get(test.name)
        if pole is not None and _is_surveyed(now.datum, pole):
            of_pole.setdefault(pole, replace(test, pole=pole))
    suspects += [("survey of a pole", test) for test in of_pole.values()]
    rank = TAKES_ALONG.index
    for kind, test in sorted(suspects, key=lambda s: rank(s[0]) if s[0] in TAKES_ALONG else -1):
        yield (
            _survey_of(site, now, test) if kind == "survey of a pole" else _suspect(site, now, test)
        )


def _is_surveyed(datum: Datum, pole: int) -> bool:
    """Whether both ends of a pole count, so that neither alone explains what both do."""
    return sum(end.axis == pole for end in datum.surveyed.ends) > 1


def _survey_of(site: Site, now: Adjusted, test: Test) -> Suspect:
    """Suspect all that was surveyed of a pole, which may be where the LiDARs see it."""
    assert test.pole is not None
    pole = now.datum.poles[test.pole]
    name = pole.name(site)
    ends = [end.name for end in now.datum.surveyed.ends if end.axis == test.pole]
    rest = now.datum.surveyed
    for end in ends:
        rest = without_survey(rest, end)
    return Suspect(
        Reason(
            "survey_outlier",
            f"{name} is not where it was surveyed (w {test.w:.1f}), and "
            f"{' and '.join(ends)} were left out: check their coordinates",
            {"w": test.w, "chi2": test.chi2, "observation": name, **place_of(site, pole)},
        ),
        replace(now.datum, surveyed=rest),
        test.chi2,
    )


def _suspect(site: Site, now: Adjusted, test: Test) -> Suspect:
    values: dict[str, float | int | str] = {"w": test.w, "chi2": test.chi2}
    if test.kind == "pole":
        assert test.pole is not None
        pole = now.datum.poles[test.pole]
        name = pole.name(site)
        seen = ", ".join(site.lidars[i].name for i in sorted(pole.seen))
        values |= place_of(site, pole)
        misfit = f"w {test.w:.1f}" if test.w > BLUNDER else "a pole that it checks does not fit"
        return Suspect(
            Reason(
                "pole_moved",
                f"{name} is not at one position for all that see it ({seen}; {misfit}), "
                "and was left out: did it move between the recordings?",
                values,
            ),
            without_poles(now.datum, {test.pole}),
            test.chi2,
        )
    if test.kind == "placement":
        lidar, placement = test.lidar, test.placement
        assert lidar is not None
        assert placement is not None
        values |= {"lidar": site.lidars[lidar].name, "placement": site.placements[placement]}
        return Suspect(
            Reason(
                "recording_left_out",
                f"the poles of {test.name} do not fit those of the other recordings (w "
                f"{test.w:.1f}), and were left out: was it recorded with that placement?",
                values,
            ),
            without_observations(now.datum, lidar, placement),
            test.chi2,
        )
    values["observation"] = test.name
    return Suspect(
        Reason(
            "survey_outlier",
            f"{test.name} does not fit (w {test.w:.1f}), and was left out: check its coordinates",
            values,
        ),
        replace(now.datum, surveyed=without_survey(now.datum.surveyed, test.name)),
        test.chi2,
        test.name.split(" as ")[0],
    )


def _conflicting(site: Site, pole: SharedPole, more: float) -> Reason:
    seen = ", ".join(site.lidars[i].name for i in sorted(pole.seen))
    return Reason(
        "pole_moved",
        f"{pole.name(site)} is not at one position for all that see it ({seen}): without it "
        f"{more:.0f} more patches of their surroundings coincide, and it was left out: did it "
        "move between the recordings?",
        {"more": more, "allowed": MORE_PATCHES, **place_of(site, pole)},
    )


def place_of(site: Site, pole: SharedPole) -> dict[str, float | int | str]:
    """Say which pole it is, and where its middle is in the frame of the site, metres."""
    at = pole.extent.mean(axis=0)
    return {
        "pole": pole.name(site),
        "placement": site.placements[pole.placement],
        **{f"at_{axis}_m": float(x) for axis, x in zip("xyz", at, strict=True)},
    }
