"""A result can be looked at, saved and loaded again."""

import json
from dataclasses import FrozenInstanceError
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

import retropole as rp
from retropole.base.uncertainty import RadiusEstimate
from retropole.base.uncertainty.confirmation import Confirmation
from retropole.io import write_pcd
from retropole.result import encode
from tests.api.clouds import calibrated, pair, refused
from tests.report.made_up import BUDGET, RANDOM, made_up


class Cells(HTMLParser):
    """The words of a page, and its tags."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.words: list[str] = []
        self.tags: set[str] = set()
        self.feed(page)

    def handle_data(self, data: str) -> None:
        self.words.append(data)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two files, and the result of calibrating them."""
    folder = tmp_path_factory.mktemp("recordings")
    write_pcd(folder / "target.pcd", pair().target)
    write_pcd(folder / "source.pcd", pair().source)
    result = rp.calibrate(
        folder / "target.pcd", folder / "source.pcd", options=rp.RunConfig(refine=False)
    )
    result.save(folder / "r")
    return folder


def test_what_it_says_is_what_the_document_holds() -> None:
    result = calibrated()
    T, covariance = result.T_target_source, result.covariance
    assert T is not None
    assert covariance is not None
    np.testing.assert_array_equal(T, np.array(result.document.T_target_source))
    np.testing.assert_array_equal(covariance, np.array(result.document.covariance))
    assert (T.shape, covariance.shape) == ((4, 4), (6, 6))
    assert [each.range_m for each in result.predicted_error] == [1, 10, 30, 60]
    assert result.status == result.document.status
    assert list(result.reasons) == result.document.reasons


def test_it_cannot_be_changed() -> None:
    result = calibrated()
    T = result.T_target_source
    assert T is not None
    T[:] = 0
    assert result.T_target_source is not None
    assert result.T_target_source.any()
    with pytest.raises(FrozenInstanceError):
        result.path = Path()  # type: ignore[misc]


def test_a_refusal_has_a_reason_and_nothing_else() -> None:
    result = refused()
    assert result.status == "refused"
    assert result.T_target_source is None
    assert result.covariance is None
    assert result.predicted_error == ()
    assert [reason.code for reason in result.reasons] == ["too_few_poles"]
    with pytest.raises(rp.Refusal) as caught:
        result.plot()
    assert caught.value.code == "too_few_poles"


def test_repr_is_a_few_lines() -> None:
    lines = repr(calibrated()).splitlines()
    assert lines[0] == f"CalibrationResult: {calibrated().status}"
    document = calibrated().document
    said = [document.budget, document.radius, document.confirmation]
    assert len(lines) == 4 + sum(each is not None for each in said) + len(calibrated().reasons)
    assert "at 10 m" in lines[3]
    T = calibrated().T_target_source
    assert T is not None
    assert f"x {T[0, 3]:.4f}" in lines[1]
    lines = repr(refused()).splitlines()
    assert len(lines) == 2
    assert refused().reasons[0].message in lines[1]


def test_certainty_is_given_back_in_its_two_kinds() -> None:
    made = rp.CalibrationResult(made_up(count=100).result)
    assert made.uncertainty is not None
    assert made.covariance is not None
    np.testing.assert_array_equal(made.uncertainty.random, RANDOM)
    np.testing.assert_allclose(made.uncertainty.covariance, made.covariance, rtol=1e-12)
    assert made.uncertainty.budget == BUDGET
    assert made.radius == RadiusEstimate(0.02, 0.0005, 0.02031, 0.00042)
    assert made.confirmation == Confirmation(agreeing=412, contradicting=3)
    for line in (
        "predicted error  ± 5.6 mm at 1 m, ± 6.2 mm at 10 m, ± 9.5 mm at 30 m, ± 16 mm at 60 m",
        "main error       range offset of the source LiDAR (58 %)",
        "radius           20.00 mm given, 20.31 ± 0.42 mm estimated",
        "scene            412 patches agree, 3 contradict (0.7 % against it)",
    ):
        assert line in repr(made)
    older = replace(made.document, uncertainty=None, budget=None, radius=None, confirmation=None)
    assert rp.CalibrationResult(older).uncertainty is None
    assert rp.CalibrationResult(older).radius is None
    assert rp.CalibrationResult(older).confirmation is None
    assert len(repr(rp.CalibrationResult(older)).splitlines()) == 4


