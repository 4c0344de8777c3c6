"""Coordinates that no frame has: refused with the reason, quickly and without much memory."""

import subprocess
import sys

import pytest

CODE = """
import resource, sys, warnings
resource.setrlimit(resource.RLIMIT_AS, (2 * 2**30, 2 * 2**30))
warnings.simplefilter("error")
from dataclasses import replace
import numpy as np
import retropole
from retropole.datatypes import PoseEstimate
from retropole.monitoring.drift import check
from retropole.simulation import simulate_pair

pair = simulate_pair(
    "corridor", np.random.default_rng(3), sensor_target="VLP-16", sensor_source="VLP-16"
)
stored = PoseEstimate(pair.T_target_source, 1e-6 * np.eye(6), 0.01)
size, count = float(sys.argv[1]), int(sys.argv[2])
xyz = pair.target.xyz.copy()
xyz[:count] = size * np.sign(xyz[:count])
broken = replace(pair.target, xyz=xyz)
print(retropole.calibrate(broken, pair.source).document.reasons[0].code)
print(retropole.calibrate(pair.source, broken).document.reasons[0].code)
for work in (
    lambda: retropole.detect(broken),
    lambda: retropole.evaluate(broken, pair.source, pair.T_target_source),
    lambda: check(stored, broken, pair.source),
):
    try:
        work()
    except retropole.Refusal as refusal:
        print(refusal.code)
"""


@pytest.mark.parametrize(("size", "count"), [("1e30", 1), ("1e300", 10**6)])
def test_huge_coordinates_are_refused(size: str, count: int) -> None:
    done = subprocess.run(
        [sys.executable, "-c", CODE, size, str(count)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.stdout.split() == ["far_from_lidar"] * 5, done.stderr
    assert done.stderr == ""
