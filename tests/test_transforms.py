"""Reading transforms: what was written comes back, and nothing else is taken for one."""

import json
from pathlib import Path

import numpy as np
import pytest

from retropole import se3
from retropole.errors import ReadError
from retropole.simulation import simulate_pair, write_pair
from retropole.transforms import read_transform

T = se3.random(np.random.default_rng(0))


@pytest.mark.parametrize("delimiter", [" ", ",", ", ", "\t"])
def test_a_matrix_in_text_comes_back(tmp_path: Path, delimiter: str) -> None:
    np.savetxt(tmp_path / "T.txt", T, delimiter=delimiter, header="target from source")
    np.testing.assert_allclose(read_transform(tmp_path / "T.txt"), T, atol=1e-12)


def test_json_comes_back(tmp_path: Path) -> None:
    (tmp_path / "T.json").write_text(json.dumps({"T_target_source": T.tolist(), "more": 1}))
    np.testing.assert_allclose(read_transform(tmp_path / "T.json"), T, atol=1e-12)


def test_the_truth_of_a_simulation_comes_back(tmp_path: Path) -> None:
    pair = simulate_pair("paper", np.random.default_rng(0))
    write_pair(pair, tmp_path)
    np.testing.assert_allclose(
        read_transform(tmp_path / "truth.json"), pair.T_target_source, atol=1e-12
    )


def test_few_digits_give_a_true_rotation(tmp_path: Path) -> None:
    np.savetxt(tmp_path / "T.txt", T, fmt="%.5f")
    read = read_transform(tmp_path / "T.txt")
    np.testing.assert_allclose(read[:3, :3] @ read[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(read, T, atol=1e-4)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "0 numbers"),
        ("1 2 3", "3 numbers"),
        ("pole", "neither JSON nor"),
        ("{", "no JSON"),
        ("{}", "no T_target_source"),
        ('{"T_target_source": null}', "refused"),
        ('{"T_target_source": "identity"}', "no matrix"),
        ('{"T_target_source": [[1, 2], [3]]}', "no matrix"),
        ('{"T_target_source": [[1, 0], [0, 1]]}', "4×4"),
        ("2 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1", "no rigid transform"),
        ("-1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1", "no rigid transform"),
        ("1 0 0 0 0 1 0 0 0 0 1 0 5 0 0 1", "no rigid transform"),
        ("nan 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1", "finite"),
    ],
)
def test_anything_else_is_refused_with_the_reason(tmp_path: Path, text: str, says: str) -> None:
    (tmp_path / "file").write_text(text)
    with pytest.raises(ReadError, match=says):
        read_transform(tmp_path / "file")


def test_a_missing_file_and_binary_are_named(tmp_path: Path) -> None:
    with pytest.raises(ReadError, match=r"missing\.txt"):
        read_transform(tmp_path / "missing.txt")
    (tmp_path / "binary").write_bytes(bytes(range(256)))
    with pytest.raises(ReadError, match="binary"):
        read_transform(tmp_path / "binary")