def test_html_says_the_same_and_is_escaped() -> None:
    page = Cells(calibrated()._repr_html_())
    for line in repr(calibrated()).splitlines()[1:]:
        assert any(word and word in line for word in page.words)
    assert page.tags == {"table", "tr", "th", "td"}
    page = Cells(rp.calibrate(np.ones((9, 4)), np.ones((9, 4)))._repr_html_())
    assert page.tags == {"table", "tr", "th", "td"}
    assert any("<array>" in word for word in page.words)


@pytest.mark.parametrize("result", [calibrated, refused])
def test_what_is_saved_is_loaded_again(tmp_path: Path, result: object) -> None:
    assert callable(result)
    saved = result()
    files = saved.save(tmp_path / "deep" / "r")
    assert [path.name for path in files] == ["result.json", "report.html"]
    assert sorted(path.name for path in files[0].parent.iterdir()) == ["report.html", "result.json"]
    for place in (files[0], files[0].parent, str(files[0])):
        loaded = rp.load_result(place)
        assert loaded.document == saved.document
        assert (loaded.placements, loaded.path) == (None, files[0])
        assert repr(loaded) == repr(saved)


@pytest.mark.full
def test_a_report_is_the_one_that_was_saved(recordings: Path, tmp_path: Path) -> None:
    loaded = rp.load_result(recordings / "r")
    page = (recordings / "r" / "report.html").read_text()
    assert loaded.report(tmp_path / "again.html").read_text() == page
    assert loaded.report(str(tmp_path / "again.html")) == tmp_path / "again.html"
    saved = loaded.save(tmp_path / "copy", relative=False)
    assert saved[0].read_bytes() == (recordings / "r" / "result.json").read_bytes()
    assert saved[1].read_text() == page
    result = calibrated()
    assert result.report(tmp_path / "own.html").stat().st_size > 100_000


def test_a_report_of_what_never_was_a_file_reports_it(tmp_path: Path) -> None:
    calibrated().save(tmp_path / "r")
    with pytest.raises(rp.ReadError, match="array"):
        rp.load_result(tmp_path / "r").report(tmp_path / "page.html")
    assert not (tmp_path / "page.html").exists()


@pytest.mark.full
def test_a_report_takes_files_that_lie_elsewhere(recordings: Path, tmp_path: Path) -> None:
    loaded = rp.load_result(recordings / "r")
    files = [recordings / "target.pcd", recordings / "source.pcd"]
    page = loaded.report(tmp_path / "page.html", clouds=files).read_text()
    assert page == (recordings / "r" / "report.html").read_text()
    page = loaded.report(tmp_path / "page.html", clouds=files[::-1]).read_text()
    assert page.count("is not the file that the run read") == 2
    with pytest.raises(rp.UsageError, match="1 clouds are given"):
        loaded.report(tmp_path / "page.html", clouds=files[:1])


@pytest.mark.full
def test_plot_draws_both_clouds_and_every_pole(recordings: Path) -> None:
    pytest.importorskip("matplotlib", reason="matplotlib is not installed (extra 'figures')")
    for result in (calibrated(), rp.load_result(recordings / "r")):
        figure = result.plot()
        chosen = result.document.chosen
        assert chosen is not None
        assert len(figure.axes) == 4 + len(chosen.pairs)


@pytest.mark.full
def test_a_notebook_shows_the_plot() -> None:
    pytest.importorskip("matplotlib", reason="matplotlib is not installed (extra 'figures')")
    picture = getattr(calibrated().plot(), "_repr_png_")()  # noqa: B009
    assert picture.startswith(b"\x89PNG\r\n\x1a\n")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "no result document"),
        (b"{}", "no result document"),
        (b"[1, 2]", "no result document"),
        (b'{"schema": "retropole/result/2"}', "is from a newer version of retropole; update"),
        (b"\xff\xfe", "no result document"),
    ],
)
def test_what_is_no_result_is_named(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "result.json").write_bytes(content)
    for place in (tmp_path, tmp_path / "result.json"):
        with pytest.raises(rp.ReadError, match=rf"result\.json.*{message}"):
            rp.load_result(place)


def test_a_missing_result_is_named(tmp_path: Path) -> None:
    for place in (tmp_path, tmp_path / "absent" / "result.json"):
        with pytest.raises(rp.ReadError, match=r"result\.json.*cannot be read"):
            rp.load_result(place)


def test_results_of_older_runs_with_fewer_options_are_loaded(tmp_path: Path) -> None:
    document = json.loads(encode(calibrated().document))
    # The seed is an option no more.
    document["config"] = {"radius_m": 0.03, "seed": 5}
    (tmp_path / "result.json").write_text(json.dumps(document))
    config = rp.load_result(tmp_path).document.config
    assert (config.radius_m, config.sensor_target, config.frames) == (0.03, "auto", None)
