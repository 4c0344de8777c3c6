"""The verdict of a site in words: what there is, how good it is, what was checked."""

from __future__ import annotations

import msgspec
import pytest

from retropole.base.bounded import Status
from retropole.report.site.verdict import probability, verdict
from retropole.result.site import SiteDoc
from tests.report.made_up import HOSTILE, Page
from tests.report.site.made_up import document_of, made_up_site


def document(status: Status = "ok") -> SiteDoc:
    return document_of(made_up_site(status, lidars=5, placements=2, count=10))


def test_an_answer_says_how_good_it_is_and_what_checked_it() -> None:
    text = Page(verdict(document())).text
    assert "Calibrated: 5 LiDARs in one frame" in text
    assert "Datum: LiDAR mast-a stands still." in text
    assert "that is the worst, of crane-high" in text
    assert "none above 3.29" in text
    assert "3 loops of pairs closed" in text
    assert "not all poses. crane-high: not shown" in text


def test_a_warning_names_what_stands_out_first() -> None:
    text = Page(verdict(document("warn"))).text
    assert "1 test above 3.29, the largest |w| is 6.3 (pole 2 of morning as mast-b sees it)" in text
    assert "Settle the warning first" in text


def test_a_refusal_names_the_groups_and_no_figures() -> None:
    text = Page(verdict(document("refused"))).text
    assert "Refused: no poses" in text
    assert "mast-a, mast-b, gate, crane-low | crane-high" in text
    assert "What to do next" not in text
    assert "1 σ" not in text


def test_a_site_without_tests_says_that_nothing_checks_it() -> None:
    bare = msgspec.structs.replace(document(), tests=[], loops=[])
    assert "Nothing checks these poses" in verdict(bare)


def test_all_poses_good_enough_is_said_once() -> None:
    good = document().lidars[1].fitness
    lidars = [msgspec.structs.replace(each, fitness=good) for each in document().lidars]
    text = verdict(msgspec.structs.replace(document(), lidars=lidars))
    assert "Within 2 cm at 30 m: yes, all poses." in text


@pytest.mark.parametrize(
    ("p", "words"),
    [(None, "–"), (1e-9, "< 0.1 %"), (0.012, "1.2 %"), (0.6, "60 %"), (1.0, "100 %")],
)
def test_probabilities_are_written_as_they_matter(p: float | None, words: str) -> None:
    assert probability(p) == words


def test_what_others_wrote_stays_text() -> None:
    hostile = msgspec.structs.replace(document("warn"), datum=HOSTILE)
    page = Page(verdict(hostile, [HOSTILE]))
    assert page.open == []
    assert page.text.count(HOSTILE) == 2
