"""How to go on with a walk: what is advised lowers the error most, by as much as it says."""

from functools import cache

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.carried.adjustment import Adjusted
from retropole.carried.guidance import SECONDS, _axis, _candidates, error_of, next_steps
from retropole.carried.walk import solve_tracks
from tests.carried.walks import RADIUS, axis_at, seen_walk

SO_FAR, AT, UNKNOWN = 8.0, 30.0, (None, None)


@cache
def so_far(lean: float = 0.25) -> Adjusted:
    """The first seconds of a walk."""
    return solve_tracks(seen_walk(SO_FAR, lean).tracks, UNKNOWN, RADIUS).solutions[0]


def after(code: str) -> float:
    """The error once a candidate was walked, metres."""
    found = so_far()
    poses = [found.frame.T_walk_target, found.frame.T_walk_target @ found.state.T[1]]
    to = next(each for each in _candidates(found, poses, "front") if each.code == code)
    T = se3.inverse(found.frame.T_walk_target)

    def axis(times: Array) -> tuple[Array, Array]:
        middle, along = axis_at(times)
        x, y, u, v = _axis(found, to, times).T
        later = times > found.times.max()
        middle[later] = se3.apply(T, np.stack([x, y, 0 * x], axis=1))[later]
        slope = np.stack([u, v, np.ones_like(u)], axis=1) @ T[:3, :3].T
        along[later] = (slope / np.linalg.norm(slope, axis=1, keepdims=True))[later]
        return middle, along

    seconds = float(found.times.max()) + SECONDS
    solved = solve_tracks(seen_walk(seconds, axis=axis).tracks, UNKNOWN, RADIUS)
    return error_of(solved.solutions[0].covariance, AT)


@pytest.mark.full
def test_what_is_advised_lowers_the_error_most_and_by_as_much_as_it_says() -> None:
    now, steps = next_steps(so_far(), UNKNOWN, "front", AT)
    predicted = {each.code: each.sigma for each in steps}
    real = {code: after(code) for code in (steps[0].code, "stay_ahead", "left", steps[-1].code)}
    for code, sigma in real.items():
        assert 0.7 < predicted[code] / sigma < 1.4, (code, predicted[code], sigma, now)
    assert real[steps[0].code] <= 1.02 * min(real.values())


@pytest.mark.full
def test_more_never_makes_it_worse_and_what_is_not_seen_says_nothing() -> None:
    now, steps = next_steps(so_far(), UNKNOWN, "front", AT)
    sizes = [each.sigma for each in steps]
    assert sizes == sorted(sizes)
    assert sizes[-1] <= now * (1 + 1e-9)
    assert sizes[0] < 0.9 * now


@pytest.mark.full
def test_a_pole_that_never_leaned_is_to_be_leaned() -> None:
    _, steps = next_steps(so_far(0.005), UNKNOWN, "front", AT)
    assert "lean the pole" in steps[0].text.lower()


@pytest.mark.full
def test_where_the_surroundings_say_all_a_walk_adds_little() -> None:
    sure = np.diag([1e-4] * 3 + [1e-3] * 3) ** 2
    now, steps = next_steps(so_far(), UNKNOWN, "front", AT, np.linalg.inv(sure))
    assert 0.95 * now < steps[0].sigma < now
