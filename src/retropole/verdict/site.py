"""Weaknesses of an accepted answer for a site, and observations that conflict with it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ..adjustment.agreement import check_radius
from ..adjustment.answer import LidarPose, LoopClosure
from ..adjustment.blunders import place_of, worst_test
from ..adjustment.site import Adjusted, find_links
from ..adjustment.snooping import POOR
from ..base import se3
from ..base.datatypes import Array, Hypothesis, Match, Placement, Test
from ..base.description import Site
from ..base.errors import Reason, Refusal, refusing_of
from ..base.quantities import at_most
from ..base.uncertainty.confirmation import Confirmation
from ..base.uncertainty.purpose import USABLE, Fitness, fitness, is_certainly_met
from ..hypotheses.choice import ambiguous
from ..hypotheses.correspondence import MIN_ANGLE, widest_angle
from ..hypotheses.evidence import MAX_WRONG, check_confirmation, confirm
from ..hypotheses.joint_choice import Choices, where_they_differ
from ..hypotheses.pairs import Pair
from ..hypotheses.placements import PairedPlacement
from ..hypotheses.scans import SiteScans
from . import check_angles, check_noise, check_returns, check_sensor, check_sway

LOOP_SIGNIFICANCE = 1e-5
"""A loop is open if the probability of a misclosure of its size by chance is smaller than this."""

CHECKED = 0.01
"""Least redundancy of one of a LiDAR's recordings: below, there is no check of its pose. A
precise LiDAR among coarse ones has 0.04 to 0.09 (benchmarks/real_site.py), and is checked."""


def check_decided(
    site: Site, choices: Choices, pairs: Sequence[Pair], poles: Sequence[Array]
) -> None:
    """Refuse if several choices of the hypotheses are equally consistent.

    Raises
    ------
    Refusal
        ``ambiguous_loop``; of two LiDARs ``ambiguous``.
    """
    if choices.complete and not choices.rivals:
        return
    if not choices.rivals:
        raise Refusal(
            "ambiguous_loop",
            "too many arrangements of the LiDARs are possible to distinguish them; add a pole or a "
            "placement that several of them see",
            {"rivals": 0},
        )
    if len(site.lidars) == 2:
        best, *others = pairs[0].standing
        raise ambiguous(best, others)
    moved = sorted(
        {i for one in choices.rivals for i in where_they_differ(choices.best, one, poles)}
    )
    names = [site.lidars[i].name for i in moved]
    loop = _loop_through(moved, pairs)
    around = "" if loop is None else " around " + " – ".join(site.lidars[i].name for i in loop)
    raise Refusal(
        "ambiguous_loop",
        f"{1 + len(choices.rivals)} arrangements fit equally well{around}; they differ in "
        f"{', '.join(names)}: lean the poles so that no half turn maps them onto each other, or "
        "add another pole that these LiDARs see with others",
        {"rivals": len(choices.rivals), "lidars": ", ".join(names)},
    )


def _loop_through(moved: Sequence[int], pairs: Sequence[Pair]) -> list[int] | None:
    """A LiDAR that may have another pose, with those that see poles in common with it."""
    for i in moved:
        others = [
            a if b == i else b
            for a, b in (pair.lidars for pair in pairs if pair.hypotheses)
            if i in (a, b)
        ]
        if len(others) > 1:
            return [others[0], i, *others[1:]]
    return None


def confirm_links(
    site: Site, scans: SiteScans, adjusted: Adjusted, pairs: Sequence[Pair]
) -> Iterator[Reason]:
    """Check the poses against the objects in the scenes, for every link between LiDARs.

    Yields
    ------
    Reason
        ``not_confirmed`` if two poles alone link some LiDARs to all others, and the scene does
        not confirm the link.

    Raises
    ------
    Refusal
        ``scene_contradicts``.
    """
    by_lidars = {pair.lidars: pair for pair in pairs}
    for link in find_links(adjusted):
        key = link.lidars
        found = _confirmation(scans, adjusted, by_lidars[key])
        names = f"{site.lidars[key[0]].name} and {site.lidars[key[1]].name}"
        with refusing_of(names):
            check_confirmation(found)
        wrong = found.probability_wrong
        if wrong is not None and wrong > MAX_WRONG and not link.is_checked:
            poles = "two poles alone link" if len(link.poles) > 1 else "one pole alone links"
            yield Reason(
                "not_confirmed",
                f"{poles} {names}, and the surroundings do not decide (chance of a "
                f"wrong pose {100 * wrong:.0f} %): add a pole or a placement that both see",
                {"lidars": names, "probability_wrong": wrong, "allowed": MAX_WRONG},
            )


def _confirmation(scans: SiteScans, adjusted: Adjusted, pair: Pair) -> Confirmation:
    """Count the objects in the scenes of two LiDARs that agree under their adjusted poses and
    others."""
    i, j = pair.lidars
    T = se3.inverse(adjusted.end.T[i]) @ adjusted.end.T[j]
    shared = [pole for pole in adjusted.datum.poles if {i, j} <= pole.seen.keys()]
    paired = []
    for p, (target, source) in enumerate(zip(scans.by_lidar[i], scans.by_lidar[j], strict=True)):
        if target is None or source is None:
            continue
        pairs = tuple(
            (_index(target.poles, pole.seen[i]), _index(source.poles, pole.seen[j]))
            for pole in shared
            if pole.placement == p
        )
        match = Match(pairs, T, 0.0, True, True, np.eye(6))
        own = Hypothesis(match, None, None, 0.0, 0.0, 0.0)
        paired.append(PairedPlacement(Placement(target, source), own))
    if len(scans.by_lidar) > 2:
        # The poles of many placements check each other: the surroundings are compared once.
        paired = [max(paired, key=lambda each: len(each.hypothesis.match.pairs))]
    # A hypothesis that does not recur in all placements is not a rival.
    most = max((len(each.poles) for each in pair.hypotheses), default=0)
    recurring = [each for each in pair.hypotheses if len(each.poles) == most]
    # All other angles about a pole are compared, if the angle is from the surroundings.
    rivals = recurring if pair.by_place else recurring[:4]
    others = [each for each in rivals if _is_other(each.T, T)]
    return confirm(paired, T, others, np.random.default_rng(0), trusted=len(shared) > 2)


def _index(poles: Sequence[object], pole: object) -> int:
    return next(k for k, each in enumerate(poles) if each is pole)


def _is_other(T: Array, answer: Array) -> bool:
    apart = se3.difference(T, answer)
    return apart.rotation > 0.2 or apart.translation > 1.0


def weaknesses(
    site: Site,
    scans: SiteScans,
    adjusted: Adjusted,
    loops: Sequence[LoopClosure],
    lidars: Sequence[LidarPose],
) -> Iterator[Reason]:
    """Report weaknesses of an answer: open loops, poses without a check, poses that are not
    accurate."""
    yield from _by_lidars(site, scans, adjusted)
    yield from radius_conflict(adjusted)
    yield from poor_fit(site, adjusted)
    yield from _open_loops(site, loops)
    yield from _unchecked(site, adjusted.tests)
    if not adjusted.converged:
        yield Reason(
            "not_converged",
            f"the poses still moved after {adjusted.end.iterations} iterations; record more frames",
            {"stage": "site", "iterations": adjusted.end.iterations},
        )
    yield from not_fit(site, lidars)


def radius_conflict(adjusted: Adjusted) -> Iterator[Reason]:
    """Report a conflict of the returns with the given radius."""
    return check_radius(adjusted.aligned.radius, adjusted.aligned.radius_conflict)


def _by_lidars(site: Site, scans: SiteScans, adjusted: Adjusted) -> Iterator[Reason]:
    """Report weaknesses of the poles of single LiDARs, and of pairs that they link."""
    poles = adjusted.datum.poles
    noise = np.exp(adjusted.aligned.maximum.point.log_noise[:, 0])
    for i, lidar in enumerate(site.lidars):
        for scan in scans.used(i)[:1]:
            yield from check_sensor(lidar.name, scan)
        yield from check_sway(lidar.name, scans.used(i))
        seen = [pole.seen[i] for pole in poles if i in pole.seen]
        if seen:
            yield from check_returns(lidar.name, seen)
            yield from check_noise(lidar.name, lidar.sensor, float(noise[i]))
    reported = list(_by_place(site, adjusted))
    by_place = {link for link, _ in reported}
    for link in find_links(adjusted):
        names = f"{site.lidars[link.lidars[0]].name} and {site.lidars[link.lidars[1]].name}"
        # For poles that do not determine the whole pose, the note below states it.
        if len(link.poles) > 1 and link.lidars not in by_place:
            yield from check_angles([poles[k].direction for k in link.poles], names)
    yield from (reason for _, reason in reported)
    yield from _doubtful(site, scans, adjusted)


def _by_place(site: Site, adjusted: Adjusted) -> Iterator[tuple[tuple[int, int], Reason]]:
    """Report the pairs for which a part of the pose is from the surroundings."""
    poles = adjusted.datum.poles
    for each in adjusted.datum.dependent:
        across = each.across(poles)
        if len(across) > 1 and widest_angle([poles[k].direction for k in across]) >= MIN_ANGLE:
            # With the observations of other LiDARs the poles determine the whole pose.
            continue
        hang = ", ".join(site.lidars[i].name for i in sorted(each.lidars))
        link = "one pole links" if len(across) == 1 else f"{len(across)} poles, all parallel, link"
        i, j = sorted((each.near, each.far))
        yield (
            (i, j),
            Reason(
                "by_place",
                f"{link} {hang} to the others, by {each.names(site)}: the poles do not determine "
                "the whole pose, the rest is from the surroundings; a second pole that leans by "
                "15° or more against the first would check it",
                {"lidars": hang, "poles": len(across)},
            ),
        )


def _doubtful(site: Site, scans: SiteScans, adjusted: Adjusted) -> Iterator[Reason]:
    """Report how many of each LiDAR's poles are doubtful by themselves."""
    counts = {}
    for i, lidar in enumerate(site.lidars):
        own = [pole for scan in scans.used(i) for pole in scan.candidates]
        seen = [pole.seen[i] for pole in adjusted.datum.poles if i in pole.seen]
        count = sum(any(pole is each for each in own) for pole in seen)
        if count:
            counts[lidar.name] = count
    if counts:
        those = ", ".join(f"{count} of {name}'s" for name, count in counts.items())
        yield Reason(
            "doubtful_poles",
            f"{those} poles are doubtful, near a wall, next to a bright object, with "
            "few returns or dim tape; other LiDARs see the same poles, and the scenes coincide",
            {"poles": sum(counts.values()), "lidars": ", ".join(counts)},
        )


