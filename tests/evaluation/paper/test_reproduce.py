"""The paper as files: every exhibit with its pictures, and an index of all."""

from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from click.testing import CliRunner

from retropole.cli import cli
from retropole.evaluation.paper import write_exhibit
from retropole.evaluation.paper.exhibit import Exhibit
from tests.evaluation.paper.exhibits import all_exhibits

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def test_an_exhibit_is_written_as_markdown_csv_and_pictures(tmp_path: Path) -> None:
    def draw(figure: "Figure") -> None:
        figure.subplots().plot([0, 1], [0, 1])

    exhibit = Exhibit("t", "A title", ("a",), ((1,),), "Note.", draw)
    written = write_exhibit(exhibit, tmp_path)
    assert [path.name for path in written] == ["t.md", "t.csv", "t.png", "t.svg"]
    assert (tmp_path / "t.csv").read_text() == exhibit.csv()
    assert (tmp_path / "t.md").read_text() == exhibit.markdown()
    assert (tmp_path / "t.png").read_bytes().startswith(b"\x89PNG")
    assert "<svg" in (tmp_path / "t.svg").read_text()


@pytest.mark.slow
def test_the_command_writes_an_index_of_everything(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    exhibits = list(all_exhibits().values())
    monkeypatch.setattr("retropole.evaluation.paper.reproduce", lambda *given: exhibits)
    done = CliRunner().invoke(cli, ["paper", "--seeds", "1", "--out", str(tmp_path)])
    assert done.exit_code == 0, done.output
    index = (tmp_path / "index.md").read_text()
    for words in ("Table I:", "Table II:", "Fig. 4", "Table III:", "Table IV:", "Simulated e_rt"):
        assert words in index
    for name in index.split("](")[1:]:
        assert (tmp_path / name.split(")")[0]).is_file()
