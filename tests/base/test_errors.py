"""Messages: one line, no longer than can be read, and nothing in them steers a terminal."""

from __future__ import annotations

import os

import pytest
from hypothesis import given
from hypothesis import strategies as st

from retropole.base.errors import (
    LONGEST_MESSAGE,
    ReadError,
    Refusal,
    UsageError,
    printable,
    shortened,
)


@given(st.text(st.characters(blacklist_categories=())))
def test_what_is_printed_is_printable_and_plain_text_stays(text: str) -> None:
    assert printable(text).isprintable()
    assert printable(printable(text)) == printable(text)
    if text.isprintable():
        assert printable(text) == text


def test_bytes_of_a_name_are_written_as_such() -> None:
    assert printable(os.fsdecode(b"caf\xe9\n")) in ("caf\\xe9\\n", "café\\n")
    assert printable("a\x1b[2J\u202eb\u2028") == "a\\x1b[2J\\u202eb\\u2028"
    assert printable("1 σ ± 3 µm – 漢字") == "1 σ ± 3 µm – 漢字"


@given(st.text("aσ", max_size=500), st.integers(10, 400))
def test_a_long_text_keeps_its_ends(text: str, most: int) -> None:
    short = shortened(text, most)
    assert len(short) == min(len(text), most)
    assert (short[: most // 2 - 1], short[-3:]) == (text[: most // 2 - 1], text[-3:])


@pytest.mark.parametrize("kind", [ReadError, UsageError])
def test_an_error_is_one_short_line(kind: type[Exception]) -> None:
    said = str(kind("a.pcd: field " + "\x1b[31m\n" * 1000 + " is missing"))
    assert said.isprintable()
    assert len(said) == LONGEST_MESSAGE
    assert said.startswith("a.pcd: field")
    assert said.endswith("is missing")


def test_a_refusal_is_our_own_words_in_full() -> None:
    refusal = Refusal("no_intensity", "x\n" * 400, {"points": 3})
    assert str(refusal) == refusal.message == "x\\n" * 400
