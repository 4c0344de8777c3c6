"""Result documents of a site that were edited: every fault is an error that names its field."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from retropole.base.errors import ReadError
from retropole.result import encode
from retropole.result.decoding import decode_site
from tests.report.site.made_up import document_of, made_up_site

SMALL = made_up_site("warn", lidars=3, placements=2, count=20, surveyed=True)
WHOLE = json.loads(encode(document_of(SMALL)))


def changed(way: str, value: Any) -> bytes:
    """Change one field of a whole document; ``a.0.b`` is the way to it."""
    document = json.loads(json.dumps(WHOLE))
    *before, last = [int(key) if key.isdigit() else key for key in way.split(".")]
    place = document
    for key in before:
        place = place[key]
    place[last] = value
    return json.dumps(document).encode()


@pytest.mark.parametrize(
    ("way", "value", "field"),
    [
        ("schema", "retropole/result/1", "schema"),
        ("status", "refused", "lidars[0].T_site_lidar"),
        ("lidars.1.T_site_lidar", None, "lidars[1].T_site_lidar"),
        ("lidars.1.T_site_lidar.0.0", 3.0, "lidars[1].T_site_lidar"),
        ("lidars.1.T_site_lidar.0.3", 1e308, "T_site_lidar"),
        ("lidars.1.name", "mast-a", "lidars"),
        ("lidars.1.covariance", (-np.eye(6)).tolist(), "lidars[1].covariance"),
        ("lidars.1.covariance", np.eye(6).tolist(), "lidars[1].covariance"),
        ("joint_covariance", None, "joint_covariance"),
        ("joint_covariance.17", [0.0] * 17, "joint_covariance"),
        ("joint_covariance.0.1", 1.0, "joint_covariance"),
        ("joint_covariance.0", "no row", "joint_covariance"),
        ("frame.offset_m", [0.0, 0.0], "frame.offset_m"),
        ("joint_order.3", "mast-a.phi_x", "joint_order"),
        ("covariance_order", ["x"] * 6, "covariance_order"),
        ("covariance_frame", "LiDAR axes", "covariance_frame"),
        ("reference", 3, "reference"),
        ("groups", [[0, 1]], "groups"),
        ("poles.0.seen_by", [9], "poles[0].seen_by"),
        ("poles.0.placement", 2, "poles[0].placement"),
        ("poles.0.direction", [0.0, 0.0, 0.0], "poles[0].direction"),
        ("pairs.0.lidars", [1, 0], "pairs[0].lidars"),
        ("pairs.0.lidars", [1, 3], "pairs[0].lidars"),
        ("loops.0.lidars", [0, 1, 8], "loops[0].lidars"),
        ("tests.0.pole", 99, "tests[0].pole"),
        ("tests.0.redundancy", 2.0, "redundancy"),
        ("without.0.lidar", 5, "without[0].lidar"),
        ("found", [[]], "found"),
        ("found.1", [None], "found[1]"),
        ("inputs.1.placement", 0, "inputs"),
        ("inputs.1.lidar", 7, "inputs[1].lidar"),
        ("control_points.0.seen.0.lidar", 3, "control_points[0].seen"),
        ("reasons.0.code", "No Code", "reasons[0].code"),
        ("name", "x" * 20_000, "name"),
    ],
)
def test_a_fault_names_its_field(way: str, value: Any, field: str) -> None:
    with pytest.raises(ReadError) as caught:
        decode_site(changed(way, value))
    assert field in str(caught.value)


@pytest.mark.parametrize("data", [b"[" * 200_000, b'{"a":' * 100_000, b"\xff", b"", b"1e999"])
def test_what_is_no_document_is_an_error(data: bytes) -> None:
    with pytest.raises(ReadError):
        decode_site(data)
