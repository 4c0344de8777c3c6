"""`evaluate` scores the same transform the same, whatever it comes as."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import retropole as rp
from retropole.base import se3
from retropole.export import export_lines
from tests.api.clouds import calibrated, pair, refused, tables

pytestmark = pytest.mark.full


def test_the_truth_scores_better_than_an_error() -> None:
    T = pair().T_target_source
    wrong = se3.retract(T, np.array([0.0, 0, 0, 0.2, 0, 0]))
    right, off = (rp.evaluate(pair().target, pair().source, each) for each in (T, wrong))
    assert right.entropy.sum > off.entropy.sum
    assert right.plane_residual is not None
    assert off.plane_residual is not None
    assert right.plane_residual < off.plane_residual


def test_matrix_result_and_file_give_the_same_scores(tmp_path: Path) -> None:
    result = calibrated()
    T = result.T_target_source
    assert T is not None
    result.save(tmp_path / "r")
    (tmp_path / "T.txt").write_text(export_lines(T)["matrix"])
    expected = rp.evaluate(tables().target, tables().source, T)
    counted = result.confirmation
    assert counted is not None
    for given in (result, tmp_path / "r", str(tmp_path / "r" / "result.json")):
        scores = rp.evaluate(pair().target, pair().source, given)
        assert replace(scores, confirmation=expected.confirmation) == expected
        # A result names its poles: without them, the same is counted as when it was calibrated.
        found = scores.confirmation
        assert (found.agreeing, found.contradicting, found.missing) == (
            *(counted.agreeing, counted.contradicting, counted.missing),
        )
    read = rp.evaluate(pair().target, pair().source, tmp_path / "T.txt")
    assert read.entropy.sum == pytest.approx(expected.entropy.sum)


@pytest.mark.parametrize(
    "T", [np.eye(3), np.diag([2.0, 2, 2, 1]), np.full((4, 4), np.nan), None, ["no", "matrix"]]
)
def test_what_is_no_transform_is_refused(T: object) -> None:
    with pytest.raises(rp.UsageError, match="T_target_source"):
        rp.evaluate(pair().target, pair().source, T)  # type: ignore[arg-type]


@pytest.mark.parametrize("seed", [-1, 0.5, "0"])
def test_what_is_no_seed_is_refused(seed: object) -> None:
    with pytest.raises(rp.UsageError, match=r"seed is .*, expected a number from 0 up"):
        rp.evaluate(pair().target, pair().source, np.eye(4), seed=seed)  # type: ignore[arg-type]


def test_a_refused_result_has_nothing_to_score(tmp_path: Path) -> None:
    refused().save(tmp_path)
    for given in (refused(), tmp_path):
        with pytest.raises(rp.Refusal) as caught:
            rp.evaluate(pair().target, pair().source, given)
        assert caught.value.code == "too_few_poles"


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(rp.ReadError, match=r"absent\.txt"):
        rp.evaluate(pair().target, pair().source, tmp_path / "absent.txt")
