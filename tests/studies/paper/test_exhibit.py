"""An exhibit as Markdown and CSV: nothing is lost but digits."""

import csv
import io

import pytest

from studies.paper.exhibit import Exhibit

pytestmark = pytest.mark.full

EXHIBIT = Exhibit("t", "A title", ("a", "b"), ((1, 0.123456789), ("x, y", None)), "Note.")


def test_csv_holds_every_cell_in_full() -> None:
    rows = list(csv.reader(io.StringIO(EXHIBIT.csv())))
    assert rows == [["a", "b"], ["1", "0.123456789"], ["x, y", ""]]


def test_markdown_holds_title_table_and_note() -> None:
    text = EXHIBIT.markdown()
    assert text.startswith("# A title\n")
    assert "| 1 | 0.1235 |" in text
    assert text.endswith("Note.\n")
