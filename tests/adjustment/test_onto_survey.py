"""How what the LiDARs see is laid on a survey, and when that is refused."""

import numpy as np
import pytest
from msgspec.structs import replace

from retropole.adjustment.shared import SharedPole
from retropole.adjustment.survey import (
    NEAR_SURVEYED,
    Fit,
    lay_on_survey,
    order,
    pole_at,
    transformed,
)
from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.base.description import ControlPoint, Frame, Sighting, Site, SiteLidar, SurveyedPole
from retropole.base.errors import Refusal
from tests.adjustment.adjusting import Steps

pytestmark = pytest.mark.full

FEET = np.array([[3.0, 0.0, 0.0], [-1.0, 3.0, 0.0], [1.0, -4.0, 0.0]])
LEANS = np.radians([[8.0, 0.0], [0.0, 25.0], [-15.0, 10.0]])


def poles(feet: Array = FEET, leans: Array = LEANS, length: float = 2.0) -> list[SurveyedPole]:
    found = []
    for k, (foot, (x, y)) in enumerate(zip(feet, leans, strict=True)):
        way = np.array([np.tan(x), np.tan(y), 1.0])
        top = foot + length * way / np.linalg.norm(way)
        found.append(SurveyedPole(f"P{k}", 0, foot, top, 0.005))
    return found


def seen(surveyed: list[SurveyedPole], T: Array) -> list[SharedPole]:
    """The same poles in another frame, all but their last 0.1 m."""
    found = []
    for k, each in enumerate(surveyed):
        assert each.foot is not None
        assert each.top is not None
        way = (each.top - each.foot) / np.linalg.norm(each.top - each.foot)
        extent = np.array([each.foot + 0.1 * way, each.top - 0.1 * way])
        pole = SharedPole(0, k + 1, {}, extent.mean(axis=0), way, extent)
        found.append(transformed(pole, se3.inverse(T)))
    return found


def site(known: list[SurveyedPole], points: tuple[ControlPoint, ...] = ()) -> Site:
    lidars = tuple(SiteLidar(str(i), (None,)) for i in range(2))
    frame = Frame("local", surveyed=True)
    return Site("site", lidars, ("1",), frame=frame, poles=tuple(known), points=points)


def laid(known: Site, found: list[SharedPole], poses: dict[int, Array] | None = None) -> Array:
    own = {0: np.eye(4), 1: np.eye(4)} if poses is None else poses
    return lay_on_survey(known, np.zeros((2, 3)), own, found).T


@pytest.mark.parametrize("seed", range(4))
def test_poles_are_laid_on_the_surveyed_ones(seed: int) -> None:
    T = se3.random(np.random.default_rng(seed))
    np.testing.assert_allclose(laid(site(poles()), seen(poles(), T)), T, atol=1e-5)
    # Others that nobody surveyed do no harm.
    more = poles(np.array([*FEET, [5.0, 5.0, 0.0]]), np.array([*LEANS, [0.3, 0.1]]))
    np.testing.assert_allclose(laid(site(poles()), seen(more, T)), T, atol=1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_control_points_are_laid_on_the_surveyed_ones(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T, T_1 = se3.random(rng), se3.random(rng)
    poses = {0: np.eye(4), 1: T_1}
    points = []
    for k in range(4):
        at = rng.uniform(-5, 5, 3)
        sights = tuple(
            Sighting(i, se3.apply(se3.inverse(T @ pose), at[None])[0], 0.005)
            for i, pose in poses.items()
        )
        points.append(ControlPoint(f"C{k}", at, 0.005, sights))
    np.testing.assert_allclose(laid(site([], tuple(points)), [], poses), T, atol=1e-9)
    # One that is off by a decimetre is to be found later, not to hide the frame.
    wrong = replace(points[0], at=points[0].at + 0.06)
    found = laid(site([], (wrong, *points[1:])), [], poses)
    assert se3.difference(found, T).translation < 0.5


def test_the_frame_does_not_depend_on_where_the_survey_counts_from() -> None:
    T = se3.random(np.random.default_rng(1))
    away = np.array([40.0, -25.0, 3.0])
    shifted = [replace(each, foot=each.foot + away, top=each.top + away) for each in poles()]
    found = laid(site(shifted), seen(poles(), T))
    np.testing.assert_allclose(found, se3.from_rt(np.eye(3), away) @ T, atol=1e-5)


def test_a_survey_of_another_place_is_refused() -> None:
    found = seen(poles(), se3.random(np.random.default_rng(0)))
    other = poles(FEET * [1.0, -1.7, 1.0], LEANS[::-1])
    with pytest.raises(Refusal) as refused:
        laid(site(other), found)
    assert refused.value.code == "survey_unmatched"
    with pytest.raises(Refusal) as refused:
        laid(site(poles()[:1]), found)
    assert refused.value.code == "survey_unmatched"


def test_two_poles_that_a_half_turn_exchanges_are_refused() -> None:
    leans = np.radians([[0.0, 20.0], [0.0, -20.0]])
    two = poles(np.array([[2.0, 0.0, 0.0], [-2.0, 0.0, 0.0]]), leans)
    found = seen(two, se3.random(np.random.default_rng(0)))
    with pytest.raises(Refusal) as refused:
        laid(site(two), found)
    assert refused.value.code == "survey_ambiguous"
    third = poles(np.array([*FEET[:2], [0.5, 3.0, 0.0]]))[2]
    T = se3.random(np.random.default_rng(2))
    np.testing.assert_allclose(laid(site([*two, third]), seen([*two, third], T)), T, atol=1e-5)


def test_the_pole_that_was_surveyed_is_the_one_there() -> None:
    known = poles()
    found = seen(known, np.eye(4))
    for each, pole in zip(known, found, strict=True):
        assert pole_at(each, found) is pole
        assert pole_at(replace(each, placement=1), found) is None
        assert pole_at(replace(each, foot=None), found) is pole
        assert each.foot is not None
        assert each.top is not None
        # Beyond its end, on the same line, is another pole.
        away = 3.0 * (each.top - each.foot)
        assert pole_at(replace(each, foot=each.foot + away, top=each.top + away), found) is None


def test_what_most_is_met_by_well_comes_first() -> None:
    """Not what one more is met by to half a metre, nor what little is met by exactly."""

    def fit(ends: int, rms: float) -> Fit:
        return Fit(np.eye(4), frozenset(), frozenset(), ends, rms)

    exact, drawn, chance = fit(10, 0.037), fit(11, 0.257), fit(4, 0.002)
    rough = fit(14, 0.12)
    assert sorted([drawn, chance, exact, rough], key=order) == [rough, exact, drawn, chance]
    assert order(fit(10, 0.01)) < order(fit(10, 0.02))
    # What is met at the limit is as good as nothing.
    assert order(fit(10, NEAR_SURVEYED))[0] == order(fit(0, 0.0))[0] == 0.0


def test_a_pole_in_another_frame_and_back(steps: Steps) -> None:
    T = se3.random(np.random.default_rng(0))
    for pole in steps.poles:
        back = transformed(transformed(pole, T), se3.inverse(T))
        np.testing.assert_allclose(back.point, pole.point, atol=1e-9)
        np.testing.assert_allclose(back.extent, pole.extent, atol=1e-9)
        assert back.length == pytest.approx(pole.length)