def poor_fit(site: Site, adjusted: Adjusted, *, of_two: bool = False) -> Iterator[Reason]:
    """Report the observation that fits worst, if one fits poorly and none was left out for it.

    For a pair (`of_two`), the agreement of scene and poles is more informative than the test of
    either.
    """
    # A LiDAR's test contains those of all its poles: reported if none of them is more specific.
    single = [test for test in adjusted.tests if test.kind != "lidar"]
    worst = worst_test(single, POOR) or worst_test(() if of_two else adjusted.tests, POOR)
    if worst is None:
        return
    values: dict[str, float | int | str] = {"w": worst.w, "chi2": worst.chi2, "allowed": POOR}
    if worst.pole is not None:
        values |= place_of(site, adjusted.datum.poles[worst.pole])
    why = "did a pole move slightly, or is the LiDAR worse than its data sheet?"
    surveyed = worst.pole is not None and adjusted.datum.poles[worst.pole].surveyed is not None
    if worst.kind in ("survey", "control point"):
        why = "check its coordinates"
    elif surveyed:
        why = "did it move slightly, or is its survey slightly wrong?"
    yield Reason(
        "misfit",
        f"{worst.name} fits the others poorly (w {worst.w:.1f}, {POOR:g} expected at most): " + why,
        {"observation": worst.name, **values},
    )


