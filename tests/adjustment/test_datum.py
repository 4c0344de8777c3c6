"""Where the frame of a site is: the reference's, levelled, or the survey's."""

from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs
from scipy.stats import chi2

from retropole.adjustment.datum import find_datum, without_poles, without_survey
from retropole.alignment.posterior import JointState
from retropole.alignment.survey import Surveyed, survey_terms
from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.base.description import Site, Up
from retropole.simulation.sites import SimulatedSite
from tests.adjustment.adjusting import Steps, with_lidar
from tests.adjustment.test_survey import poles, seen
from tests.adjustment.test_survey import site as survey_site
from tests.alignment.test_posterior import drawn
from tests.alignment.test_survey import everything
from tests.numeric import numeric_jacobian

pytestmark = pytest.mark.full


def with_up(simulated: SimulatedSite, *, off: float = 0.0) -> Site:
    """Inertial sensors on two of the LiDARs, off by a rotation about the world's x axis."""
    site = simulated.as_site()
    up = se3.exp_so3(np.array([off, 0.0, 0.0])) @ [0.0, 0.0, 1.0]
    for i in (0, 2):
        own = simulated.T_world_lidar[i][:3, :3].T @ up
        site = with_lidar(site, i, up=Up(own, 1e-3))
    return site


def test_without_a_survey_it_is_the_frame_of_the_reference(steps: Steps) -> None:
    for reference in (0, 2):
        site = replace(steps.site, reference=reference)
        datum = find_datum(site, steps.scans.origins, steps.choices.best.poses, steps.poles)
        np.testing.assert_allclose(datum.poses[reference], np.eye(4), atol=1e-12)
        free = datum.free.reshape(-1, 6)
        assert not free[reference].any()
        assert free[[i for i in range(3) if i != reference]].all()
        assert site.lidars[reference].name in datum.text
        assert "nothing was surveyed" in datum.text
        # Poles and LiDARs moved together.
        for pole, before in zip(datum.poles, steps.datum.poles, strict=True):
            back = se3.inverse(datum.poses[0])
            np.testing.assert_allclose(
                se3.apply(back, pole.point[None]),
                se3.apply(se3.inverse(steps.datum.poses[0]), before.point[None]),
                atol=1e-9,
            )


def test_where_nothing_links_the_reference_another_lidar_is_it(steps: Steps) -> None:
    poses = {i: T for i, T in steps.choices.best.poses.items() if i != 0}
    datum = find_datum(steps.site, steps.scans.origins, poses, [])
    assert "posts-2" in datum.text
    assert not datum.free.reshape(-1, 6)[0].any()


def test_inertial_sensors_level_it(simulated: SimulatedSite, steps: Steps) -> None:
    site = with_up(simulated)
    datum = find_datum(site, steps.scans.origins, steps.choices.best.poses, steps.poles)
    for i in range(3):
        up = datum.poses[i][:3, :3] @ simulated.T_world_lidar[i][:3, :3].T @ [0.0, 0.0, 1.0]
        np.testing.assert_allclose(up, [0.0, 0.0, 1.0], atol=0.02)
    np.testing.assert_allclose(datum.poses[0][:3, 3], 0.0, atol=1e-12)
    # Heading and origin are nobody's to say.
    np.testing.assert_array_equal(datum.free[:6], [True, True, False, False, False, False])
    adjusted = replace(steps, site=site).again(datum)
    spread = np.sqrt(np.diag(adjusted.covariance)[:3])
    assert spread[2] < 1e-4
    np.testing.assert_allclose(spread[:2], 1e-3 / np.sqrt(2), rtol=0.1)
    for i in range(3):
        up = adjusted.end.T[i][:3, :3] @ simulated.T_world_lidar[i][:3, :3].T @ [0.0, 0.0, 1.0]
        np.testing.assert_allclose(up[:2], 0.0, atol=2e-4)
    assert "2 inertial sensors" in datum.text


def test_a_survey_is_its_frame(simulated_survey: SimulatedSite, surveyed: Steps) -> None:
    for i, true in enumerate(simulated_survey.T_world_lidar):
        apart = se3.difference(surveyed.datum.poses[i], true)
        assert apart.rotation < np.radians(5.0)
        assert apart.translation < 0.5
    assert surveyed.datum.free.all()
    site = simulated_survey.as_site()
    marked = [pole for pole in surveyed.datum.poles if pole.surveyed is not None]
    assert {pole.name(site) for pole in marked} == {each.name for each in site.poles}
    assert "6 surveyed ends of poles and 4 control points" in surveyed.datum.text


