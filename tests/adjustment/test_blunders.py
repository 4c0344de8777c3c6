"""Blunders: named, left out, and what is left is adjusted as if they had never been there."""

from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs

from retropole.adjustment import blunders
from retropole.adjustment.agreement import WARN_MAHALANOBIS_SQ
from retropole.adjustment.answer import SiteCalibration
from retropole.adjustment.blunders import (
    BLUNDER,
    MORE_PATCHES,
    Suspect,
    _likeliest,
    conflicting_poles,
    more_coincide,
    significant,
    without_blunders,
    worst_test,
)
from retropole.adjustment.datum import Datum, without_poles
from retropole.adjustment.site import Adjusted, Recorded
from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.base.description import Site
from retropole.base.errors import Reason, Refusal
from retropole.base.se3 import joint_of, relative
from retropole.pipeline import calibrate_site
from retropole.simulation.sites import SimulatedSite, Survey
from tests.adjustment.adjusting import (
    Steps,
    between,
    made,
    made_wrong,
    off,
    poses_of,
    steps_of,
    with_lidar,
)
from tests.tiers import first_of

pytestmark = pytest.mark.full

FIVE_SIGMA = 39.6
"""χ² with 6 degrees of freedom is above this as often as a normal number beyond five σ."""


def check_true(found: SiteCalibration, simulated: SimulatedSite) -> None:
    for i, j in ((0, 1), (0, 2), (1, 2)):
        true = se3.inverse(simulated.T_world_lidar[i]) @ simulated.T_world_lidar[j]
        assert off(between(found, i, j), true) < FIVE_SIGMA


def test_a_sound_site_has_none(steps: Steps) -> None:
    assert worst_test(steps.adjusted.tests) is None
    left, reasons = without_blunders(steps.recorded, steps.adjusted)
    assert left is steps.adjusted
    assert not reasons


def test_a_pole_that_was_bumped_is_named_and_left_out() -> None:
    simulated, blunder = made_wrong("pole")
    assert blunder.pole is not None
    found = calibrate_site(simulated.as_site())
    assert found.status == "warn"
    (reason,) = (each for each in found.reasons if each.code == "pole_moved")
    assert reason.values["placement"] == simulated.placements[blunder.placements[0]]
    assert float(reason.values["w"]) > BLUNDER
    # It is not among those that are left, the others are.
    bumped = simulated.poles[blunder.placements[0]][blunder.pole]
    T = simulated.T_world_lidar[0]
    beside = [
        float(np.linalg.norm(np.cross(se3.apply(T, pole.point[None])[0] - bumped.centre,
                                      bumped.axis)))
        for pole in found.poles
        if pole.placement == blunder.placements[0]
    ]  # fmt: skip
    assert len(beside) == 2
    assert min(beside) > 0.2
    check_true(found, simulated)


def moved_point(site: Site, by: Array) -> Site:
    first, *others = site.points
    return replace(site, points=(structs.replace(first, at=first.at + by), *others))


def test_a_control_point_that_is_off_is_named_and_left_out(
    simulated_survey: SimulatedSite, surveyed: Steps
) -> None:
    site = moved_point(simulated_survey.as_site(), np.array([0.06, -0.06, 0.05]))
    found = calibrate_site(site)
    assert found.status == "warn"
    (reason,) = (each for each in found.reasons if each.code == "survey_outlier")
    assert reason.values["observation"] == "C1"
    check_true(found, simulated_survey)
    # Nearly as if it had not been surveyed at all.
    sound = surveyed.adjusted
    for i, T in enumerate(poses_of(found)):
        own = sound.covariance[6 * i : 6 * i + 6, 6 * i : 6 * i + 6]
        step = se3.local(sound.end.T[i], T)
        assert step @ np.linalg.solve(own, step) < 6.0


