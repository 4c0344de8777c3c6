"""Messages: one line, no longer than can be read, and nothing in them steers a terminal."""

from __future__ import annotations

import ast
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import retropole
from retropole.base.errors import (
    LONGEST_MESSAGE,
    ReadError,
    Refusal,
    UsageError,
    printable,
    said,
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


OURS = {"LineError", "MissingExtraError", "ReadError", "Refusal", "RetropoleError", "UsageError"}
"""Errors that always have a message."""

PACKAGE = Path(retropole.__file__).parent


def handlers(tree: ast.AST) -> Iterator[ast.ExceptHandler]:
    """Give what catches errors of others under a name."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ExceptHandler) and node.name and node.type is not None:
            kinds = node.type.elts if isinstance(node.type, ast.Tuple) else [node.type]
            if not {ast.unparse(kind).rpartition(".")[2] for kind in kinds} <= OURS:
                yield node


def quotes_bare(text: ast.FormattedValue, name: str) -> bool:
    """Tell whether a part of a text is the error as it is, which may have no words."""
    value = text.value
    if isinstance(value, ast.BoolOp):
        # An error is true, whatever its words.
        value = value.values[0]
        return isinstance(value, ast.Name) and value.id == name
    return ast.unparse(value) == name or f"str({name})" in ast.unparse(value)


@pytest.mark.full
def test_no_reason_is_empty() -> None:
    """MemoryError and many errors of libraries have no words: ``said`` gives their kind then."""
    bare = [
        f"{path}:{node.lineno}"
        for path in sorted(PACKAGE.rglob("*.py"))
        for handler in handlers(ast.parse(path.read_text(encoding="utf-8")))
        for node in ast.walk(handler)
        if isinstance(node, ast.FormattedValue) and quotes_bare(node, handler.name or "")
    ]
    assert bare == []


def test_an_error_without_words_is_named() -> None:
    assert said(MemoryError()) == "MemoryError"
    assert said(ValueError(" \n")) == "ValueError"
    assert said(ValueError("too deep")) == "too deep"
