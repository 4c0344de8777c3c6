"""A unit's own angles are read from its file, and used instead of the table's."""

from pathlib import Path

import numpy as np
import pytest

import retropole as rp
from retropole.base.errors import ReadError, UsageError
from retropole.io import open_recording, read_recording
from retropole.io.fields import Wanted
from retropole.io.packets.angles import read_angles
from tests.cli.commands import retropole_here
from tests.io.packets.sending import angles_of as table
from tests.io.packets.sending import datagram, hesai, model_named, pcap

MODEL = model_named("XT16")


@pytest.mark.parametrize("heading", ["Channel,Elevation,Azimuth", "EEFF,1,1,\nLaser id,El,Az"])
def test_a_table_is_read(tmp_path: Path, heading: str) -> None:
    angles = read_angles(table(tmp_path / "a.csv", 16, heading), MODEL)
    np.testing.assert_allclose(np.degrees(angles.elevation), np.arange(16) - 5.5)
    np.testing.assert_allclose(np.degrees(angles.azimuth), np.arange(16) / 100)


def test_a_table_of_another_model_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ReadError, match=r"of 15 channels, expected .* all 16 of a Hesai XT16"):
        read_angles(table(tmp_path / "a.csv", 15), MODEL)
    with pytest.raises(ReadError, match=r"no\.csv"):
        read_angles(tmp_path / "no.csv", MODEL)


def test_the_notes_say_which_angles_were_used(tmp_path: Path) -> None:
    raw = np.full((30, 8, 16), 2500)
    payloads = hesai(MODEL, raw, np.arange(240).reshape(30, 8) * 150 % 36_000)
    path = tmp_path / "a.pcap"
    path.write_bytes(pcap([datagram(payload) for payload in payloads]))
    plain = read_recording(path).cloud
    own = read_recording(path, wanted=Wanted(angles=str(table(tmp_path / "unit.csv", 16)))).cloud
    assert plain.notes == ("angles of Hesai XT16: the table of the model",)
    assert own.notes == ("angles of Hesai XT16: unit.csv",)
    assert (plain.nominal_angles, own.nominal_angles) == ("Hesai XT16", "")
    up = np.degrees(np.arcsin(own.xyz[:, 2] / 10))
    np.testing.assert_allclose(np.unique(up.round(6)), np.arange(16) - 5.5, atol=1e-5)
    cloud = tmp_path / "a.xyz"
    cloud.write_text("1 2 3\n")
    with pytest.raises(UsageError, match="has no packets"):
        open_recording(cloud, wanted=Wanted(angles=str(path)))
    known = Wanted().or_known(Wanted(angles=str(path)))
    assert open_recording(cloud, wanted=known).count == 1


def test_commands_take_the_file_and_a_result_keeps_it(tmp_path: Path) -> None:
    raw = np.full((30, 8, 16), 2500)
    payloads = hesai(MODEL, raw, np.arange(240).reshape(30, 8) * 150 % 36_000)
    path, unit = tmp_path / "a.pcap", table(tmp_path / "unit.csv", 16)
    path.write_bytes(pcap([datagram(payload) for payload in payloads]))
    shown = retropole_here("info", path, "--angles", unit).stdout
    assert "angles of Hesai XT16: unit.csv" in shown
    result = rp.calibrate(path, path, angles=str(unit))
    config = result.document.config
    assert (config.angles, config.angles_source) == (str(unit), None)
    done = retropole_here("detect", path, "--angles", tmp_path / "no.csv", "--out", tmp_path / "o")
    assert "no.csv" in done.stderr
