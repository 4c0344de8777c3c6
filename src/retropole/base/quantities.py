"""Errors and what they belong to, in words: two significant digits, and a unit that fits.

More digits of an uncertainty mean nothing, and fewer lose too much (GUM, JCGM 100:2008, 7.2.6). A
value next to its uncertainty ends at the same digit.
"""

from __future__ import annotations

import math
from typing import Literal

Unit = Literal["m", "rad", "1"]

UNKNOWN = "–"
"""Replaces a missing number."""

MILLIMETRES_BELOW = 0.0995
"""Lengths below this, metres, are written in mm: what rounds to 0.10 m is written in m."""


def error(sigma: float | None, unit: Unit = "m") -> str:
    """Write an uncertainty with two significant digits: ``8.4 mm``, ``0.12 m``, ``0.035°``.

    Parameters
    ----------
    sigma
        In SI units; None, or what is not finite, is a dash.
    unit
        ``m`` is written in mm or m, ``rad`` in degrees, and ``1`` in per mille.
    """
    if sigma is None or not math.isfinite(sigma):
        return UNKNOWN
    scale, symbol = _scale(abs(sigma), unit)
    return _fixed(sigma * scale, _decimals(sigma * scale)) + symbol


def at_most(bound: float, unit: Unit = "m") -> str:
    """Write a bound as `error` does, rounded up: 20.1 mm are not within ``20 mm``.

    Parameters
    ----------
    bound
        In SI units, above 0.
    unit
        As in `error`.
    """
    scale, _ = _scale(bound, unit)
    digit = 10.0 ** -_decimals(bound * scale)
    # What is as good as a whole digit stays one.
    return error(math.ceil(bound * scale / digit - 1e-9) * digit / scale, unit)


def value(number: float | None, sigma: float, unit: Unit = "m") -> str:
    """Write a value to the digit at which its uncertainty ends: ``20.31 mm`` next to 0.42 mm.

    Parameters
    ----------
    number
        In SI units; None, or what is not finite, is a dash.
    sigma
        Its uncertainty, same unit; at 0 the value itself has two significant digits.
    unit
        As in `error`.
    """
    return _formatted(number, sigma, unit, "")


def value_and_error(number: float | None, sigma: float, unit: Unit = "m") -> str:
    """Write a value with its uncertainty, both to the same digit: ``20.31 ± 0.42 mm``."""
    return _formatted(number, sigma, unit, " ± ")


def percent(share: float) -> str:
    """Write a share, 0 to 1, in whole per cent: ``61 %``, ``< 1 %``."""
    return "< 1 %" if 0 < share < 0.005 else f"{100 * share:.0f} %"


def counted(number: int, noun: str, plural: str = "") -> str:
    """Write how many there are of something: ``1 pole``, ``2 poles``, ``96,404 points``.

    Parameters
    ----------
    number
        How many.
    noun
        What there is, in the singular.
    plural
        If it is not the singular with an s.
    """
    return f"{number:,} {noun if number == 1 else plural or noun + 's'}"


def round_below(number: float) -> float:
    """Round down to 1, 2 or 5 times a power of ten; the number is above 0."""
    power = 10.0 ** math.floor(math.log10(number) + 1e-9)
    return max(step for step in (1.0, 2.0, 5.0) if step <= number / power * (1 + 1e-9)) * power


def large(number: float) -> str:
    """Write a round number without an exponent: ``1,000``, ``0.5``."""
    return f"{number:,.0f}" if number >= 1 else f"{number:g}"


def step_of(name: str, k: int, count: int) -> str:
    """Name the step under way and its share of all: ``kiss, 3 of 7``; k counts from 1."""
    return f"{name}, {k} of {count}"


def duration(seconds: float) -> str:
    """Write how long something takes, with two significant digits: ``45 s``, ``3.2 h``, ``12 d``.

    Parameters
    ----------
    seconds
        Zero or more.
    """
    sizes = ((86400.0, " d"), (3600.0, " h"), (60.0, " min"))
    # Two of a unit or more: 1.5 h is better read as 90 min.
    size, symbol = next(((s, u) for s, u in sizes if seconds >= 2 * s), (1.0, " s"))
    return _fixed(seconds / size, _decimals(seconds / size)) + symbol


def _formatted(number: float | None, sigma: float, unit: Unit, plus_minus: str) -> str:
    if number is None or not math.isfinite(number) or not math.isfinite(sigma):
        return UNKNOWN
    scale, symbol = _scale(max(abs(number), abs(sigma)), unit)
    decimals = _decimals(scale * (sigma or number))
    text = _fixed(scale * number, decimals)
    if plus_minus:
        text += plus_minus + _fixed(scale * sigma, decimals)
    if plus_minus and symbol == "°":
        return f"({text})°"
    return text + symbol


def _scale(size: float, unit: Unit) -> tuple[float, str]:
    """Choose the factor from SI units, and the symbol with its space."""
    if unit == "rad":
        return 180 / math.pi, "°"
    if unit == "1":
        return (1000.0, " ‰") if size < 0.1 else (100.0, " %")
    return (1000.0, " mm") if size < MILLIMETRES_BELOW else (1.0, " m")


def _decimals(number: float) -> int:
    """Digits after the point that leave two significant ones; negative if they are in front."""
    if number == 0:
        return 0
    return 1 - int(f"{number:.1e}".partition("e")[2])


def _fixed(number: float, decimals: int) -> str:
    """Write a number to a digit; nothing is a negative zero."""
    return f"{round(number, decimals) + 0.0:.{max(decimals, 0)}f}"
