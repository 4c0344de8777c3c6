"""A pole that moved, of two that alone link two LiDARs: poles fit, and the surroundings tell."""

from dataclasses import replace

import numpy as np
import pytest

from retropole.adjustment import contradiction
from retropole.adjustment.blunders import BLUNDER, without_blunders, worst_test
from retropole.adjustment.contradiction import MORE_PATCHES, conflicting_poles, more_coincide
from retropole.adjustment.datum import Datum, without_poles
from retropole.adjustment.site import Adjusted, Recorded
from retropole.base import se3
from retropole.base.errors import Refusal
from retropole.base.se3 import joint_of, relative
from tests.adjustment.adjusting import Steps, made, off, steps_of
from tests.tiers import first_of

pytestmark = pytest.mark.full


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

    monkeypatch.setattr(contradiction, "adjust", by_few)
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
    """A step of a few centimetres is no contradiction, whichever way it goes."""
    end = own.adjusted.end
    for axis in range(3):
        step = np.zeros(6)
        step[3 + axis] = 0.03
        near = replace(end, T=np.stack([end.T[0], se3.retract(end.T[1], step)]))
        assert more_coincide(near, end) == more_coincide(end, near) == 0.0


def test_three_poles_check_each_other(own: Steps, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(contradiction, "adjust", lambda *_, **__: pytest.fail("again"))
    assert not list(conflicting_poles(own.recorded, own.adjusted))


@pytest.mark.parametrize(
    ("which", "gone", "by"), first_of([(0, 2, 0.8), (0, 0, 0.4), (1, 0, 0.8), (1, 1, 0.4)])
)
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

    monkeypatch.setattr(contradiction, "adjust", refused_by_few)
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
