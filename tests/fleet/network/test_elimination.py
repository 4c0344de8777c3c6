import numpy as np
import pytest

from retropole.base.errors import RetropoleError
from retropole.fleet.network.elimination import Blocks, factorise, find_pattern, solve
from tests.fleet.network.networks import dense

pytestmark = pytest.mark.full

GRAPHS = {
    "nothing joined": (3, []),
    "chain": (12, [(k, k + 1) for k in range(11)]),
    "star": (9, [(0, k) for k in range(1, 9)]),
    "all with all": (7, [(a, b) for a in range(7) for b in range(a + 1, 7)]),
    "grid": (
        64,
        [(8 * a + b, 8 * a + b + 1) for a in range(8) for b in range(7)]
        + [(8 * a + b, 8 * a + b + 8) for a in range(7) for b in range(8)],
    ),
    "two parts": (8, [(0, 3), (3, 5), (0, 5), (1, 2), (2, 7), (4, 6)]),
}


def matrix_of(size: int, pairs: np.ndarray, block: int, rng: np.random.Generator) -> Blocks:
    J = rng.normal(size=(len(pairs), 2, block, block))
    diagonal = np.tile(np.eye(block), (size, 1, 1))
    for side in (0, 1):
        np.add.at(diagonal, pairs[:, side], np.swapaxes(J[:, side], 1, 2) @ J[:, side])
    return Blocks(diagonal, np.swapaxes(J[:, 0], 1, 2) @ J[:, 1])


@pytest.mark.parametrize("block", [1, 3, 6])
@pytest.mark.parametrize("name", GRAPHS)
def test_solves_as_a_dense_matrix_does(name: str, block: int) -> None:
    rng = np.random.default_rng(1)
    size, listed = GRAPHS[name]
    pairs = np.array(listed, dtype=np.int64).reshape(-1, 2)
    matrix = matrix_of(size, pairs, block, rng)
    factor = factorise(find_pattern(size, pairs), matrix)
    right = rng.normal(size=(size, block, 2))
    expected = np.linalg.solve(dense(matrix, pairs), right.reshape(-1, 2))
    np.testing.assert_allclose(solve(factor, right).reshape(-1, 2), expected, atol=1e-12)


def test_every_node_is_eliminated_once_and_before_what_it_touches() -> None:
    size, listed = GRAPHS["grid"]
    pairs = np.array(listed)
    pattern = find_pattern(size, pairs)
    own = np.concatenate([front.nodes[: front.own] for front in pattern.fronts])
    assert sorted(own) == list(range(size))
    place = np.argsort(own)
    for front in pattern.fronts:
        assert (np.diff(place[front.nodes]) > 0).all()
    found = np.concatenate([front.pairs for front in pattern.fronts])
    assert sorted(found) == list(range(len(pairs)))


def test_a_matrix_that_is_not_positive_is_refused() -> None:
    pairs = np.array([[0, 1]])
    matrix = Blocks(np.tile(np.eye(2), (2, 1, 1)), 2 * np.eye(2)[None])
    with pytest.raises(RetropoleError, match="positive definite"):
        factorise(find_pattern(2, pairs), matrix)