def test_ends_stay_at_their_poles_when_others_are_left_out(surveyed: Steps) -> None:
    datum = surveyed.datum
    name = {k: pole.name(surveyed.site) for k, pole in enumerate(datum.poles)}
    gone = next(k for k, pole in enumerate(datum.poles) if pole.surveyed is not None)
    left = without_poles(datum, {gone})
    assert [pole.name(surveyed.site) for pole in left.poles] == [
        one for k, one in name.items() if k != gone
    ]
    assert len(left.surveyed.ends) == len(datum.surveyed.ends) - 2
    for end in left.surveyed.ends:
        assert end.name.endswith(left.poles[end.axis].name(surveyed.site))


@pytest.mark.parametrize("name", ["point 0", "point 1", "point 1 by 2", "end 2", "up of 1"])
def test_what_is_left_out_of_a_survey_is_that_alone(name: str) -> None:
    known = everything(drawn(), off=0.0)
    left = without_survey(known, name)

    def told(surveyed: Surveyed) -> dict[str, str]:
        """Everything by name, and for a sight whose point it is of."""
        names = [each.name for each in surveyed.ends] + [each.name for each in surveyed.known]
        found = dict.fromkeys([*names, *(each.name for each in surveyed.up)], "")
        return found | {each.name: surveyed.known[each.point].name for each in surveyed.seen}

    before, after = told(known), told(left)
    assert after == {each: of for each, of in before.items() if each != name and of != name}
    assert len(after) < len(before)


DRAWS, RADIUS, SIGMA = 200, 0.03, 0.002
"""Of points on poles' surfaces, metres."""


def sides(rng: np.random.Generator, directions: Array, habit: str) -> Array:
    """(N, 2, 3) by how much foot and top of each pole are off its axis: to a side, by the radius.

    Each end from anywhere, both ends of a pole from one side, or all from one side.
    """
    count = len(directions)
    shape = {"end": (count, 2), "pole": (count, 1), "site": (1, 1)}[habit]
    angle = np.broadcast_to(rng.uniform(0, 2 * np.pi, shape), (count, 2))
    off = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=2)
    off = off - np.einsum("nki,ni->nk", off, directions)[:, :, None] * directions[:, None]
    return np.asarray(RADIUS * off / np.linalg.norm(off, axis=2, keepdims=True))


def residuals_of(state: JointState, surveyed: Surveyed, step: Array) -> Array:
    """(M,) of a survey, by its 1 σ, with all poles moved as one and the side that was measured."""
    T = se3.retract(np.eye(4), step[:6])
    moved = replace(
        state,
        points=se3.apply(T, state.points),
        directions=state.directions @ T[:3, :3].T,
        control=step[6:].reshape(1, 3),
    )
    return np.concatenate([term.residual / term.sigma for term in survey_terms(moved, surveyed)])


@pytest.mark.parametrize("habit", ["end", "pole", "site"])
def test_the_true_frame_is_as_near_as_is_stated(habit: str) -> None:
    """Of each habit, some part of the pose has the error that is stated, and none has more."""
    rng = np.random.default_rng(11)
    known = [structs.replace(each, sigma=SIGMA, on="surface") for each in poles()]
    found = seen(known, np.eye(4))
    own = {0: np.eye(4), 1: np.eye(4)}
    datum = find_datum(replace(survey_site(known), radius=RADIUS), np.zeros((2, 3)), own, found)
    assert "6 surveyed ends of poles" in datum.text
    assert "control point" not in datum.text
    surveyed = datum.surveyed
    directions = np.array([pole.direction for pole in found])
    points = np.array([pole.point for pole in found])
    state = JointState(np.eye(4)[None], np.zeros(1), RADIUS, points, directions, np.zeros((1, 3)))
    J = numeric_jacobian(lambda step: residuals_of(state, surveyed, step), 9)
    inverse = np.linalg.inv(J.T @ J)
    covariance = inverse[:6, :6]
    steps, inside = [], 0
    for _ in range(DRAWS):
        off = sides(rng, directions, habit).reshape(-1, 3) + rng.normal(0, SIGMA, (6, 3))
        ends = tuple(
            replace(end, at=structs.astuple(known[k // 2])[2 + k % 2] + off[k])
            for k, end in enumerate(surveyed.ends)
        )
        left = residuals_of(state, replace(surveyed, ends=ends), np.zeros(9))
        step = -(inverse @ J.T @ left)[:6]
        inside += step @ np.linalg.solve(covariance, step) < chi2.ppf(0.95, 6)
        steps.append(step)
    L = np.linalg.cholesky(np.linalg.inv(covariance))
    ratio = np.linalg.eigvalsh(L.T @ np.cov(np.array(steps).T) @ L)
    # Of 200 draws, a variance is known to 10 %.
    assert ratio.max() < 1.25
    assert ratio.max() > {"end": 0.4, "pole": 0.7, "site": 0.6}[habit]
    assert inside >= 0.93 * DRAWS
