"""The result document of a site: it comes back as it went, and holds no number that is none."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from retropole.adjustment.answer import LoopClosure
from retropole.result import encode
from retropole.result.decoding import decode_site
from retropole.result.site import joint_order
from tests.report.site.made_up import NAMES, document_of, made_up_site

SMALL = made_up_site("warn", lidars=3, placements=2, count=20, surveyed=True)


@pytest.mark.parametrize("status", ["ok", "warn", "refused"])
def test_it_comes_back_as_it_went(status: Any) -> None:
    document = document_of(made_up_site(status, lidars=3, placements=2, count=20))
    assert decode_site(encode(document)) == document


def test_the_joint_covariance_holds_that_of_each_lidar_in_the_order_that_is_named() -> None:
    document = document_of(SMALL)
    assert document.joint_covariance is not None
    assert document.joint_order == joint_order(NAMES[:3])
    assert document.joint_order[6] == "mast-b.phi_x"
    block = np.array(document.joint_covariance)[12:, 12:]
    assert np.array_equal(block, SMALL.lidars[2].covariance)
    np.testing.assert_array_equal(document.lidars[2].covariance, block)


def test_a_refusal_has_no_pose_and_says_what_was_found() -> None:
    document = document_of(made_up_site("refused", lidars=3, placements=2, count=20))
    assert document.joint_covariance is None
    for lidar in document.lidars:
        pose = (lidar.T_site_lidar, lidar.covariance, lidar.budget, lidar.fitness)
        assert pose == (None,) * 4
    assert document.found[2][1] is None
    found = document.found[0][0]
    assert found is not None
    assert len(found.poles) == 2


def test_what_is_no_number_is_null() -> None:
    loop = LoopClosure((0, 1, 2), np.float64(0.001), float("nan"), float("inf"), 6, float("nan"))
    reason = replace(SMALL.reasons[0], values={"w": float("inf"), "poles": 3})
    document = document_of(replace(SMALL, loops=(loop,), reasons=(reason,)))
    text = encode(document)
    assert b"NaN" not in text
    assert b"Infinity" not in text
    again = decode_site(text)
    assert again.loops[0].chi2 is again.loops[0].probability is again.loops[0].translation is None
    assert again.reasons[0].values == {"w": "inf", "poles": 3}


def test_an_answer_that_is_no_number_is_none() -> None:
    assert SMALL.covariance is not None
    with pytest.raises(ValueError, match="joint covariance"):
        document_of(replace(SMALL, covariance=np.nan * SMALL.covariance))
    bad = replace(SMALL.lidars[1], T_site_lidar=np.full((4, 4), np.nan))
    with pytest.raises(ValueError, match="mast-b"):
        document_of(replace(SMALL, lidars=(SMALL.lidars[0], bad, SMALL.lidars[2])))


def test_an_input_says_which_threshold_was_used() -> None:
    inputs = document_of(SMALL).inputs
    assert [(each.lidar, each.placement) for each in inputs] == [
        (0, 0),
        (0, 1),
        (1, 0),
        (1, 1),
        (2, 0),
    ]
    assert {each.threshold for each in inputs} == {200.0}
