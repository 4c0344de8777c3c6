"""Written pairs read back, here and with another reader."""

import json
from pathlib import Path

import numpy as np
import pytest
from pypcd4.pypcd4 import PointCloud as OtherReader

from retropole.io import read_cloud
from retropole.simulation import simulate_pair, simulate_site, write_pair, write_site


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


@pytest.mark.full
def test_several_sweeps_are_a_folder_and_leave_none_of_a_run_before(tmp_path: Path) -> None:
    for frames in (4, 3):
        pair = simulate_pair("bare", np.random.default_rng(1), frames=frames)
        assert write_pair(pair, tmp_path) == ("lidar0", "lidar1")
    assert json.loads((tmp_path / "truth.json").read_text())["source"] == "lidar1"
    assert sorted(path.name for path in (tmp_path / "lidar0").glob("*.pcd")) == [
        *("000.pcd", "001.pcd", "002.pcd")
    ]
    ours = read_cloud(tmp_path / "lidar1")
    assert ours.frame is not None
    assert ours.time is not None
    assert pair.source.frame is not None
    np.testing.assert_array_equal(ours.frame, pair.source.frame)
    np.testing.assert_allclose(ours.xyz, pair.source.xyz, atol=1e-5)
    assert np.floor(ours.time / 0.1 + 1e-6).tolist() == ours.frame.tolist()


def test_a_site_of_several_sweeps_names_its_folders(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    site = simulate_site("posts", rng, lidars=2, placements=1, frames=2, sensors=["AT128", "HAP"])
    write_site(site, tmp_path)
    assert {path.name for path in tmp_path.iterdir() if path.name[0] != "."} == {
        *("posts-1_1", "posts-2_1", "site.toml", "truth.json")
    }
    assert '"posts-1_1"' in (tmp_path / "site.toml").read_text()
