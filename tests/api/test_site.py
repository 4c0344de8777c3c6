"""`calibrate_site`, and what its result gives."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import retropole as rp
from retropole.adjustment.answer import SiteCalibration
from retropole.base import se3
from retropole.base.bounded import Status
from retropole.base.datatypes import Array
from retropole.base.description import Site
from retropole.base.errors import ReadError, Refusal, UsageError
from retropole.base.se3 import joint_of, relative
from retropole.result.decoding import decode_site
from tests.api.site_files import NAMES, answer_to, recorded, write_site


def answering(monkeypatch: pytest.MonkeyPatch, status: Status = "ok") -> None:
    def answer(site: Site, **options: object) -> SiteCalibration:
        return answer_to(site, status)

    monkeypatch.setattr("retropole.pipeline.calibrate_site", answer)


@pytest.fixture
def result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> rp.SiteResult:
    answering(monkeypatch)
    return rp.calibrate_site(write_site(tmp_path))


def pose(result: rp.SiteResult, name: str) -> Array:
    return result.pose(name).T_site_lidar


def test_any_two_lidars_have_a_transform(result: rp.SiteResult) -> None:
    assert result.status == "ok"
    assert result.lidars == NAMES
    point = np.array([[1.0, 2.0, 3.0]])
    np.testing.assert_allclose(
        se3.apply(pose(result, "gate"), se3.apply(result.T("gate", "mast-b"), point)),
        se3.apply(pose(result, "mast-b"), point),
        atol=1e-12,
    )
    np.testing.assert_allclose(
        result.T("mast-a", "gate") @ result.T("gate", "mast-a"), np.eye(4), atol=1e-12
    )


def test_its_covariance_counts_what_both_have_in_common(result: rp.SiteResult) -> None:
    assert result.calibration is not None
    whole = result.calibration.covariance
    assert whole is not None
    found = relative(pose(result, "gate"), pose(result, "mast-b"), joint_of(whole, 2, 1))
    np.testing.assert_allclose(result.covariance("gate", "mast-b"), found.covariance)
    np.testing.assert_allclose(result.covariance("gate", "gate"), 0.0, atol=1e-18)


def test_an_unknown_name_is_told(result: rp.SiteResult) -> None:
    with pytest.raises(UsageError, match="no LiDAR 'quay'; there are mast-a, mast-b, gate"):
        result.T("mast-a", "quay")


def test_it_is_saved_whole(result: rp.SiteResult, tmp_path: Path) -> None:
    written = result.save(tmp_path / "out")
    assert [path.name for path in written] == ["site-result.json", "site-report.html"]
    assert decode_site(written[0].read_bytes()).name == "Quay"
    assert written[1].read_text().lower().startswith("<!doctype html>")


def test_what_is_loaded_says_the_same(result: rp.SiteResult, tmp_path: Path) -> None:
    result.save(tmp_path / "out", relative=False)
    for place in (tmp_path / "out", tmp_path / "out" / "site-result.json"):
        loaded = rp.load_site_result(place)
        assert loaded.document == result.document
        assert (loaded.lidars, repr(loaded)) == (NAMES, repr(result))
        for a, b in (("mast-a", "gate"), ("gate", "mast-b")):
            np.testing.assert_array_equal(loaded.T(a, b), result.T(a, b))
            np.testing.assert_array_equal(loaded.covariance(a, b), result.covariance(a, b))
        assert loaded.pose("gate").budget == result.pose("gate").budget
    loaded.save(tmp_path / "again", relative=False)
    assert rp.load_site_result(tmp_path / "again").document == result.document


def test_the_recordings_are_named_as_seen_from_the_result(
    result: rp.SiteResult, tmp_path: Path
) -> None:
    (tmp_path / "out").mkdir()
    for folder in (tmp_path / "out", tmp_path / "a" / "gain"):
        result.save(folder)
        document = rp.load_site_result(folder).document
        names = [*(each.path for each in document.inputs), document.config.site_file]
        assert not any(Path(name).is_absolute() for name in names)
        assert all((folder / name).exists() for name in names)


def test_what_is_no_result_of_a_site_is_not_loaded(tmp_path: Path) -> None:
    with pytest.raises(ReadError, match=r"site-result\.json: cannot be read"):
        rp.load_site_result(tmp_path)
    (tmp_path / "result.json").write_text("{}")
    with pytest.raises(ReadError, match=r"result\.json: no result document of a site"):
        rp.load_site_result(tmp_path / "result.json")


def test_it_prints_where_each_lidar_is(result: rp.SiteResult) -> None:
    words = repr(result)
    assert words.startswith("SiteResult: ok")
    for name in NAMES:
        assert name in words


def test_a_notebook_shows_where_each_lidar_is(result: rp.SiteResult) -> None:
    page = result._repr_html_()
    assert "<td" in page
    for name in NAMES:
        assert name in page


@pytest.mark.full
def test_plot_draws_every_lidar_with_the_clouds_that_are_found(
    result: rp.SiteResult, tmp_path: Path
) -> None:
    pytest.importorskip("matplotlib", reason="matplotlib is not installed (extra 'figures')")
    result.save(tmp_path / "out")
    (tmp_path / "far" / "off").mkdir(parents=True)
    shutil.copy(tmp_path / "out" / "site-result.json", tmp_path / "far" / "off")
    loaded = [rp.load_site_result(tmp_path / name) for name in ("out", "far/off")]
    for each in (result, *loaded):
        above, beside = each.plot().axes
        assert {text.get_text() for text in above.texts} == set(NAMES)
        for k, name in enumerate(NAMES):
            points = np.asarray(above.collections[k].get_offsets())
            assert above.collections[k].get_label() == name
            assert (len(points) > 0) is (each is not loaded[1])
        assert len(beside.collections) == len(NAMES)
    picture = getattr(result.plot(), "_repr_png_")()  # noqa: B009
    assert picture.startswith(b"\x89PNG")


def test_a_refusal_has_no_transform(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    answering(monkeypatch, "refused")
    result = rp.calibrate_site(write_site(tmp_path))
    assert result.status == "refused"
    with pytest.raises(Refusal, match="leaves two ways"):
        result.T("mast-a", "gate")
    with pytest.raises(Refusal, match="leaves two ways"):
        result.plot()
    result.save(tmp_path / "out")
    with pytest.raises(Refusal, match="leaves two ways"):
        rp.load_site_result(tmp_path / "out").covariance("mast-a", "gate")


def test_the_folder_of_a_site_file_will_do(
    result: rp.SiteResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (site_file,) = tmp_path.glob("*.toml")
    site_file.rename(tmp_path / "site.toml")
    assert rp.calibrate_site(tmp_path).lidars == NAMES


def test_the_result_of_a_site_is_told_from_that_of_two(
    result: rp.SiteResult, tmp_path: Path
) -> None:
    result.save(tmp_path / "out")
    for place in (tmp_path / "out", tmp_path / "out" / "site-result.json"):
        with pytest.raises(ReadError, match="the result of a site, not of two LiDARs"):
            rp.load_result(place)


def test_one_recording_for_two_is_refused(tmp_path: Path) -> None:
    path = write_site(tmp_path)
    (tmp_path / "mast-b" / "2.pcd").write_bytes((tmp_path / "mast-a" / "1.pcd").read_bytes())
    result = rp.calibrate_site(path)
    assert [reason.code for reason in result.reasons] == ["same_recording"]
    assert result.save(tmp_path / "out")[0].exists()


def test_a_site_from_python_is_taken_as_it_is(
    result: rp.SiteResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert result.calibration is not None
    site = result.calibration.site
    again = rp.calibrate_site(site)
    assert again.calibration is not None
    assert again.calibration.site is site
    assert len(again.document.inputs) == 5
    with pytest.raises(UsageError, match="of different names"):
        rp.calibrate_site(replace(site, lidars=site.lidars[:1]))
    with pytest.raises(UsageError, match="reference is 3, expected 0 to 2"):
        rp.calibrate_site(replace(site, reference=3))
    short = replace(site.lidars[0], clouds=(recorded(0),))
    with pytest.raises(UsageError, match="mast-a has 1 clouds, expected 2"):
        rp.calibrate_site(replace(site, lidars=(short, *site.lidars[1:])))
