"""The paper's experiments: its own figures where it gives any, laws where it gives none."""

import csv
import io
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from retropole.cli import cli
from retropole.evaluation.paper import reproduce, write_exhibit
from retropole.evaluation.paper.choosing import RULES, judge_corridor
from retropole.evaluation.paper.estimator import PAPER_E_RT, simulated_error
from retropole.evaluation.paper.exhibit import Exhibit
from retropole.evaluation.paper.line_bias import (
    error_of_fit,
    expected_line_error,
    line_error,
    points_on_pole,
)
from retropole.evaluation.paper.thresholds import thresholds
from tests.paths import SHARED


def test_line_error_is_the_mean_square_distance() -> None:
    rng = np.random.default_rng(0)
    for _ in range(10):
        centre, direction = rng.normal(size=3), rng.normal(size=3)
        direction[2] += 3.0
        low, high = sorted(rng.normal(size=2))
        z = np.linspace(low, high, 200_001)
        at = centre[:2] + np.outer(z - centre[2], direction[:2] / direction[2])
        mean = np.trapezoid(np.sum(at**2, axis=1), z) / (high - low)
        assert line_error(centre, direction, (low, high)) == pytest.approx(mean, rel=1e-8)
        assert line_error(centre, -5 * direction, (low, high)) == pytest.approx(mean, rel=1e-8)


def test_points_lie_on_the_facing_side_of_the_pole() -> None:
    for turn in ("q1", "q2"):
        xyz = points_on_pole(6.0, 0.2, turn, 0.3)
        assert np.hypot(xyz[:, 0], xyz[:, 1]) == pytest.approx(0.2)
        assert np.all(xyz[:, 0] > 0.2**2 / 6.0 - 1e-9)


def test_error_tends_to_the_law_where_many_beams_hit() -> None:
    for turn in ("q1", "q2"):
        near = np.mean([error_of_fit(points_on_pole(1.5, 0.3, turn, k / 10)) for k in range(10)])
        far = np.mean([error_of_fit(points_on_pole(3.0, 0.3, turn, k / 10)) for k in range(10)])
        assert far == pytest.approx(expected_line_error(0.3), rel=0.1)
        assert near > far  # a near pole shows less than half of itself, which lies further in front


@pytest.fixture(scope="module")
def exhibits() -> dict[str, Exhibit]:
    data = SHARED if SHARED.is_dir() else None
    return {exhibit.name: exhibit for exhibit in reproduce(1, data)}


def test_table_two_is_that_of_the_paper(exhibits: dict[str, Exhibit]) -> None:
    rows = exhibits["table2_two_matlab"].rows
    assert len(rows) == 18
    for distance, _, _, _, paper, ours, _, least, most, _ in rows:
        tolerance = 0.30 if distance == 10 else 0.12
        assert ours == pytest.approx(paper, rel=tolerance)
        assert least <= ours <= most


def test_the_beam_model_vanishes_without_noise_and_the_papers_does_not(
    exhibits: dict[str, Exhibit],
) -> None:
    rows = {row[:2]: row for row in exhibits["simulated_e_rt"].rows}
    assert rows["beam model", "none"][3] < 1e-3 < 1e-2 < rows["the paper's estimator", "none"][3]


@pytest.mark.slow
def test_simulated_error_brackets_the_papers() -> None:
    rows = {row[:2]: row for row in simulated_error(200).rows}
    _, _, paper, median, mean, *_ = rows["the paper's estimator", "isotropic"]
    assert paper == PAPER_E_RT
    assert median < PAPER_E_RT < mean


def test_the_four_hypotheses_are_half_turns_of_each_other(exhibits: dict[str, Exhibit]) -> None:
    rows = exhibits["fig4_hypotheses"].rows
    assert [row[3] for row in rows] == pytest.approx([0, 180, 180, 180], abs=1.0)
    assert [row[2] for row in rows] == pytest.approx([rows[0][2]] * 4, rel=1e-3)


def test_the_right_hypothesis_comes_first_and_there_is_one() -> None:
    assert judge_corridor(1).right == [True, False, False, False]


def test_choosing_counts_every_rule(exhibits: dict[str, Exhibit]) -> None:
    assert [row[0] for row in exhibits["table3_four_result"].rows] == ["a", "b", "c", "d"]
    counts = exhibits["table3_how_often"].rows
    assert [row[0] for row in counts] == list(RULES)
    assert all(0 <= right <= of == 1 for _, right, of in counts)


def test_comparing_orders_as_the_paper_does(exhibits: dict[str, Exhibit]) -> None:
    sums = {row[0]: row[2] for row in exhibits["table4_comparing"].rows}
    assert min(sums["planes"], sums["poles"]) > max(sums["ICP"], sums["wrong hypothesis"])
    assert sums["planes"] == pytest.approx(sums["poles"], rel=0.05)


@pytest.mark.skipif(not SHARED.is_dir(), reason="the real recordings of ../shared/data are absent")
def test_the_reference_of_a_real_recording_is_crisper(exhibits: dict[str, Exhibit]) -> None:
    rows = exhibits["table4_recorded"].rows
    sums = {row[1]: row[2] for row in rows if row[0] == "pandaset"}
    assert sums["reference"] > sums["wrong hypothesis"]


def test_thresholds_of_the_paper_are_ours_but_for_named_exceptions() -> None:
    differing = {row[1] for row in thresholds().rows if row[2] not in (None, row[3])}
    assert differing == {"VLS-128"}


def test_an_exhibit_is_written_as_markdown_csv_and_pictures(tmp_path: Path) -> None:
    def draw(figure: object) -> None:
        figure.subplots().plot([0, 1], [0, 1])  # type: ignore[attr-defined]

    exhibit = Exhibit("t", "A title", ("a", "b"), ((1, 0.123456789), ("x, y", None)), "Note.", draw)
    written = write_exhibit(exhibit, tmp_path)
    assert [path.name for path in written] == ["t.md", "t.csv", "t.png", "t.svg"]
    rows = list(csv.reader(io.StringIO((tmp_path / "t.csv").read_text())))
    assert rows == [["a", "b"], ["1", "0.123456789"], ["x, y", ""]]
    assert "| 1 | 0.1235 |" in (tmp_path / "t.md").read_text()
    assert (tmp_path / "t.png").read_bytes().startswith(b"\x89PNG")
    assert "<svg" in (tmp_path / "t.svg").read_text()


def test_the_command_writes_an_index_of_everything(
    tmp_path: Path, exhibits: dict[str, Exhibit], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "retropole.evaluation.paper.reproduce", lambda *given: list(exhibits.values())
    )
    done = CliRunner().invoke(cli, ["paper", "--seeds", "1", "--out", str(tmp_path)])
    assert done.exit_code == 0, done.output
    index = (tmp_path / "index.md").read_text()
    for words in ("Table I:", "Table II:", "Fig. 4", "Table III:", "Table IV:", "Simulated e_rt"):
        assert words in index
    for name in index.split("](")[1:]:
        assert (tmp_path / name.split(")")[0]).is_file()
