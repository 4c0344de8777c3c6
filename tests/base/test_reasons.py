"""One table of reasons: every code is explained, and every explanation says something."""

from typing import get_args

import pytest

from retropole.base.reasons import (
    GROUPS,
    PREFIXED,
    REASONS,
    check,
    cluster,
    explain,
    field_test,
    other_methods,
    page,
    plain,
    prefixed,
    refused,
    unlinked,
    warning,
)
from tests.paths import PACKAGE

TABLES = (
    (refused.RefusedCode, refused.REFUSED),
    (warning.WarningCode, warning.WARNINGS),
    (check.CheckCode, check.CHECK),
    (field_test.FieldTestCode, field_test.FIELD_TEST),
    (other_methods.OtherMethodCode, other_methods.OTHER_METHODS),
    (cluster.ClusterCode, cluster.CLUSTER),
)


@pytest.mark.parametrize(("codes", "table"), TABLES)
def test_every_code_has_one_explanation(codes: object, table: dict[str, object]) -> None:
    assert set(get_args(codes)) == set(table)


def test_no_code_stands_in_two_tables() -> None:
    assert len(REASONS) == sum(len(group.reasons) for group in GROUPS)


def test_every_code_is_used_by_the_program() -> None:
    text = "".join(
        path.read_text(encoding="utf-8")
        for path in PACKAGE.rglob("*.py")
        if path.parent.name != "reasons"
    )
    assert not [code for code in REASONS if f'"{code}"' not in text]


@pytest.mark.parametrize("code", REASONS)
def test_explanations_are_sentences_in_plain_words(code: str) -> None:
    text = REASONS[code]
    assert text.title[0].isupper()
    assert not text.title.endswith(".")
    for words in (text.help, *text.advice):
        assert words.endswith(".")
        assert not set("`[]*") & set(plain(words))


def test_prefixed_codes_are_explained_by_their_prefix() -> None:
    assert explain(prefixed("stored", "few_points")) == PREFIXED["stored"]
    assert explain(prefixed("poles", "no_match")) == PREFIXED["poles"]
    assert explain("poles_not_trusted") == REASONS["poles_not_trusted"]
    assert explain("nonsense") is None


def test_links_become_their_words() -> None:
    assert unlinked("See [the report](report.md) and [why](a.md#b).") == "See the report and why."


def test_a_code_has_a_place_in_the_documentation() -> None:
    assert page("few_points") == "reasons.html#few-points"
    assert page(prefixed("stored", "few_points")) == "reasons.html#stored"
    assert page("nonsense") is None
