"""Errors are written with two significant digits, and values end where their errors do."""

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from retropole.base.quantities import (
    Unit,
    at_most,
    counted,
    duration,
    error,
    large,
    percent,
    round_below,
    value,
    value_and_error,
)

SCALES = {" mm": 1e-3, " m": 1.0, "°": 3.141592653589793 / 180, " ‰": 1e-3, " %": 1e-2}
sigmas = st.floats(1e-7, 1e3)
units: st.SearchStrategy[Unit] = st.sampled_from(["m", "rad", "1"])


def read(text: str) -> tuple[str, float]:
    """Take what was written apart: its digits, and the unit in SI."""
    found = re.fullmatch(r"(-?[\d.]+)( mm| m|°| ‰| %)", text)
    assert found is not None, text
    return found[1], SCALES[found[2]]


@given(sigmas, units)
def test_an_error_has_two_significant_digits(sigma: float, unit: Unit) -> None:
    digits, scale = read(error(sigma, unit))
    significant = digits.replace(".", "").lstrip("0")
    # In front of the point zeros hold the place: 123 m is written 120 m.
    assert len(significant.rstrip("0") if len(significant) > 2 else significant) <= 2
    assert len(significant) >= 2
    # Half of the last digit: at most 5 % of the value.
    assert float(digits) * scale == pytest.approx(sigma, rel=0.0501)


@given(sigmas)
def test_a_length_has_the_unit_that_fits(sigma: float) -> None:
    digits, scale = read(error(sigma))
    assert float(digits) < 100 if scale == 1e-3 else float(digits) >= 0.1


@given(st.floats(-1.0, 1.0), st.floats(1e-6, 0.5), units)
def test_a_value_ends_where_its_error_does(number: float, sigma: float, unit: Unit) -> None:
    digits, scale = read(value(number, sigma, unit))
    # Half of the last digit of an error of two digits is at most a twentieth of it.
    assert abs(float(digits) * scale - number) <= 0.0501 * sigma
    assert digits.strip("-0.") or not digits.startswith("-")
    both = value_and_error(number, sigma, unit)
    assert digits in both
    first, second = re.findall(r"-?[\d.]+", both)
    assert len(first.partition(".")[2]) == len(second.partition(".")[2])


@pytest.mark.parametrize(
    ("written", "said"),
    [
        (error(0.00842), "8.4 mm"),
        (error(0.0000004), "0.00040 mm"),
        (error(0.0996), "0.10 m"),
        (error(0.0994), "99 mm"),
        (error(0.00996), "10 mm"),
        (error(2.34), "2.3 m"),
        (error(123.4), "120 m"),
        (error(0.0), "0 mm"),
        (error(None), "–"),
        (error(float("nan")), "–"),
        (error(6e-4, "rad"), "0.034°"),
        (error(0.0005, "1"), "0.50 ‰"),
        (error(0.5, "1"), "50 %"),
        (value(-0.00412, 0.003), "-4.1 mm"),
        (value(-0.00001, 0.003), "0.0 mm"),
        (value(None, 0.003), "–"),
        (value(0.00412, 0.0), "4.1 mm"),
        (value_and_error(0.02031, 0.00042), "20.31 ± 0.42 mm"),
        (value_and_error(0.001, 0.0002, "rad"), "(0.057 ± 0.011)°"),
        (percent(0.614), "61 %"),
        (percent(0.004), "< 1 %"),
        (percent(0.0), "0 %"),
    ],
)
def test_as_a_person_writes_it(written: str, said: str) -> None:
    assert written == said


@pytest.mark.parametrize(("seconds", "words"), [
    (0.0, "0 s"), (60.0, "60 s"), (119.0, "120 s"), (120.0, "2.0 min"), (5400.0, "90 min"),
    (3 * 3600.0, "3.0 h"), (47 * 3600.0, "47 h"), (86400 * 31.0, "31 d"),
])  # fmt: skip
def test_a_duration_has_a_unit_that_fits(seconds: float, words: str) -> None:
    assert duration(seconds) == words


@given(sigmas)
def test_a_bound_is_rounded_up_by_less_than_its_last_digit(bound: float) -> None:
    digits, scale = read(at_most(bound))
    assert bound * (1 - 1e-8) <= float(digits) * scale <= 1.11 * bound


def test_bounds_in_words() -> None:
    assert at_most(0.0201) == "21 mm"
    assert at_most(0.02) == "20 mm"
    assert at_most(0.244) == "0.25 m"
    assert at_most(0.00524, "rad") == "0.31°"


@given(st.integers(0, 10**9))
def test_counts_are_good_english(number: int) -> None:
    plain, other = counted(number, "pole"), counted(number, "voxel agrees", "voxels agree")
    assert plain.endswith(" pole") is other.endswith(" voxel agrees") is (number == 1)
    assert int(plain.split()[0].replace(",", "")) == number


@pytest.mark.parametrize(
    ("number", "rounded"), [(1.0, 1.0), (1.99, 1.0), (2.0, 2.0), (4.9, 2.0), (730.0, 500.0)]
)
def test_lengths_are_rounded_down_to_one_two_or_five(number: float, rounded: float) -> None:
    assert round_below(number) == pytest.approx(rounded)
    assert round_below(number / 1000) == pytest.approx(rounded / 1000)


def test_round_numbers_have_no_exponent() -> None:
    assert [large(v) for v in (0.5, 1.0, 2000.0, 1e6)] == ["0.5", "1", "2,000", "1,000,000"]
