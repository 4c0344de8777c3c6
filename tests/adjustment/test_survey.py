"""How what the LiDARs see is laid on a survey, and when that is refused."""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from msgspec.structs import replace

from retropole.adjustment.shared import SharedPole
from retropole.adjustment.survey import (
    Fit,
    align_to_survey,
    list_unmet,
    order,
    pole_at,
    transformed,
)
from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.base.description import ControlPoint, Frame, Sighting, Site, SiteLidar, SurveyedPole
from retropole.base.errors import Reason, Refusal
from retropole.surfaces.visibility import OVERLAP_DISTANCE
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
    return align_to_survey(known, np.zeros((2, 3)), own, found).T


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
    assert order(fit(10, OVERLAP_DISTANCE))[0] == order(fit(0, 0.0))[0] == 0.0


def test_a_pole_in_another_frame_and_back(steps: Steps) -> None:
    T = se3.random(np.random.default_rng(0))
    for pole in steps.poles:
        back = transformed(transformed(pole, T), se3.inverse(T))
        np.testing.assert_allclose(back.point, pole.point, atol=1e-9)
        np.testing.assert_allclose(back.extent, pole.extent, atol=1e-9)
        assert back.length == pytest.approx(pole.length)


POSES = {0: np.eye(4), 1: se3.random(np.random.default_rng(9))}
PLACES = np.array(
    [[4.0, 1.0, 0.3], [-3.0, 5.0, 2.5], [-5.0, -2.0, 1.1], [2.0, -6.0, 2.9], [6.0, 6.0, 1.6]]
)

ASIDE = np.array([1.0, 0.0, 0.0])


def points(T: Array) -> list[ControlPoint]:
    """Targets that both LiDARs see, whose frame lies at T in that of the survey."""
    found = []
    for k, at in enumerate(PLACES):
        sights = tuple(
            Sighting(i, se3.apply(se3.inverse(T @ pose), at[None])[0], 0.005)
            for i, pose in POSES.items()
        )
        found.append(ControlPoint(f"C{k}", at, 0.005, sights))
    return found


def told(known: Site, there: list[SharedPole]) -> tuple[Array, list[Reason]]:
    origins = np.zeros((2, 3))
    fit = align_to_survey(known, origins, POSES, there)
    return fit.T, list(list_unmet(known, origins, POSES, there, fit))


def written(
    by: Callable[[Array], Array], surveyed: list[SurveyedPole], known: list[ControlPoint]
) -> tuple[list[SurveyedPole], list[ControlPoint]]:
    """Write a survey with other coordinates."""
    for each in surveyed:
        assert each.foot is not None
        assert each.top is not None
    return (
        [replace(each, foot=by(each.foot), top=by(each.top)) for each in surveyed],  # type: ignore[arg-type]
        [replace(each, at=by(each.at)) for each in known],
    )


@pytest.mark.parametrize("seed", range(3))
def test_a_sound_survey_is_met(seed: int) -> None:
    T = se3.random(np.random.default_rng(seed))
    found, unmet = told(site(poles(), tuple(points(T))), seen(poles(), T))
    assert se3.difference(found, T).translation < 1e-4
    assert not unmet


@pytest.mark.parametrize("off", [2.0, 8.0])
def test_a_point_that_is_off_is_named(off: float) -> None:
    T = se3.random(np.random.default_rng(1))
    known = points(T)
    known[2] = replace(known[2], at=known[2].at + off * ASIDE)
    for surveyed, there in (([], []), (poles(), seen(poles(), T))):
        found, unmet = told(site(surveyed, tuple(known)), there)
        assert se3.difference(found, T).translation < 1e-4
        assert [reason.values["observation"] for reason in unmet] == ["C2"]
        assert unmet[0].values["gap_m"] == pytest.approx(off, rel=0.02)


def test_one_more_that_is_met_to_half_a_metre_is_no_better_than_all_others_exactly() -> None:
    """A point that is off a little more than what is met draws all of a survey along."""
    for seed in range(6):
        rng = np.random.default_rng(seed)
        T = se3.random(rng)
        known = points(T)
        way = rng.normal(size=3)
        for off in (0.51, 0.6, 0.8):
            moved = list(known)
            moved[1] = replace(known[1], at=known[1].at + off * way / np.linalg.norm(way))
            found, unmet = told(site(poles(), tuple(moved)), seen(poles(), T))
            assert se3.difference(found, T).translation < 0.01
            assert [reason.values["observation"] for reason in unmet] == ["C1"]


