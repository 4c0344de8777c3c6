"""The result in words."""

import re

import numpy as np
import pytest

from retropole import se3
from retropole.pipeline import calibrate
from retropole.report.text import describe_detection, describe_result, table, transform_lines
from retropole.result import InputDoc, detection_document, result_document
from retropole.simulation import simulate_pair

INPUTS = [InputDoc(f"{name}.pcd", "0" * 64, 100, 3, "auto", 120.0) for name in ("a", "b")]


def test_tables_line_up() -> None:
    lines = table(("name", "x"), [["a", "1.0"], ["longer", "-22.5"]]).splitlines()
    assert len({len(line) for line in lines}) == 1


@pytest.mark.parametrize("seed", range(5))
def test_every_form_of_a_transform_is_the_same(seed: int) -> None:
    T = se3.random(np.random.default_rng(seed))
    *rows, translation, quaternion, angles = transform_lines(T.tolist())

    def numbers(line: str) -> np.ndarray:
        return np.array([float(n) for n in re.findall(r"-?\d+\.\d+", line)])

    np.testing.assert_allclose([numbers(row) for row in rows], T, atol=1e-8)
    np.testing.assert_allclose(numbers(translation), T[:3, 3], atol=1e-4)
    turn = se3.from_quaternion_xyzw(numbers(quaternion), np.zeros(3))
    np.testing.assert_allclose(turn[:3, :3], T[:3, :3], atol=1e-6)
    roll, pitch, yaw = np.radians(numbers(angles))
    x, y, z = (
        se3.exp_so3(angle * axis) for angle, axis in zip((roll, pitch, yaw), np.eye(3), strict=True)
    )
    np.testing.assert_allclose(z @ y @ x, T[:3, :3], atol=1e-5)


def test_it_names_what_a_person_looks_for() -> None:
    pair = simulate_pair("street", np.random.default_rng(3))
    answer = calibrate(pair.target, pair.source)
    document = result_document(answer, inputs=INPUTS, config={}, seconds={})
    text = describe_result(document, ["r/result.json"])
    for word in ("T_target_source", "margin", "predicted error", "verdict: ", "r/result.json"):
        assert word in text
    assert len([line for line in text.splitlines() if re.match(r"  [a-h]( \*)? ", line)]) == len(
        answer.hypotheses
    )


def test_detections_say_why_a_cluster_is_none() -> None:
    pair = simulate_pair("street", np.random.default_rng(1))
    found = calibrate(pair.target, pair.source).detections[0]
    assert found is not None
    text = describe_detection(detection_document(found, INPUTS[0]), [])
    assert f"{len(found.poles)} poles" in text
    for cluster in found.rejected:
        assert cluster.code in text
