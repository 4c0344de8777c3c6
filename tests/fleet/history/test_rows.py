"""A check as a row: what makes it this one, what it is worth, and that what is read is sound."""

from datetime import timedelta

import numpy as np
import pytest
from msgspec.structs import replace

from retropole.base.errors import ReadError
from retropole.fleet.history.store import columns_of, observed, row_of
from tests.fleet.history.checks import COMMON, row

pytestmark = pytest.mark.full


@pytest.mark.parametrize(
    ("name", "value"),
    [("step", [np.nan] * 6), ("step", None), ("covariance", list(-np.eye(6).ravel()))],
)
def test_no_step_is_taken_that_is_none(name: str, value: object) -> None:
    with pytest.raises(ReadError, match="lamp-1"):
        row_of({**columns_of(row()), name: value})


def test_the_columns_of_a_row_give_it_back() -> None:
    one = row(3, codes=("too_weak",), chi2=4.5, power=0.25, message="ü")
    again = row_of(columns_of(one))
    assert again.key == one.key
    assert again == one
    with pytest.raises(ReadError, match="not that of its key"):
        row_of({**columns_of(one), "time": one.time + timedelta(days=1)})


def test_an_error_does_not_stand_for_the_check() -> None:
    one = row()
    assert replace(one, message="x", status="moved").key == one.key
    failed = [replace(one, status="error", codes=(code,)) for code in ("killed", "time_limit")]
    assert len({one.key, *(each.key for each in failed)}) == 3


def test_checks_against_an_older_stored_pose_are_left_out() -> None:
    rows = [row(k, stored_sha256="a" if k < 3 else "b") for k in range(5)]
    assert [one.target_sha256 for one, _ in observed(rows[::-1])] == ["t3", "t4"]


def test_only_steps_that_can_be_trusted_count() -> None:
    assert row(0).is_usable
    assert replace(row(1), status="cannot_tell", codes=("too_weak",)).is_usable
    assert not replace(row(1), status="cannot_tell").is_usable
    assert not row(2, codes=("several_minima",)).is_usable
    assert not row(3, step=None, covariance=None, random=None).is_usable


def test_the_first_way_of_being_found_is_the_one_to_compare_with() -> None:
    seen = observed([row(0), row(1, used="scene"), row(2)])
    assert [one.other for _, one in seen] == [False, True, False]
    assert seen[1][1].days - seen[0][1].days == timedelta(days=7) / timedelta(days=1)


def test_what_is_not_drawn_anew_is_common_to_all() -> None:
    ((_, one),) = observed([row()])
    np.testing.assert_allclose(one.common, COMMON, atol=1e-18)
