"""Written pairs read back, here and with another reader."""

import json
from pathlib import Path

import numpy as np
from pypcd4.pypcd4 import PointCloud as OtherReader

from retropole.io import read_cloud
from retropole.simulation import simulate_pair, write_pair


def test_what_is_written_reads_back_here_and_elsewhere(tmp_path: Path) -> None:
    pair = simulate_pair("corridor", np.random.default_rng(1))
    write_pair(pair, tmp_path)
    truth = json.loads((tmp_path / "truth.json").read_text())
    np.testing.assert_array_equal(truth["T_target_source"], pair.T_target_source)
    assert len(truth["poles"]) == len(pair.poles)
    assert truth["noise"]["ring_bias"] == pair.noise.ring_bias
    for role, device in zip(("target", "source"), pair.devices, strict=True):
        np.testing.assert_array_equal(truth["devices"][role]["ring_range_m"], device.ring_range)
        assert truth["devices"][role]["tape_offset_m"] == device.tape_offset
    for name, cloud in (("lidar0.pcd", pair.target), ("lidar1.pcd", pair.source)):
        ours = read_cloud(tmp_path / name)
        theirs = OtherReader.from_path(tmp_path / name)
        assert ours.intensity is not None
        np.testing.assert_allclose(ours.xyz, cloud.xyz, atol=1e-5)
        np.testing.assert_array_equal(ours.xyz, theirs.numpy(("x", "y", "z")).astype(float))
        np.testing.assert_array_equal(ours.intensity, theirs.numpy(("intensity",))[:, 0])