def mirrored_plane(seed: int, height: float) -> tuple[list[ControlPoint], Array]:
    """Points of which a plane is the mirror image of itself but for so much, x and y exchanged."""
    rng = np.random.default_rng(seed)
    T = se3.random(rng)
    at = np.column_stack([rng.uniform(-8, 8, (5, 2)), height * np.array([0, 1, 0, 1, 0.5])])
    found = []
    for k, true in enumerate(at):
        sights = tuple(
            Sighting(i, se3.apply(se3.inverse(T @ pose), true[None])[0], 0.005)
            for i, pose in POSES.items()
        )
        found.append(ControlPoint(f"C{k}", true[[1, 0, 2]], 0.005, sights))
    return found, T


@pytest.mark.parametrize(("seed", "height"), [(2, 0.6), (2, 0.9), (4, 0.3), (1, 0.6)])
def test_points_near_a_plane_do_not_hide_a_mirror_image(seed: int, height: float) -> None:
    """Upside down they fit to a decimetre, as a mirror image exactly."""
    known, _ = mirrored_plane(seed, height)
    with pytest.raises(Refusal) as refused:
        told(site([], tuple(known)), [])
    assert refused.value.code == "survey_contradicts"
    assert "mirror image" in refused.value.message


@pytest.mark.parametrize("seed", [0, 1, 3])
def test_a_mirror_image_shows_through_poses_that_are_rough(seed: int) -> None:
    """All of it, to 0.15 m, is more than three points of five that fit to a decimetre."""
    known, _ = mirrored_plane(seed, 2.5)
    rng = np.random.default_rng(seed)
    rough = [
        replace(
            point,
            seen=tuple(replace(own, at=own.at + rng.normal(0, 0.09, 3)) for own in point.seen),
        )
        for point in known
    ]
    with pytest.raises(Refusal) as refused:
        told(site([], tuple(rough)), [])
    assert refused.value.code == "survey_contradicts"
    assert "mirror image" in refused.value.message


def test_a_sighting_that_is_off_is_named() -> None:
    T = se3.random(np.random.default_rng(1))
    known = points(T)
    wrong = replace(known[1].seen[0], at=known[1].seen[0].at + 1.0)
    known[1] = replace(known[1], seen=(wrong, known[1].seen[1]))
    found, unmet = told(site([], tuple(known)), [])
    assert se3.difference(found, T).translation < 1e-4
    assert [reason.values["observation"] for reason in unmet] == ["C1 as 0 sees it"]


def test_a_pole_that_is_off_or_of_another_placement_is_named() -> None:
    T = se3.random(np.random.default_rng(2))
    feet, leans = np.array([*FEET, [5.0, 5.0, 0.0]]), np.array([*LEANS, [0.3, 0.1]])
    there, known, other = seen(poles(feet, leans), T), poles(feet, leans), poles(feet, leans)
    assert known[1].foot is not None
    assert known[1].top is not None
    known[1] = replace(known[1], foot=known[1].foot + ASIDE, top=known[1].top + ASIDE)
    _, unmet = told(site(known), there)
    assert [reason.values["observation"] for reason in unmet] == ["P1"]
    assert unmet[0].values["gap_m"] == pytest.approx(1.0, rel=0.1)
    other[2] = replace(other[2], placement=1)
    _, unmet = told(dataclasses.replace(site(other), placements=("1", "2")), there)
    assert [reason.values.get("other") for reason in unmet] == ["1"]


WAYS: dict[str, Callable[[Array], Array]] = {
    "frame": lambda at: at + 5.0 * ASIDE,
    "mirror": lambda at: at * [1.0, -1.0, 1.0],
    "exchanged": lambda at: at[[1, 0, 2]],
    "feet": lambda at: at / 0.3048,
    "millimetres": lambda at: 1000.0 * at,
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("what", ["poles", "points", "both"])
def test_another_frame_a_mirror_image_and_another_unit_are_refused(way: str, what: str) -> None:
    T = se3.random(np.random.default_rng(3))
    surveyed, known = poles(), points(T)
    if way == "frame" and what == "both":
        # All of it moved is another frame, and no contradiction.
        return
    wrong = written(WAYS[way], surveyed, known)
    if what != "points":
        surveyed = wrong[0]
    if what != "poles":
        known = wrong[1]
    with pytest.raises(Refusal) as refused:
        told(site(surveyed, tuple(known)), seen(poles(), T))
    assert refused.value.code == "survey_contradicts"
    words = {"feet": "in feet", "millimetres": "in millimetres", "frame": "another"}
    assert words.get(way, "mirror image") in refused.value.message
