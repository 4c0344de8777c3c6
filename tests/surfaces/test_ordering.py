"""The order of whole numbers is that of a stable sort, and they are counted as NumPy does."""

import numpy as np
import pytest

from retropole.surfaces.sweeps import numbered, order_of


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
