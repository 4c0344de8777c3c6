"""What surveyors and inertial sensors say: derivatives, and zero at the truth."""

import numpy as np
import pytest

from retropole.alignment.posterior import JointState
from retropole.alignment.survey import (
    ControlPoint,
    MeasuredUp,
    PriorPose,
    SeenPoint,
    Surveyed,
    SurveyedEnd,
    survey_terms,
)
from retropole.base import se3
from retropole.base.datatypes import Array
from tests.alignment.test_posterior import drawn
from tests.numeric import numeric_jacobian


def everything(state: JointState, *, off: float, ends: bool = True) -> Surveyed:
    """A survey of a state, each LiDAR but one seeing every point: true where `off` is zero."""
    rng = np.random.default_rng(3)

    def by() -> Array:
        return off * rng.normal(size=3)

    found = tuple(
        SurveyedEnd(f"end {k}", k, state.points[k] + along * state.directions[k] + by(), 0.005)
        for k, along in ((0, 0.9), (0, -1.1), (2, 1.3))
        if ends
    )
    points = range(len(state.control))
    known = tuple(ControlPoint(f"point {q}", state.control[q] + by(), 0.004) for q in points)
    seen = tuple(
        SeenPoint(
            f"point {q} by {i}",
            i,
            q,
            se3.apply(se3.inverse(state.T[i]), state.control[q][None])[0] + by(),
            0.006,
        )
        for q in points
        for i in range(len(state.T))
        if i != q
    )
    up = state.T[1][:3, :3].T @ [0.0, 0.0, 1.0] + 0.1 * by()
    ups = (MeasuredUp("up of 1", 1, up / np.linalg.norm(up), 0.002),)
    near = se3.retract(state.T[2], np.concatenate([by(), by()]))
    sigma = np.array([0.02, 0.02, 0.02, 0.1, 0.1, 0.1])
    return Surveyed(found, known, seen, ups, (PriorPose("pose of 2", 2, near, sigma),))


def test_a_true_survey_leaves_no_residual() -> None:
    state = drawn()
    terms = list(survey_terms(state, everything(state, off=0.0)))
    assert [len(term.residual) for term in terms] == [2, 2, 2, 3, 3, 3, 3, 3, 3, 2, 6]
    for term in terms:
        np.testing.assert_allclose(term.residual, 0.0, atol=1e-12)


@pytest.mark.parametrize("number", range(11))
def test_derivatives_are_those_of_finite_differences(number: int) -> None:
    state = drawn()
    surveyed = everything(state, off=1e-4)
    term = list(survey_terms(state, surveyed))[number]
    # In the tangents of the state, as the residual of an end is: a step turns them too.
    tangents = state.of(0, np.arange(len(state.points))).tangents

    def residual(step: Array) -> Array:
        moved = state.moved(step)
        if term.axis is not None:
            end = surveyed.ends[number]
            away = end.at - moved.points[end.axis]
            n = moved.directions[end.axis]
            return np.asarray(tangents[end.axis].T @ (away - (away @ n) * n))
        return list(survey_terms(moved, surveyed))[number].residual

    whole = numeric_jacobian(residual, state.size)
    stated = np.zeros_like(whole)
    stated[:, term.place] = term.jacobian
    # Residuals of 0.1 mm leave products of that size out.
    np.testing.assert_allclose(stated, whole, atol=1e-3)
    assert np.all(term.sigma > 0)


def test_an_end_says_nothing_of_where_it_lies_along_the_axis() -> None:
    state = drawn()
    at = state.points[0] + 0.3 * state.directions[0]
    for along in (0.0, 0.5, -2.0):
        end = SurveyedEnd("end", 0, at + along * state.directions[0], 0.005)
        (term,) = survey_terms(state, Surveyed(ends=(end,)))
        np.testing.assert_allclose(term.residual, 0.0, atol=1e-12)


def test_each_coordinate_counts_by_its_own_sigma_next_to_the_axis() -> None:
    state, sigma = drawn(), np.array([0.004, 0.01, 0.03])
    tangents = state.of(0, np.arange(len(state.points))).tangents
    for k, along in ((0, 0.7), (3, -1.2)):
        at = state.points[k] + along * state.directions[k] + [0.002, -0.003, 0.004]
        (term,) = survey_terms(state, Surveyed(ends=(SurveyedEnd("end", k, at, sigma, 0.02),)))
        # W of two coordinates beside the axis is that of three, projected.
        B = tangents[k]
        covariance = B.T @ np.diag(sigma**2) @ B + 0.02**2 * np.eye(2)
        off = B.T @ (at - state.points[k])
        turned = (at - state.points[k]) @ state.directions[k]
        J = np.concatenate([-np.eye(2), -turned * np.eye(2)], axis=1)
        weighted = term.jacobian / term.sigma[:, None]
        stated = J.T @ np.linalg.solve(covariance, J)
        np.testing.assert_allclose(weighted.T @ weighted, stated, atol=1e-9 * stated.max())
        chi2 = np.sum((term.residual / term.sigma) ** 2)
        assert chi2 == pytest.approx(off @ np.linalg.solve(covariance, off))


def test_the_side_that_was_measured_is_an_error_of_all_ends() -> None:
    state = drawn(control=1)
    at = state.points[0] + 0.6 * state.directions[0] + state.control[0]
    ends = (SurveyedEnd("end", 0, at, 0.005, 0.02, side=0),)
    side = ControlPoint("side", np.zeros(3), 0.014, is_side=True)
    surveyed = Surveyed(ends, (side,))
    end, prior = survey_terms(state, surveyed)
    np.testing.assert_allclose(end.residual, 0.0, atol=1e-12)
    assert (end.kind, prior.kind) == ("survey", "side")
    whole = np.zeros((2, state.size))
    whole[:, end.place] = end.jacobian
    moving = np.zeros(state.size)
    for k in range(3):
        moving[:] = 0.0
        moving[state.control_points().start + k] = 1e-6
        (moved, _) = survey_terms(state.moved(moving), surveyed)
        np.testing.assert_allclose((moved.residual - end.residual) / 1e-6, whole @ moving * 1e6)


def test_up_is_measured_about_two_axes_of_the_level() -> None:
    state = drawn()
    R = se3.exp_so3(np.array([0.01, -0.02, 0.0]))
    up = state.T[0][:3, :3].T @ R @ [0.0, 0.0, 1.0]
    (term,) = survey_terms(state, Surveyed(up=(MeasuredUp("up", 0, up, 0.001),)))
    # Turned about x by 0.01 the vertical leans along −y, about y by −0.02 along −x.
    np.testing.assert_allclose(term.residual, [-0.02, -0.01], atol=1e-3)
    step = np.zeros(state.size)
    step[term.place] = np.linalg.lstsq(term.jacobian, -term.residual, rcond=None)[0]
    (levelled,) = survey_terms(state.moved(step), Surveyed(up=(MeasuredUp("up", 0, up, 0.001),)))
    np.testing.assert_allclose(levelled.residual, 0.0, atol=1e-5)
