"""One table of reasons: every code is explained, and every explanation says something."""

from typing import get_args

import pytest

from retropole.base.reasons import Code, explain, page, plain, prefixed, reasons, tables, unlinked
from tests.paths import PACKAGE


def test_every_code_has_one_explanation() -> None:
    assert sorted(get_args(Code)) == sorted(
        code for group in tables().groups.values() for code in group.reasons
    )


def test_every_code_is_used_by_the_program() -> None:
    text = "".join(
        path.read_text(encoding="utf-8")
        for path in PACKAGE.rglob("*.py")
        if path.name != "reasons.py"
    )
    assert not [code for code in reasons() if f'"{code}"' not in text]


@pytest.mark.parametrize("code", reasons())
def test_explanations_are_sentences_in_plain_words(code: str) -> None:
    text = reasons()[code]
    assert text.title[0].isupper()
    assert not text.title.endswith(".")
    for words in (text.help, *text.advice):
        assert words.endswith(".")
        assert not set("`[]*") & set(plain(words))


def test_prefixed_codes_are_explained_by_their_prefix() -> None:
    assert explain(prefixed("stored", "few_points")) == tables().prefixes["stored"]
    assert explain(prefixed("poles", "no_match")) == tables().prefixes["poles"]
    assert explain("poles_not_trusted") == reasons()["poles_not_trusted"]
    assert explain("nonsense") is None


def test_links_become_their_words() -> None:
    assert unlinked("See [the report](report.md) and [why](a.md#b).") == "See the report and why."


def test_a_code_has_a_place_in_the_documentation() -> None:
    assert page("few_points") == "docs/reasons.md#few_points"
    assert page(prefixed("stored", "few_points")) == "docs/reasons.md#stored_"
    assert page("nonsense") is None
