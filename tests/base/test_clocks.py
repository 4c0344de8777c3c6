"""What is said of clocks that differ: known differences by name, others by size alone."""

import re

import pytest

from retropole.base.clocks import NOTICED, words_of


@pytest.mark.parametrize(
    ("apart", "words"),
    [
        (37.02, r"is 37.0 s ahead of the recorder's, as TAI \(PTP\) is ahead of UTC \(NTP\)"),
        (-36.9, r"is 36.9 s behind the recorder's, as UTC \(NTP\) is behind TAI \(PTP\)"),
        (17.8, r"as GPS time is ahead of UTC"),
        (-19.1, r"as GPS time is behind TAI"),
        (3600.2, "is 60 min ahead of the recorder's, as one time zone is from another"),
        (-19800.0, "is 5.5 h behind .*as one time zone"),
        (0.3, f"agrees with the recorder's within {NOTICED:g} s"),
        (1.4, "is 1.4 s ahead of the recorder's, which is not a known difference"),
        (36.0, "not a known difference"),
        (3637.0, "is 3637.0 s ahead of .*not a known difference"),
        (-2.1e8, "is 2400 d behind the recorder's: it was never set, or .* recorded again later"),
        (-1.7e9, "runs from its start, its times are not dates"),
    ],
)
def test_a_known_difference_is_named_and_no_other(apart: float, words: str) -> None:
    assert re.search(words, words_of(apart))


def test_what_the_other_clock_is_of_is_reported() -> None:
    assert words_of(37.0, "that of front").startswith("is 37.0 s ahead of that of front, as TAI")
