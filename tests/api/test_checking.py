"""What a stored result holds for a check, also between two LiDARs of a site."""

import os
from pathlib import Path

import numpy as np
import pytest

from retropole.api.checking import read_stored
from retropole.api.inputs import recording_hash
from retropole.api.site import SiteResult
from retropole.base.errors import ReadError
from retropole.io import sha256_of
from retropole.result import DEFAULT_CONFIG, encode
from retropole.result.folder import SITE_RESULT_FILE
from tests.export.sites import free


def test_of_a_site_the_pose_between_two_lidars_is_stored(tmp_path: Path) -> None:
    (tmp_path / SITE_RESULT_FILE).write_bytes(encode(free()))
    site = SiteResult(free())
    first, *_, last = site.lidars
    stored = read_stored(tmp_path, lidars=(first, last))
    np.testing.assert_allclose(stored.pose.T_target_source, site.T(first, last), atol=1e-12)
    assert stored.pose.covariance is not None
    np.testing.assert_allclose(stored.pose.covariance, site.covariance(first, last), atol=1e-15)
    assert (stored.config, stored.warnings, stored.uncertainty) == (DEFAULT_CONFIG, (), None)
    with pytest.raises(ReadError, match="0 transforms fit"):
        read_stored(tmp_path, lidars=(first, "nobody"))


def test_a_recording_is_hashed_and_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    recording = tmp_path / "a.pcd"
    recording.write_bytes(b"abc")
    assert recording_hash(recording) == sha256_of(recording)
    os.mkfifo(tmp_path / "pipe.pcd")
    with pytest.raises(ReadError, match="neither a file nor a folder"):
        recording_hash(tmp_path / "pipe.pcd")
