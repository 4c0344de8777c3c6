"""A pole that moved, of two that alone link two LiDARs: poles fit, and the surroundings tell."""

from dataclasses import replace

import pytest

from retropole import se3
from retropole.site.blunders import SIGNIFICANT, without_blunders, worst_test
from retropole.site.contradiction import MORE, coinciding, denied_poles
from retropole.site.datum import Datum, without_poles
from retropole.site.relative import joint_of, relative
from tests.site.adjusting import Steps, made, off, steps_of


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


def test_of_a_sound_site_no_pole_is_denied(own: Steps) -> None:
    two = own.again(without_poles(own.datum, {2}))
    assert not list(denied_poles(two, own.again))
    before = coinciding(two.end)
    for k in (0, 1):
        one = own.again(without_poles(two.datum, {k}))
        assert coinciding(one.end) == pytest.approx(before, rel=0.002)


def test_how_certain_the_answer_is_has_no_part_in_what_coincides(own: Steps) -> None:
    end = own.adjusted.end
    unsure = replace(end, search=100 * end.search, inverse=100 * end.inverse)
    assert coinciding(unsure) == coinciding(end)
    assert coinciding(end, frozenset({0})) == coinciding(end)
    assert coinciding(end, frozenset({0, 1})) == 0.0


def test_three_poles_check_each_other(own: Steps) -> None:
    assert not list(denied_poles(own.adjusted, lambda datum: pytest.fail("adjusted again")))


@pytest.mark.parametrize(
    ("which", "gone", "by"), [(0, 2, 0.8), (0, 0, 0.4), (1, 0, 0.8), (1, 1, 0.4)]
)
def test_the_pole_that_moved_is_the_one_without_which_they_coincide(
    own: Steps, which: int, gone: int, by: float
) -> None:
    """Its own tests do not show it, and the pose is off by 0.3 m and more."""
    bad = own.again(displaced(without_poles(own.datum, {gone}), which, by))
    assert worst_test(bad.tests, SIGNIFICANT) is None
    sound = own.adjusted
    pose = relative(sound.end.T[0], sound.end.T[1], joint_of(sound.covariance, 0, 1))
    apart = se3.difference(pose.T_i_j, se3.inverse(bad.end.T[0]) @ bad.end.T[1])
    assert 0.3 < apart.translation < 0.9
    more = {k: more for k, _, more in denied_poles(bad, own.again)}
    assert max(more, key=lambda k: more[k]) == which
    assert MORE < more[which] < 20
    left, (reason,) = without_blunders(own.site, bad, own.again)
    assert reason.code == "pole_moved"
    assert reason.values["pole"] == bad.datum.poles[which].name(own.site)
    assert off(pose, se3.inverse(left.end.T[0]) @ left.end.T[1]) < 12.6


def test_of_two_suspects_that_leave_what_fits_the_surroundings_tell(own: Steps) -> None:
    """Poles that do not fit, where without the right one the rest fits as well."""
    bad = own.again(displaced(without_poles(own.datum, {1}), 1, 0.2))
    assert worst_test(bad.tests, SIGNIFICANT) is not None
    assert worst_test(own.again(without_poles(bad.datum, {0})).tests) is None
    left, (reason,) = without_blunders(own.site, bad, own.again)
    assert reason.values["pole"] == bad.datum.poles[1].name(own.site)
    assert coinciding(left.end) > 1.1 * coinciding(bad.end)
