import numpy as np
import pytest

from retropole.fleet.network.elimination import factorise, find_pattern, selected_inverse
from tests.fleet.network.networks import dense
from tests.fleet.network.test_elimination import GRAPHS, matrix_of

pytestmark = pytest.mark.full


@pytest.mark.parametrize("name", GRAPHS)
def test_blocks_are_those_of_the_dense_inverse(name: str) -> None:
    size, listed = GRAPHS[name]
    pairs = np.array(listed, dtype=np.int64).reshape(-1, 2)
    matrix = matrix_of(size, pairs, 6, np.random.default_rng(2))
    found = selected_inverse(factorise(find_pattern(size, pairs), matrix))
    whole = np.linalg.inv(dense(matrix, pairs)).reshape(size, 6, size, 6)
    k = np.arange(size)
    np.testing.assert_allclose(found.diagonal, whole[k, :, k, :], atol=1e-13)
    np.testing.assert_allclose(found.pairs, whole[pairs[:, 0], :, pairs[:, 1], :], atol=1e-13)


def test_the_order_of_the_nodes_does_not_matter() -> None:
    rng = np.random.default_rng(3)
    size, listed = GRAPHS["grid"]
    pairs = np.array(listed)
    matrix = matrix_of(size, pairs, 3, rng)
    found = selected_inverse(factorise(find_pattern(size, pairs), matrix))
    number = rng.permutation(size)
    other = number[pairs]
    turned = other[:, 0] > other[:, 1]
    blocks = matrix.pairs.copy()
    blocks[turned] = np.swapaxes(blocks[turned], 1, 2)
    diagonal = np.empty_like(matrix.diagonal)
    diagonal[number] = matrix.diagonal
    again = selected_inverse(
        factorise(find_pattern(size, np.sort(other, axis=1)), type(matrix)(diagonal, blocks))
    )
    np.testing.assert_allclose(again.diagonal[number], found.diagonal, atol=1e-13)
