"""``retropole export`` of a whole site, as a user runs it."""

import json
from pathlib import Path

import numpy as np
import pytest

from retropole.export import FORMATS, TREE_FORMATS, read_transform
from retropole.result import encode
from tests.cli.commands import Done, retropole_here
from tests.export import sites
from tests.export.test_export import ROUNDING


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("site") / "site-result.json"
    path.write_bytes(encode(sites.surveyed()))
    return path


def export(*words: object) -> Done:
    return retropole_here("export", *words)


@pytest.mark.parametrize("fmt", TREE_FORMATS)
def test_all_frames_are_written_printed_or_to_a_file(
    fmt: str, result: Path, tmp_path: Path
) -> None:
    done = export(result.parent, "--to", fmt)
    assert (done.returncode, done.stderr) == (0, "")
    assert all(name in done.stdout for name in ("mast-a", "mast-b", "gate"))
    out = tmp_path / "out"
    assert export(result, "--to", fmt, "--out", out).returncode == 0
    assert out.read_text().strip() == done.stdout.strip()


def test_a_recording_is_a_file(result: Path, tmp_path: Path) -> None:
    pytest.importorskip("rosbags", reason="rosbags is not installed: pip install 'retropole[ros]'")
    out = tmp_path / "site.mcap"
    assert export(result, "--to", "mcap", "--out", out).returncode == 0
    assert out.read_bytes().startswith(b"\x89MCAP")
    assert "needs --out" in export(result, "--to", "mcap").stderr


@pytest.mark.parametrize("fmt", FORMATS)
def test_two_of_its_frames_go_into_any_format(fmt: str, result: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = export(
        result, "--to", fmt, "--parent", "mast-b", "--child", "gate", "--out", out, "--invert"
    )
    assert (done.returncode, done.stderr) == (0, "")
    back = read_transform(out, fmt=fmt)
    assert (back.parent, back.child) == ("gate", "mast-b")


@pytest.mark.parametrize("fmt", FORMATS)
def test_a_mounting_is_that_of_a_lidar_of_the_site(fmt: str, result: Path, tmp_path: Path) -> None:
    mounting, out = tmp_path / "mounting.yaml", tmp_path / "out"
    mounting.write_text("truck: {mast-b: {x: 1, y: 0, z: 2, roll: 0, pitch: 0, yaw: 0.5}}")
    words = ("--to", fmt, "--mounting", mounting, "--child", "gate", "--out", out)
    assert export(result, *words).returncode == 0
    between = read_transform(result, parent="mast-b", child="gate").T_parent_child
    back = read_transform(out, fmt=fmt)
    expected = read_transform(mounting).T_parent_child @ between
    assert (back.parent, back.child) == ("truck", "gate")
    np.testing.assert_allclose(back.T_parent_child, expected, atol=ROUNDING.get(fmt, 1e-9))
    # The names of a site are those of its LiDARs: none is called something else.
    for name in ("base_link", "front"):
        done = export(result, "--to", fmt, "--parent", name, "--child", "gate")
        assert done.returncode == 2
        assert "0 transforms fit" in done.stderr


def test_a_refused_site_exits_with_3_and_writes_nothing(tmp_path: Path) -> None:
    path, out = tmp_path / "site-result.json", tmp_path / "out.json"
    path.write_bytes(encode(sites.refused()))
    for words in ((), ("--parent", "mast-a", "--child", "gate")):
        done = export(path, "--to", "json", "--out", out, *words)
        assert done.returncode == 3
        assert "the site was refused" in done.stderr
        assert not out.exists()


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("--to", "matrix"), "has one transform; name two frames"),
        (("--to", "urdf", "--parent", "mast-a"), "together name two of its frames"),
        (("--to", "urdf", "--invert"), "together name two of its frames"),
        (("--into", "robot.urdf"), "together name two of its frames"),
        (("--to", "json", "--parent", "mast-a", "--child", "mast-z"), "0 transforms fit"),
        (("--to", "geojson", "--parent", "mast-a", "--child", "gate"), "takes all of a site"),
    ],
)
def test_bad_usage_says_why(words: tuple[str, ...], reason: str, result: Path) -> None:
    done = export(result, *words)
    assert done.returncode == 2
    assert reason in done.stderr


def test_a_transform_of_two_is_no_site(result: Path, tmp_path: Path) -> None:
    pair = tmp_path / "pair.json"
    words = ("--parent", "mast-b", "--child", "gate")
    assert export(result, "--to", "json", *words, "--out", pair).returncode == 0
    assert len(json.loads(pair.read_text())["covariance"]) == 6
    done = export(pair, "--to", "geojson")
    assert done.returncode == 2
    assert "takes all of a site" in done.stderr


def test_what_is_not_sound_is_an_error_that_names_the_file(tmp_path: Path) -> None:
    path = tmp_path / "site-result.json"
    path.write_text('{"schema": "retropole/site-result/1"}')
    done = export(path, "--to", "yaml")
    assert done.returncode == 2
    assert "site-result.json: no result document of a site" in done.stderr


def test_help_lists_every_format_of_a_site() -> None:
    text = export("--help").stdout
    for name, each in TREE_FORMATS.items():
        assert f"\n    {name} " in text
        assert each.title in text
