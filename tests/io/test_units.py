"""Files in another unit are read as metres."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from retropole.base.datatypes import PointCloud
from retropole.base.errors import UsageError
from retropole.io import read_cloud, read_recording, write_pcd
from tests.io.files import INTENSITY, XYZ
from tests.paths import SHARED


def test_a_file_is_read_in_its_unit(tmp_path: Path) -> None:
    cloud = PointCloud(XYZ, INTENSITY, origin=np.array([0.0, 0.0, 0.25]))
    write_pcd(tmp_path / "mm.pcd", replace(cloud, xyz=1000 * XYZ, origin=1000 * cloud.origin))
    read = read_cloud(tmp_path / "mm.pcd", unit="mm")
    np.testing.assert_allclose(read.xyz, cloud.xyz, rtol=1e-6)
    np.testing.assert_allclose(read.origin, cloud.origin)
    with pytest.raises(UsageError, match="unit is 'inch', expected m, cm, mm"):
        read_cloud(tmp_path / "mm.pcd", unit="inch")  # type: ignore[arg-type]


def test_packets_are_metres(tmp_path: Path) -> None:
    capture = SHARED / "formats/velodyne/sample_velodyne_vlp16_gps.pcap"
    if not capture.exists():
        pytest.skip("recordings are not here")
    pytest.importorskip("velodyne_decoder")
    with pytest.raises(UsageError, match="packets are decoded to metres"):
        read_recording(capture, unit="mm")
