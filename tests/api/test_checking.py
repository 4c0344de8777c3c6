"""What a stored result holds for a check, also between two LiDARs of a site."""

import os
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

import retropole as rp
from retropole.api.checking import check_recordings, check_site, read_stored
from retropole.api.inputs import Listener, recording_hash
from retropole.api.result import SiteResult
from retropole.api.stored import scans_of
from retropole.base.datatypes import PointCloud
from retropole.base.errors import ReadError, Refusal, UsageError
from retropole.io import sha256_of
from retropole.io.fields import Wanted
from retropole.result import RESULT_FILE, SITE_RESULT_FILE, encode
from tests.api.clouds import calibrated, pair
from tests.api.site_files import recorded
from tests.export.sites import free, refused
from tests.io.files import required
from tests.io.packets.sending import angles_of, datagram, pcap, turning


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
        with pytest.raises(ReadError, match=f"--parent .* --child; it has {first}, .*{last}"):
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


@pytest.mark.full
def test_new_recordings_are_read_as_those_of_the_run_where_that_is_of_use(tmp_path: Path) -> None:
    document = calibrated().document
    unit = angles_of(tmp_path / "unit.csv", 16)
    known = {"intensity": "echo", "angles": "unit.csv", "angles_source": "unit.csv"}
    document = replace(document, config=replace(document.config, **known))
    (tmp_path / RESULT_FILE).write_bytes(encode(document))
    stored = read_stored(tmp_path)
    packets, both, plain = (tmp_path / name for name in ("a.pcap", "both.npz", "plain.npz"))
    packets.write_bytes(pcap([datagram(each) for each in turning("XT16")]))
    cloud = recorded(1)
    echo = required(cloud.intensity)
    np.savez(both, xyz=cloud.xyz, intensity=np.ones(200), echo=echo)
    np.savez(plain, xyz=cloud.xyz, intensity=np.full(200, 7.0))

    def read(target: Path, source: Path, **given: Any) -> list[PointCloud]:
        clouds = list[PointCloud]()
        listener = Listener(on_read=lambda each: clouds.append(each.cloud))
        with suppress(Refusal):
            check_recordings(stored, target, source, listener=listener, **given)
        return clouds

    first, second = read(packets, both)
    assert first.notes == ("angles of Hesai XT16: unit.csv",)
    np.testing.assert_array_equal(second.intensity, echo)
    first, second = read(plain, packets)
    np.testing.assert_array_equal(first.intensity, np.full(200, 7.0))
    assert second.notes == ("angles of Hesai XT16: unit.csv",)
    first, second = read(both, both, intensity_source="intensity")
    np.testing.assert_array_equal(first.intensity, echo)
    np.testing.assert_array_equal(second.intensity, np.ones(200))
    other = angles_of(tmp_path / "other.csv", 16)
    first, second = read(packets, packets, angles_source=str(other))
    assert (first.notes, second.notes) == (
        ("angles of Hesai XT16: unit.csv",),
        ("angles of Hesai XT16: other.csv",),
    )
    # What is given must be of use.
    with pytest.raises(UsageError, match="has no packets"):
        read(plain, packets, angles=str(unit))
    with pytest.raises(ReadError, match=r"range: no such field; the fields are: .*echo"):
        read(both, both, intensity="range")
    unit.unlink()
    with pytest.raises(ReadError, match=r"unit\.csv"):
        read(packets, packets)


def test_of_a_site_angles_and_fields_are_those_of_each_lidar(tmp_path: Path) -> None:
    site = free()
    inputs = [
        replace(each, **({"angles": "unit.csv"} if each.lidar == 0 else {"intensity": "echo"}))
        for each in site.inputs
    ]
    (tmp_path / SITE_RESULT_FILE).write_bytes(encode(replace(site, inputs=inputs)))
    first, *_, last = (lidar.name for lidar in site.lidars)
    unit = str((tmp_path / "unit.csv").resolve())
    config = read_stored(tmp_path, lidars=(first, last)).config
    assert (config.of_target.wanted, config.of_source.wanted) == (
        Wanted(None, unit),
        Wanted("echo"),
    )
    config = read_stored(tmp_path, lidars=(last, first)).config
    assert (config.of_target.wanted, config.of_source.wanted) == (
        Wanted("echo"),
        Wanted("", unit),
    )


@pytest.mark.full
def test_a_named_field_gives_the_same_answer_through_options_site_file_and_check(
    tmp_path: Path,
) -> None:
    clouds = {"target": pair().target, "source": pair().source}
    for name, cloud in clouds.items():
        echo = required(cloud.intensity)
        np.savez(tmp_path / f"{name}.npz", xyz=cloud.xyz, intensity=np.ones(len(cloud)), echo=echo)
        np.savez(tmp_path / f"{name}-plain.npz", xyz=cloud.xyz, intensity=echo)
    files = [str(tmp_path / f"{name}.npz") for name in clouds]
    plain = [str(tmp_path / f"{name}-plain.npz") for name in clouds]
    named = rp.calibrate(*files, options=rp.RunConfig(refine=False, intensity="echo"))
    expected = rp.calibrate(*plain, options=rp.RunConfig(refine=False))
    np.testing.assert_array_equal(named.T_target_source, expected.T_target_source)
    # Its page shows the poles again, so it reads the field that the run read.
    named.save(tmp_path / "out")
    scans = scans_of(named.document, tmp_path).scans
    assert all(scan is not None and scan.detection is not None for row in scans for scan in row)
    stored = read_stored(tmp_path / "out")
    assert check_recordings(stored, *map(Path, files)).status == "same"
    assert check_recordings(stored, *map(Path, plain)).status == "same"
    answers = []
    for key, suffix in (('intensity = "echo"\n', ""), ("", "-plain")):
        lidars = (
            f'[[lidar]]\nname = "{name}"\nrecordings = ["{name}{suffix}.npz"]\n{key}'
            for name in clouds
        )
        path = tmp_path / f"site{suffix}.toml"
        path.write_text('name = "Quay"\nplacements = ["1"]\n' + "".join(lidars))
        answers.append(rp.calibrate_site(path))
    first, second = (each.T("target", "source") for each in answers)
    np.testing.assert_array_equal(first, second)
    # New recordings of the site, whose file does not name the field.
    answers[0].save(tmp_path / "of-site")
    path.write_text(path.read_text().replace("-plain", ""))
    answer = check_site(tmp_path / "of-site", path)
    assert answer.status == "same", answer
