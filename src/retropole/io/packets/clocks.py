"""When packets were sent, by the clocks of their LiDARs: each maker writes time differently."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ...base.datatypes import Array, IntArray

Bytes = NDArray[np.uint8]


def seconds(clock: str, packets: Bytes, at: int) -> Array:
    """Time of each packet (N,), s, written at an offset in the way that `CLOCKS` names.

    Unix time, where the LiDAR's clock is set; UTC and TAI are not distinguished.
    """
    return CLOCKS[clock](packets[:, at - 2 :] if clock == "livox" else packets[:, at:])


def _number(sent: Bytes, first: int, size: int, *, is_big: bool) -> IntArray:
    """Whole numbers (N,) of some bytes."""
    shifts = range(size - 1, -1, -1) if is_big else range(size)
    parts = [sent[:, first + k].astype(np.int64) << 8 * by for k, by in enumerate(shifts)]
    number: IntArray = np.bitwise_or.reduce(parts)
    return number


def days_since_1970(year: IntArray, month: IntArray, day: IntArray) -> IntArray:
    """Days (N,) from 1970 to a date; a month or a day that no calendar has counts on."""
    months = (year - 1970) * 12 + month - 1
    days: IntArray = months.astype("M8[M]").astype("M8[D]").astype(np.int64) + day - 1
    return days


def _hours(sent: Bytes) -> IntArray:
    """Seconds (N,) from 1970 to an hour, of year (from 2000), month, day and hour."""
    year, month, day, hour = (sent[:, k].astype(np.int64) for k in range(4))
    return days_since_1970(2000 + year, month, day) * 86400 + hour * 3600


def _date(sent: Bytes) -> IntArray:
    """Seconds (N,) from 1970, of 6 bytes from the year on."""
    return _hours(sent) + sent[:, 4].astype(np.int64) * 60 + sent[:, 5]


def _calendar(sent: Bytes) -> Array:
    whole = _date(sent) * 10**6 + _number(sent, 6, 2, is_big=True) * 1000
    return (whole + _number(sent, 8, 2, is_big=True)) / 1e6


def _unix(sent: Bytes) -> Array:
    return _number(sent, 0, 6, is_big=True) + _number(sent, 6, 4, is_big=True) / 1e6


def _nanoseconds(sent: Bytes) -> Array:
    return _number(sent, 0, 8, is_big=False) / 1e9


def _leishen(sent: Bytes) -> Array:
    """A date and nanoseconds; by PTP 0 and seconds, by NTP microseconds."""
    is_ptp = sent[:, 0] == 0
    whole = np.where(is_ptp, _number(sent, 1, 5, is_big=True), _date(sent))
    rest = _number(sent, 6, 4, is_big=False)
    # No packet says which; of nanoseconds, a hundred in a row are not all in the first millisecond.
    is_ntp = not is_ptp.any() and bool((rest < 10**6).all())
    return whole + rest / (1e6 if is_ntp else 1e9)


def _microseconds(sent: Bytes) -> Array:
    """Microseconds of a second; what second it is, Leishen's device packets say alone."""
    rest = _number(sent, 0, 4, is_big=False) / 1e6
    return rest + np.cumsum(np.diff(rest, prepend=rest[:1]) < -0.5)


def _livox(sent: Bytes) -> Array:
    """Of the first protocol: nanoseconds, or where its type of time is 3 an hour and µs."""
    own = sent[:, 2:]
    by_hour = _hours(own) + _number(own, 4, 4, is_big=False) / 1e6
    return np.where(sent[:, 0] == 3, by_hour, _nanoseconds(own))


CLOCKS: dict[str, Callable[[Bytes], Array]] = {
    "calendar": _calendar,
    "unix": _unix,
    "nanoseconds": _nanoseconds,
    "leishen": _leishen,
    "microseconds": _microseconds,
    "livox": _livox,
}
"""Ways to write a time: year to second and 2 × 16 bits for ms and µs; 48 bits for seconds and 32
for µs; 64 bits, ns; Leishen's; 32 bits, µs, alone; Livox' first, which the type of time precedes by
2 bytes."""