def test_one_lidars_wrong_recording_of_a_placement_is_left_out(steps: Steps) -> None:
    """All of its poles elsewhere. Which of two it is that differ, poles alone do not tell."""
    tilt = se3.from_rt(se3.exp_so3(np.radians([1.2, -1.2, 1.2])), np.array([0.06, 0.06, 0.0]))
    poles = []
    for pole in steps.datum.poles:
        seen = dict(pole.seen)
        if pole.placement == 0 and 2 in seen:
            own = seen[2]
            seen[2] = replace(
                own,
                xyz=se3.apply(tilt, own.xyz),
                point=se3.apply(tilt, own.point[None])[0],
                direction=tilt[:3, :3] @ own.direction,
            )
        poles.append(replace(pole, seen=seen))
    datum = replace(steps.datum, poles=poles)
    first = replace(steps, scenes=[]).again(datum)
    found = {(test.kind, test.lidar, test.placement) for test in significant(first.tests)}
    assert ("placement", 2, 0) in found
    left, reasons = without_blunders(replace(steps, scenes=[]).recorded, first)
    (reason,) = reasons
    assert reason.code == "recording_left_out"
    assert reason.values["lidar"] == "posts-3"
    assert reason.values["placement"] in ("1", "2")
    assert not significant(left.tests)
    # The other LiDARs are where they were.
    end, sound = left.end, steps.adjusted
    pose = relative(sound.end.T[0], sound.end.T[1], joint_of(left.covariance, 0, 1))
    assert off(pose, se3.inverse(end.T[0]) @ end.T[1]) < FIVE_SIGMA


def test_what_nothing_explains_is_refused(steps: Steps, monkeypatch: pytest.MonkeyPatch) -> None:
    """Everything that is left out leaves the rest as bad as it was."""
    tests = tuple(replace(test, w=20.0, chi2=500.0) for test in steps.adjusted.tests)
    bad = replace(steps.adjusted, tests=tests)
    monkeypatch.setattr(blunders, "adjust", lambda *_, **__: bad)
    with pytest.raises(Refusal) as refused:
        without_blunders(steps.recorded, bad)
    assert refused.value.code == "site_inconsistent"


def test_refusals_of_what_is_left_are_no_answer(
    steps: Steps, monkeypatch: pytest.MonkeyPatch
) -> None:
    worst = max(
        (test for test in steps.adjusted.tests if test.kind == "pole"),
        key=lambda test: test.chi2,
    )
    tests = tuple(
        replace(test, w=9.0, chi2=100.0) if test is worst else test for test in steps.adjusted.tests
    )

    def adjust(*_: object, **__: object) -> None:
        raise Refusal("degenerate_poles", "nothing is left")

    monkeypatch.setattr(blunders, "adjust", adjust)
    with pytest.raises(Refusal) as refused:
        without_blunders(steps.recorded, replace(steps.adjusted, tests=tests))
    assert refused.value.code == "site_inconsistent"


def only_seen_by(site: Site, simulated: SimulatedSite, lidar: int, pole: int) -> Site:
    """Take a pole of the first placement out of the recordings of all other LiDARs."""
    label = len(simulated.surroundings) + pole
    for i, (own, labels) in enumerate(zip(site.lidars, simulated.labels, strict=True)):
        (first, second), (where, _) = own.clouds, labels
        assert first is not None
        assert where is not None
        if i != lidar:
            site = with_lidar(site, i, clouds=(first.select(where != label), second))
    return site


def test_a_surveyed_pole_that_one_lidar_alone_sees_is_named_as_a_whole() -> None:
    """It has no test of its own as a pole, and neither end explains what both do."""
    pole, simulated = 1, made(survey=Survey((0, 1)))
    site = only_seen_by(simulated.as_site(), simulated, 1, pole)
    poles = list(site.poles)
    foot, top = poles[pole].foot, poles[pole].top
    assert foot is not None
    assert top is not None
    across = np.cross(top - foot, [0.0, 0.0, 1.0])
    by = 0.2 * across / np.linalg.norm(across)
    poles[pole] = structs.replace(poles[pole], foot=foot + by, top=top + by)
    found = calibrate_site(replace(site, poles=tuple(poles)))
    told = [each for each in found.reasons if each.code in ("survey_outlier", "survey_unmet")]
    assert [each.values["observation"] for each in told] == [poles[pole].name]
    assert not {each.code for each in found.reasons} & {"pole_moved", "recording_left_out"}
    check_true(found, simulated)