def _open_loops(site: Site, loops: Sequence[LoopClosure]) -> Iterator[Reason]:
    found = [loop for loop in loops if loop.probability < LOOP_SIGNIFICANCE]
    if found:
        worst = max(found, key=lambda loop: loop.chi2)
        names = " – ".join(site.lidars[i].name for i in worst.lidars)
        yield Reason(
            "loop_open",
            f"{len(found)} of {len(loops)} loops do not close; worst is {names}, by "
            f"{np.degrees(worst.rotation):.3f}° and {1000 * worst.translation:.1f} mm (χ² "
            f"{worst.chi2:.0f} with {worst.freedom} degrees of freedom)",
            {"loops": len(found), "chi2": worst.chi2, "allowed": LOOP_SIGNIFICANCE},
        )


def _unchecked(site: Site, tests: Sequence[Test]) -> Iterator[Reason]:
    for i, lidar in enumerate(site.lidars):
        own = [test.redundancy for test in tests if test.kind == "placement" and test.lidar == i]
        if own and max(own) < CHECKED:
            yield Reason(
                "not_checked",
                f"there is no check of {lidar.name} (redundancy {max(own):.2f}): a gross error "
                "there would not be detected; add a pole, a placement, or a LiDAR that sees the "
                "same poles",
                {"lidar": lidar.name, "redundancy": max(own), "needed": CHECKED},
            )


def fitness_of(site: Site, covariance: Array) -> Fitness | None:
    """Whether a pose is as accurate as required; None if nothing was required, and it is usable."""
    if site.need is None and is_certainly_met(covariance, USABLE):
        return None
    return fitness(covariance, site.need or USABLE)


def not_fit(
    site: Site,
    lidars: Sequence[LidarPose],
    helps: str = "a placement with the poles arranged differently",
) -> Iterator[Reason]:
    """Report the poses that are not as accurate as required, and what `helps`."""
    short = [one for one in lidars if one.fitness is not None and one.fitness.answer != "yes"]
    if not short:
        return
    worst = min(short, key=lambda one: one.fitness.probability if one.fitness else 1.0)
    fit = worst.fitness
    assert fit is not None
    bound = "" if fit.bound_m is None else f"; 95 % sure: within {at_most(fit.bound_m)}"
    names = ", ".join(site.lidars[one.lidar].name for one in short)
    yield Reason(
        "not_fit_for_purpose",
        f"{names}: {fit.words}{bound}; what would help: {helps}",
        {
            "lidars": names,
            "within_m": fit.within_m,
            "at_m": fit.at_m,
            "probability": fit.probability,
        },
    )
