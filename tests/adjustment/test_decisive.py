"""A place that alone decides a direction is found, left out, and said."""

from dataclasses import replace

import numpy as np
import pytest

from retropole.adjustment.agreement import check_decisive
from retropole.adjustment.places import Places
from retropole.adjustment.refinement import MAX_SHARE, Refinement, leverage, refine
from retropole.base import se3
from retropole.base.datatypes import Array, PointCloud, PoseEstimate
from tests.tiers import first_of

pytestmark = pytest.mark.full


def plane(rng: np.random.Generator, middle: Array, u: Array, v: Array, count: int) -> Array:
    """Points (N, 3) of a rectangle with 3 mm of noise."""
    a, b = rng.uniform(-1, 1, (2, count, 1))
    noise = 0.003 * rng.normal(size=(count, 1)) * np.cross(u, v) / np.linalg.norm(np.cross(u, v))
    return np.asarray(middle + a * u + b * v + noise)


def place(rng: np.random.Generator, off: float) -> Array:
    """Ground, a front along x, and one small board across it, which may stand elsewhere."""
    x, y, z = np.eye(3)
    return np.concatenate(
        [
            plane(rng, -1.5 * z, 15 * x, 15 * y, 25_000),
            plane(rng, np.array([0.0, 12.0, 2.0]), 15 * x, 3.5 * z, 12_000),
            plane(rng, np.array([7.0 + off, 3.0, -0.5]), 0.7 * y, 0.7 * z, 1_500),
        ]
    )


def refined(off: float) -> Refinement:
    """Refine from poles that leave 0.1 m open along x, where the board is `off` in one cloud."""
    rng = np.random.default_rng(1)
    T = se3.from_rt(se3.exp_so3(np.array([0.02, -0.01, 0.5])), np.array([0.5, 0.2, 0.1]))
    target, source = place(rng, 0.0), se3.apply(se3.inverse(T), place(rng, off))
    sigma = np.r_[np.full(3, 0.002), 0.1, 0.02, 0.02]
    poles = PoseEstimate(T, np.diag(sigma**2), 0.01)
    found = refine(PointCloud(target), PointCloud(source), poles)
    assert found is not None
    return replace(found, from_poles=se3.difference(T, found.pose.T_target_source))


def test_a_place_that_alone_holds_a_direction_is_found() -> None:
    found = refined(0.0)
    assert found.decisive
    first = found.decisive[0]
    assert MAX_SHARE < first.share <= 1.0
    assert np.linalg.norm(first.at - [7.0, 3.0, -0.5]) < 1.5
    (reason, *_) = check_decisive(found)
    assert reason.code == "one_place_decides"
    assert reason.values["share"] == first.share


@pytest.mark.parametrize("off", first_of([0.03, -0.06]))
def test_what_is_stated_covers_a_place_that_moved(off: float) -> None:
    """The answer follows the board; the truth is within what is stated all the same."""
    found = refined(off)
    assert found.decisive
    assert found.pose.covariance is not None
    e = found.from_poles.translation
    sigma = np.sqrt(np.diag(found.pose.covariance)[3:])
    assert abs(off) / 3 < e < 3 * np.linalg.norm(sigma)
    # And no more than poles and board allow.
    assert np.linalg.norm(sigma) < 0.3


def test_shares_have_no_frame_and_no_unit() -> None:
    rng = np.random.default_rng(6)
    roots = rng.normal(size=(5, 6, 3))
    information = roots @ roots.transpose(0, 2, 1)
    marginal = information.sum(axis=0) + np.eye(6)
    one = leverage(places(marginal, information))
    A = rng.normal(size=(6, 6))
    other = leverage(places(A @ marginal @ A.T, A @ information @ A.T))
    np.testing.assert_allclose(one, other, rtol=1e-6)
    assert np.all((one > 0) & (one < 1))
    assert leverage(places(marginal, marginal[None])) == pytest.approx(1.0)


def places(marginal: Array, information: Array) -> Places:
    """Places that do not pull."""
    nothing = np.zeros(information.shape[:2])
    return Places(np.asarray(np.linalg.inv(marginal)), marginal, information, nothing, nothing)