def test_an_end_of_a_surveyed_pole_that_is_off_is_never_absorbed() -> None:
    simulated = made(survey=Survey((0,), 4))
    site = simulated.as_site()
    first, *others = site.poles
    assert first.foot is not None
    assert first.top is not None
    across = np.cross(first.top - first.foot, [0.0, 0.0, 1.0])
    wrong = structs.replace(first, top=first.top + 0.1 * across / np.linalg.norm(across))
    found = calibrate_site(replace(site, poles=(wrong, *others)))
    assert found.status != "ok"
    assert any(first.name in reason.message for reason in found.reasons)
    check_true(found, simulated)


def test_where_nothing_alone_leaves_what_fits_the_worst_of_equals_is_it(steps: Steps) -> None:
    """Two blunders: without either the other is left, and what hardly fits is not the first."""

    def suspect(chi2: float) -> Suspect:
        return Suspect(Reason("survey_outlier", "", {}), steps.datum, chi2, f"C{chi2:g}")

    one, other, third = suspect(65.0), suspect(106.0), suspect(200.0)
    tried = [(64.0, steps.adjusted, one), (66.0, steps.adjusted, other)]
    assert _likeliest([*tried, (107.0, steps.adjusted, third)])[1] is other
    assert _likeliest([*tried, (0.0, steps.adjusted, third)])[1] is third


def test_poles_that_nothing_distinguishes_are_both_named(steps: Steps) -> None:
    """Without either all fits, no surface coincides, and the poses are others."""
    rest = replace(steps.adjusted, end=replace(steps.adjusted.end, scene=()))
    step = np.zeros(6)
    step[3] = 0.2
    moved = np.stack([rest.end.T[0], *(se3.retract(T, step) for T in rest.end.T[1:])])
    other = replace(rest, end=replace(rest.end, T=moved))
    suspects = [
        Suspect(Reason("pole_moved", name, {"pole": name}), steps.datum, 50.0)
        for name in ("pole 1", "pole 2")
    ]
    with pytest.raises(Refusal, match="pole 1 or pole 2 moved") as refused:
        _likeliest([(0.0, rest, suspects[0]), (0.0, other, suspects[1])])
    assert refused.value.code == "site_inconsistent"
    assert float(refused.value.values["chi2"]) > WARN_MAHALANOBIS_SQ
    same = _likeliest([(0.0, rest, suspects[0]), (0.0, rest, suspects[1])])
    assert same == (rest, suspects[0])


@pytest.fixture(scope="module")
def own() -> Steps:
    return steps_of(made(seed=3, lidars=2, placements=1).as_site())


def displaced(datum: Datum, which: int, by: float) -> Datum:
    """Move one of two poles, as the second LiDAR sees it, along the axis of the other.

    Neither their angle nor their distance changes: by themselves they fit as before.
    """
    along = by * datum.poles[1 - which].seen[1].direction
    poles = list(datum.poles)
    pole = poles[which].seen[1]
    moved = replace(pole, xyz=pole.xyz + along, point=pole.point + along)
    poles[which] = replace(poles[which], seen={**poles[which].seen, 1: moved})
    return replace(datum, poles=poles)


def test_of_a_sound_site_no_pole_is_conflicting(
    own: Steps, monkeypatch: pytest.MonkeyPatch
) -> None:
    two = own.again(without_poles(own.datum, {2}))

    def by_few(recorded: Recorded, datum: Datum, *, few: bool = False) -> Adjusted:
        assert few, "a part of the patches is enough to see that nothing moved"
        return own.again(datum, few=few)

    monkeypatch.setattr(blunders, "adjust", by_few)
    assert not list(conflicting_poles(own.recorded, two))
    for k in (0, 1):
        one = own.again(without_poles(two.datum, {k}))
        assert more_coincide(two.end, one.end) == 0.0


def test_how_certain_the_answer_is_has_no_part_in_what_coincides(own: Steps) -> None:
    end = own.adjusted.end
    away = np.stack([end.T[0], se3.retract(end.T[1], np.array([0, 0, 0, 0.3, 0.2, 0.1]))])
    off_by = replace(end, T=away)
    more = more_coincide(off_by, end)
    assert more > 100
    unsure = replace(end, search=100 * end.search, inverse=100 * end.inverse)
    assert more_coincide(replace(unsure, T=away), unsure) == more
    assert more_coincide(end, off_by) == 0.0
    assert more_coincide(end, end) == 0.0
    assert more_coincide(off_by, end, frozenset({0})) == more
    assert more_coincide(off_by, end, frozenset({0, 1})) == 0.0


