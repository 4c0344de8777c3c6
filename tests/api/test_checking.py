"""What a stored result holds for a check, also between two LiDARs of a site."""

import os
from pathlib import Path

import numpy as np
import pytest

from retropole.api.checking import read_stored
from retropole.api.inputs import recording_hash
from retropole.api.result import SiteResult
from retropole.base.errors import ReadError, Refusal
from retropole.io import sha256_of
from retropole.result import SITE_RESULT_FILE, encode
from tests.export.sites import free, refused


def test_of_a_site_the_pose_between_two_lidars_is_stored(tmp_path: Path) -> None:
    (tmp_path / SITE_RESULT_FILE).write_bytes(encode(free()))
    site = SiteResult(free())
    first, *_, last = site.lidars
    stored = read_stored(tmp_path, lidars=(first, last))
    np.testing.assert_allclose(stored.pose.T_target_source, site.T(first, last), atol=1e-12)
    assert stored.pose.covariance is not None
    np.testing.assert_allclose(stored.pose.covariance, site.covariance(first, last), atol=1e-15)
    assert (stored.warnings, stored.uncertainty) == ((), None)
    document, config = free(), stored.config
    assert (config.radius_m, config.unit) == (document.radius_m, "m")
    sensors = [lidar.sensor for lidar in document.lidars]
    assert [config.sensor_target, config.sensor_source] == [sensors[0], sensors[-1]]
    of_both = {0: set[str](), len(sensors) - 1: set[str]()}
    for each in document.inputs:
        of_both.setdefault(each.lidar, set()).add(each.sha256)
    assert len(stored.hashes) == 1
    assert stored.hashes[0][0] in of_both[0]
    assert stored.hashes[0][1] in of_both[len(sensors) - 1]
    for names in ((first, "nobody"), (first, first), (first, "site"), None):
        with pytest.raises(ReadError, match=f"--parent .* --child; there are {first}, .*{last}"):
            read_stored(tmp_path, lidars=names)


def test_of_a_refused_site_nothing_is_stored(tmp_path: Path) -> None:
    (tmp_path / SITE_RESULT_FILE).write_bytes(encode(refused()))
    for names in (None, ("mast-a", "mast-b")):
        with pytest.raises(Refusal):
            read_stored(tmp_path, lidars=names)


def test_a_recording_is_hashed_and_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    recording = tmp_path / "a.pcd"
    recording.write_bytes(b"abc")
    assert recording_hash(recording) == sha256_of(recording)
    os.mkfifo(tmp_path / "pipe.pcd")
    with pytest.raises(ReadError, match="is a named pipe, expected a file"):
        recording_hash(tmp_path / "pipe.pcd")
