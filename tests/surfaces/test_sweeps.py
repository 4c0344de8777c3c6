"""The order of whole numbers is that of a stable sort, and they are counted as NumPy does."""

from dataclasses import replace

import numpy as np
import pytest

from retropole.surfaces.sweeps import numbered, observe, order_of, timed, without
from tests.surfaces.swaying import HALF, SWEEP, recorded


def solved(motions: np.ndarray, noise: float = 0.003) -> tuple[np.ndarray, np.ndarray]:
    """Motion of each sweep against the first as the returns have it, and its 1 σ."""
    cloud = replace(recorded(motions, np.random.default_rng(0), noise), time=None)
    when = timed(cloud)
    found = np.zeros((len(when.times), 6))
    own = np.eye(len(when.times))[:, 1:]
    for _ in range(3):
        seen = observe(cloud.xyz[when.index], cloud.origin, when, found)
        left, pull = seen.about(own)
        found = np.concatenate([np.zeros((1, 6)), np.linalg.solve(left, pull).reshape(-1, 6)])
    return found[1:], np.sqrt(np.diag(np.linalg.inv(left))).reshape(-1, 6)


def test_sweeps_are_found_where_they_are_against_each_other() -> None:
    rng = np.random.default_rng(1)
    each = np.concatenate(
        [np.radians(0.1) * rng.normal(size=(5, 3)), 0.005 * rng.normal(size=(5, 3))], axis=1
    )
    found, sigma = solved(np.repeat(each, 8, axis=0), 0.01)
    off = (found - (each[1:] - each[0])) / sigma
    assert 0.4 < np.sqrt(np.mean(off**2)) < 2.0
    assert sigma[:, :3].max() < np.radians(0.01)


def test_no_motion_is_no_motion() -> None:
    found, sigma = solved(np.zeros((32, 6)))
    assert 0.4 < np.sqrt(np.mean((found / sigma) ** 2)) < 1.6


def test_a_single_ring_tells_nothing() -> None:
    cloud = recorded(np.zeros((24, 6)), np.random.default_rng(0))
    up = cloud.xyz[:, 2] / np.linalg.norm(cloud.xyz, axis=1)
    ahead = np.abs(cloud.xyz[:, 1]) < 0.3 * cloud.xyz[:, 0]
    ring = cloud.select((up < up.min() + 1e-6) & ahead)
    when = timed(ring)
    seen = observe(ring.xyz[when.index], ring.origin, when, np.zeros((len(when.times), 6)))
    assert len(seen.plane) == 0


@pytest.mark.parametrize("of", ["all", "each sweep", "none", "the recorder"])
def test_times_are_those_of_the_returns_or_the_usual(of: str) -> None:
    cloud = recorded(np.zeros((40, 6)), np.random.default_rng(0))
    assert cloud.time is not None
    assert cloud.frame is not None
    if of == "each sweep":
        cloud = replace(cloud, time=cloud.time - cloud.frame * SWEEP)
    if of in ("none", "the recorder"):
        cloud = replace(cloud, time=None)
    if of == "the recorder":
        cloud = replace(cloud, recorded=(1.6e9, 1.6e9 + 4 * 0.2))
    when = timed(cloud)
    period = 0.2 if of == "the recorder" else SWEEP
    parts = 1 if of in ("none", "the recorder") else 8
    assert len(when.times) == 5 * parts
    assert np.diff(when.times) == pytest.approx(period / parts)
    assert when.times[0] == pytest.approx(period / parts / 2)
    assert (when.of_all[when.index] == when.part).all()


def test_what_is_taken_out_was_there() -> None:
    rng = np.random.default_rng(2)
    motion = np.concatenate([np.radians(0.1) * rng.normal(size=3), 0.005 * rng.normal(size=3)])
    moved = recorded(np.tile(motion, (8, 1)), rng, 0.0)
    still = without(moved.xyz, moved.origin, motion[None], np.zeros(len(moved), dtype=np.int64))
    # The walls are where they are without motion.
    assert np.abs(np.max(np.abs(still) / HALF, axis=1) - 1.0).max() < 2e-5


@pytest.mark.parametrize(
    ("bits", "kind"),
    [(3, np.int64), (16, np.int64), (40, np.int64), (63, np.int64), (64, np.uint64)],
)
def test_keys_are_sorted_and_equal_ones_keep_their_order(bits: int, kind: type) -> None:
    rng = np.random.default_rng(bits)
    keys = rng.integers(0, 2**bits - 1, 5000, dtype=kind, endpoint=True)
    keys = np.concatenate([keys, rng.permutation(keys)])
    np.testing.assert_array_equal(order_of(keys), np.argsort(keys, kind="stable"))


def test_few_keys_have_an_order_too() -> None:
    assert order_of(np.zeros(0, np.int64)).tolist() == []
    assert order_of(np.zeros(3, np.int64)).tolist() == [0, 1, 2]


@pytest.mark.parametrize("step", [1, 7, 10**12])
def test_numbers_are_those_of_numpy(step: int) -> None:
    rng = np.random.default_rng(step)
    values = step * rng.integers(-20, 50, 500)
    for each in (values, values[:1], values[:0]):
        found, own = numbered(each)
        expected, place = np.unique(each, return_inverse=True)
        np.testing.assert_array_equal(found, expected)
        np.testing.assert_array_equal(own, place)
