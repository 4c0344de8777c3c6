"""Coordinates that no frame has are no returns, or refused; quickly, and in little memory."""

import subprocess
import sys

import pytest

from tests.tiers import first_of

pytestmark = pytest.mark.full

CODE = """
import resource, sys, warnings
resource.setrlimit(resource.RLIMIT_AS, (2 * 2**30, 2 * 2**30))
warnings.simplefilter("error")
from dataclasses import replace
import numpy as np
import retropole
from retropole.base.datatypes import PoseEstimate
from retropole.io import only_returns
from retropole.checking.drift import check
from retropole.simulation import simulate_pair

pair = simulate_pair(
    "corridor", np.random.default_rng(3), sensor_target="VLP-16", sensor_source="VLP-16"
)
stored = PoseEstimate(pair.T_target_source, 1e-6 * np.eye(6), 0.01)
size, count = float(sys.argv[1]), int(sys.argv[2])
xyz = pair.target.xyz.copy()
xyz[:count] = size * np.sign(xyz[:count])
broken = replace(pair.target, xyz=xyz)

def calibrated(target, source):
    document = retropole.calibrate(target, source).document
    if document.status == "refused":
        raise retropole.Refusal(document.reasons[0].code, "")
    assert document.inputs[0].dropped + document.inputs[1].dropped == count

for work in (
    lambda: calibrated(broken, pair.source),
    lambda: calibrated(pair.source, broken),
    lambda: retropole.detect(broken),
    lambda: retropole.evaluate(broken, pair.source, pair.T_target_source),
    lambda: check(stored, only_returns(broken, "a"), pair.source),
):
    try:
        work()
    except retropole.Refusal as refusal:
        print(refusal.code)
    except retropole.UsageError:
        print("usage")
    else:
        print("answered")
"""


@pytest.mark.parametrize(
    ("size", "count", "said"),
    first_of(
        [
            ("2e8", 1, "far_from_lidar"),
            ("1e30", 1, "answered"),
            ("2e8", 10**6, "far_from_lidar"),
            ("1e300", 10**6, "usage"),
        ],
        2,
    ),
)
def test_huge_coordinates(size: str, count: int, said: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", CODE, size, str(count)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.stdout.split() == [said] * 5, done.stderr
    assert done.stderr == ""