def test_what_both_place_alike_does_not_tell(own: Steps) -> None:
    """A step of a few centimetres is no blunders, whichever way it goes."""
    end = own.adjusted.end
    for axis in range(3):
        step = np.zeros(6)
        step[3 + axis] = 0.03
        near = replace(end, T=np.stack([end.T[0], se3.retract(end.T[1], step)]))
        assert more_coincide(near, end) == more_coincide(end, near) == 0.0


def test_three_poles_check_each_other(own: Steps, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(blunders, "adjust", lambda *_, **__: pytest.fail("again"))
    assert not list(conflicting_poles(own.recorded, own.adjusted))


@pytest.mark.parametrize(("which", "gone", "by"), first_of([(0, 2, 0.8), (1, 1, 0.4)]))
def test_the_pole_that_moved_is_the_one_without_which_they_coincide(
    own: Steps, which: int, gone: int, by: float
) -> None:
    """Its own tests do not show it, and the pose is off by 0.3 m and more."""
    bad = own.again(displaced(without_poles(own.datum, {gone}), which, by))
    sound = own.adjusted
    pose = relative(sound.end.T[0], sound.end.T[1], joint_of(sound.covariance, 0, 1))
    apart = se3.difference(pose.T_i_j, se3.inverse(bad.end.T[0]) @ bad.end.T[1])
    assert 0.3 < apart.translation < 0.9
    more = {k: more for k, _, more in conflicting_poles(own.recorded, bad)}
    assert max(more, key=lambda k: more[k]) == which
    assert MORE_PATCHES < more[which] < 2000
    left, (reason,) = without_blunders(own.recorded, bad)
    assert reason.code == "pole_moved"
    assert reason.values["pole"] == bad.datum.poles[which].name(own.site)
    assert off(pose, se3.inverse(left.end.T[0]) @ left.end.T[1]) < 12.6


def test_where_a_part_of_the_patches_holds_too_little_all_of_them_are_taken(
    own: Steps, monkeypatch: pytest.MonkeyPatch
) -> None:
    bad = own.again(displaced(without_poles(own.datum, {2}), 0, 0.8))

    def refused_by_few(recorded: Recorded, datum: Datum, *, few: bool = False) -> Adjusted:
        if few:
            raise Refusal("degenerate_poles", "too little of the surroundings")
        return own.again(datum)

    monkeypatch.setattr(blunders, "adjust", refused_by_few)
    assert 0 in {k for k, _, _ in conflicting_poles(own.recorded, bad)}


def test_little_else_than_ground_tells() -> None:
    """Nearly all that is seen coincides as well where the pose is 0.18 m off."""
    steps = steps_of(made(seed=9, lidars=2, placements=1).as_site())
    bad = steps.again(displaced(without_poles(steps.datum, {0}), 1, 0.2))
    left, (reason,) = without_blunders(steps.recorded, bad)
    assert reason.values["pole"] == bad.datum.poles[1].name(steps.site)
    sound = steps.adjusted
    pose = relative(sound.end.T[0], sound.end.T[1], joint_of(sound.covariance, 0, 1))
    assert off(pose, se3.inverse(left.end.T[0]) @ left.end.T[1]) < 12.6


def test_of_two_suspects_that_leave_what_fits_the_surroundings_tell(own: Steps) -> None:
    """Poles that do not fit, where without the right one the rest fits as well."""
    bad = own.again(displaced(without_poles(own.datum, {1}), 1, 0.2))
    assert worst_test(bad.tests, BLUNDER) is not None
    assert worst_test(own.again(without_poles(bad.datum, {0})).tests) is None
    left, (reason,) = without_blunders(own.recorded, bad)
    assert reason.values["pole"] == bad.datum.poles[1].name(own.site)
    assert more_coincide(bad.end, left.end) > MORE_PATCHES
