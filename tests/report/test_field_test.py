"""The field test in words: one screen, and a section of a page."""

import re
from itertools import combinations

import pytest

from retropole.base.errors import Reason
from retropole.checking.certification import ALPHA, DistanceTest, FieldTest, PolesSeen
from retropole.checking.distances import Spread, SpreadTest
from retropole.report.field_test import describe_field_test, field_test_section, render_field_test
from retropole.report.text import LINES, WIDTH
from retropole.result.certification import FieldTestDoc, field_test_document


def made_up(poles: int = 4, *, off: float = 0.004, placements: int = 1) -> FieldTest:
    pairs = [(k, pair) for k in range(placements) for pair in combinations(range(poles), 2)]
    scatter, limit = (0.005, 0.006, 0.003, 0.004), 0.021
    distances = tuple(
        DistanceTest(k, pair, 2.5, 2.5 - d, *scatter, d, 0.004, limit, passed=d <= limit)
        for n, (k, pair) in enumerate(pairs)
        for d in [off if n == 0 else 0.001]
    )
    target, source = Spread(5, 0.002, 1.1, 12.0), Spread(5, 0.003, 0.9, 11.0)
    spread = SpreadTest(target, source, 1.22, 0.3, 3.4, 0.74, passed=True)
    passed = all(each.passed for each in distances)
    counts = (PolesSeen(poles, poles + 1, poles),) * placements
    return FieldTest("pass" if passed else "fail", (), distances, ALPHA, 2.63, spread, counts)


def document(*tests: FieldTest) -> FieldTestDoc:
    names = {(f"lidar {k}", "rear <b>"): test for k, test in enumerate(tests)}
    lidars = sorted({name for pair in names for name in pair})
    return field_test_document(names, lidars=lidars, radius=0.02, inputs=[])


REFUSED = FieldTest(
    "refused",
    (Reason("too_few_distances", "1 distance", {"distances": 1}),),
    (),
    ALPHA,
    None,
    None,
    (PolesSeen(2, 2, 2),),
)


@pytest.mark.parametrize(
    "tests",
    [
        (made_up(),),
        (made_up(12, off=0.05, placements=3),),
        (REFUSED,),
        (made_up(), REFUSED, made_up(off=0.05)) * 10,
    ],
)
def test_it_fits_a_screen(tests: tuple[FieldTest, ...]) -> None:
    lines = describe_field_test(document(*tests)).splitlines()
    assert len(lines) <= LINES
    assert max(map(len, lines)) <= WIDTH


def test_what_is_beyond_its_limit_is_shown_whatever_else_is_not() -> None:
    text = describe_field_test(document(made_up(12, off=0.05)))
    assert text.startswith("verdict: fail\n")
    assert re.search(r"\+50\.0 +21\.0 +BEYOND$", text, re.M)
    assert "1 difference of 66 beyond the limit" in text
    assert "50 more distances" in text
    assert "what to do: record again" in text


def test_the_worst_pair_of_a_site_comes_first() -> None:
    text = describe_field_test(document(made_up(), REFUSED, made_up(off=0.05)))
    assert text.startswith("verdict: fail\n")
    assert text.splitlines()[1].strip() == "2 of 3 pairs tested, 1 failed"
    assert text.splitlines()[2].strip() == "in no pair that was tested: lidar 1"
    first, second, third = text.splitlines()[4:7]
    assert first.strip().startswith("lidar 2")
    assert "  pass  " in second
    assert "refused: too_few_distances" in third


def test_the_section_escapes_names() -> None:
    section = field_test_section(document(made_up(off=0.05), REFUSED))
    assert "<b>" not in section
    assert "BEYOND" in section
    assert section.count("<h3>") == 2


def test_the_page_says_the_verdict_and_asks_for_nothing() -> None:
    page = render_field_test(document(made_up(off=0.05), REFUSED))
    assert "Fail: 1 of 2 pairs tested, 1 failed" in page
    assert "rear <b>" not in page
    assert "default-src 'none'" in page
    assert "$" not in page.partition("<main")[2].partition("</main>")[0]
    assert "Refused: too few data" in render_field_test(document(REFUSED))
    alone = render_field_test(document(made_up()))
    assert "Pass: the LiDARs measure as stated" in alone
    assert "What to do" in render_field_test(document(REFUSED))


def test_the_verdict_of_all_is_the_worst() -> None:
    assert document(made_up(), REFUSED).status == "partial"
    assert document(made_up()).status == "pass"
    assert document(made_up(), made_up(off=0.05)).status == "fail"
    assert document(REFUSED).status == "refused"
