"""Configurations of drivers: what only they have; that all formats have, tests of those have."""

from __future__ import annotations

import json

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.errors import ReadError
from retropole.export.drivers import read_driver, read_livox, read_ouster, write_livox
from retropole.export.transform import Transform

RSLIDAR = """
      x: 1
      y: 0
      z: 2.5
      roll: 0.1
      pitch: 0.2
      yaw: 1.57
"""
"""As the manual of rslidar_sdk has it, in its place in the file."""


def test_options_are_read_as_they_are_in_the_manual() -> None:
    (found,) = read_driver(RSLIDAR.encode())
    R = se3.rotation_from_rpy(np.array([0.1, 0.2, 1.57]))
    np.testing.assert_allclose(found.pose(), se3.from_rt(R, np.array([1, 0, 2.5])), atol=1e-12)


@pytest.mark.parametrize("flag", ["false", "False", "0", "''"])
def test_a_transform_that_is_switched_off_is_none(flag: str) -> None:
    with pytest.raises(ReadError, match="transform_flag is not true"):
        read_driver(f"transform_flag: {flag}\n{RSLIDAR}".encode())


def test_livox_takes_whole_millimetres_and_degrees() -> None:
    R = se3.rotation_from_rpy(np.radians([10.0, -20.0, 30.0]))
    T = se3.from_rt(R, np.array([1.2344, -0.0006, 0.0]))
    document = json.loads(write_livox(Transform(T, "a", "b")))
    assert "0.5 mm" in document["description"]
    given = document["extrinsic_parameter"]
    assert [given[axis] for axis in "xyz"] == [1234, -1, 0]
    np.testing.assert_allclose([given[n] for n in ("roll", "pitch", "yaw")], [10, -20, 30])


@pytest.mark.parametrize(
    "given", [{"roll": 0}, {"x": "a"}, [], {"yaw": 400.0}, {"x": 1, "y": 1, "z": 1, "qw": 1}]
)
def test_what_is_no_extrinsic_parameter_is_refused(given: object) -> None:
    with pytest.raises(ReadError):
        read_livox(json.dumps({"extrinsic_parameter": given}).encode())[0].pose()


@pytest.mark.parametrize(
    "text", ["ouster-cli source x viz", '-e "1 2 3"', '-e "1 2 3 0 0 0 1" -e "1 2 3 0 0 0 1"']
)
def test_extrinsics_of_ouster_are_seven_numbers_once(text: str) -> None:
    with pytest.raises(ReadError, match="expected"):
        read_ouster(text.encode())
