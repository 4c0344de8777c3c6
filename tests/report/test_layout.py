"""Text on a screen."""

import re

from retropole.report.layout import table, wrapped


def test_tables_line_up() -> None:
    lines = table(("name", "x"), [["a", "1.0"], ["longer", "-22.5"]]).splitlines()
    assert len({len(line) for line in lines}) == 1


def test_a_value_stays_with_its_unit() -> None:
    for width in range(60, 80):
        for line in wrapped("x" * width + " ± 40 mm at 60 m, 3 σ, 28.2 % of 12 s", "  "):
            assert not re.match(r" *(mm|m|σ|%|s|40)\b", line)
            assert not line.endswith("±")
