"""Files in another unit are read as metres."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from retropole.base.datatypes import PointCloud
from retropole.base.errors import UsageError
from retropole.io import read_cloud, read_recording, write_pcd
from retropole.io.units import Unit
from tests.io.files import INTENSITY, XYZ
from tests.paths import SHARED

IN_A_METRE: dict[Unit, float] = {"cm": 100, "mm": 1000, "ft": 1 / 0.3048, "in": 12 / 0.3048}


@pytest.mark.parametrize(("unit", "factor"), IN_A_METRE.items())
def test_a_file_is_read_in_its_unit(unit: Unit, factor: float, tmp_path: Path) -> None:
    cloud = PointCloud(XYZ, INTENSITY, origin=np.array([0.0, 0.0, 0.25]))
    path = tmp_path / "a.pcd"
    write_pcd(path, replace(cloud, xyz=factor * XYZ, origin=factor * cloud.origin))
    read = read_cloud(path, unit=unit)
    np.testing.assert_allclose(read.xyz, cloud.xyz, rtol=1e-6)
    np.testing.assert_allclose(read.origin, cloud.origin, rtol=1e-6)
    with pytest.raises(UsageError, match="unit is 'inch', expected m, cm, mm, ft, in"):
        read_cloud(path, unit="inch")  # type: ignore[arg-type]


def test_packets_are_metres(tmp_path: Path) -> None:
    capture = SHARED / "formats/velodyne/sample_velodyne_vlp16_gps.pcap"
    if not capture.exists():
        pytest.skip("recordings are not here")
    pytest.importorskip("velodyne_decoder")
    with pytest.raises(UsageError, match="packets are decoded to metres"):
        read_recording(capture, unit="mm")
