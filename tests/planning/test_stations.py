import numpy as np
import pytest

from benchmarks.again import record_again
from retropole.base import se3
from retropole.base.datatypes import Scan
from retropole.base.errors import Refusal
from retropole.planning.stations import bare_scan, place_lidars, refine
from retropole.simulation import SimulatedPair, simulate_pair

pytestmark = pytest.mark.full


@pytest.fixture(scope="module")
def street() -> SimulatedPair:
    pair = simulate_pair("street", np.random.default_rng(1), sensor_target="XT32")
    return record_again(pair, np.random.default_rng(2), poles=False)


@pytest.fixture(scope="module")
def scans(street: SimulatedPair) -> tuple[Scan, Scan]:
    """What both LiDARs recorded."""
    return bare_scan(street.target, street.sensors[0]), bare_scan(street.source, street.sensors[1])


def turned(by_deg: tuple[float, float, float], by_m: tuple[float, float, float]) -> np.ndarray:
    return se3.from_rt(se3.rotation_from_rpy(np.radians(by_deg)), np.array(by_m))


def test_a_rough_pose_settles_on_the_place(street: SimulatedPair, scans: tuple[Scan, Scan]) -> None:
    rough = street.T_target_source @ turned((3, -4, 8), (0.5, -0.6, 0.3))
    stood = place_lidars(("a", "b"), scans, (np.eye(4), rough))
    found = se3.inverse(stood[0].T) @ stood[1].T
    apart = se3.difference(found, street.T_target_source)
    assert apart.rotation < np.radians(0.5)
    assert apart.translation < 0.05
    assert stood[1].is_refined
    # The origin is on the ground below the first LiDAR, and z is up.
    np.testing.assert_allclose(stood[0].at[:2], 0.0, atol=1e-9)
    up = street.T_world_target[2, :3] @ stood[0].T[:3, :3].T
    np.testing.assert_allclose(up, [0, 0, 1], atol=0.02)


@pytest.mark.parametrize(
    ("by", "words"),
    [((0, 0, 40), "saw to be empty"), ((180, 0, 0), "upside down"), ((0, 40, 0), "tilted by")],
)
def test_a_wrong_rough_pose_is_refused(
    street: SimulatedPair, scans: tuple[Scan, Scan], by: tuple[float, float, float], words: str
) -> None:
    with pytest.raises(Refusal, match=words) as refusal:
        refine("a", "b", *scans, street.T_target_source @ turned(by, (0, 0, 0)))
    assert refusal.value.code == "pose_contradicted"
