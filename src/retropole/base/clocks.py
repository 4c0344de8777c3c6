"""By how much clocks differ, and which known difference that is.

A LiDAR's times are those of the clock that sets it: TAI by PTP as its profiles have it, GPS time or
UTC by a receiver or NTP. Nothing is corrected here.
"""

from __future__ import annotations

from .quantities import duration

UNSET = 86_400.0
"""Seconds from the recorder's clock at which a LiDAR's was never set; one that is set wrongly, as
to another time zone, is nearer."""

NO_DATE = 1e9
"""Seconds, 32 years: older than any LiDAR, so that no date in its memory is as far away."""

NOTICED = 0.5
"""Tolerance, s, for clocks to differ, or to match a known difference: a message is recorded up to
some tenths after its first point, and differences of time scales are whole seconds."""

SCALES = {
    37.0: ("TAI (PTP)", "UTC (NTP)"),
    18.0: ("GPS time", "UTC (NTP)"),
    19.0: ("TAI (PTP)", "GPS time"),
}
"""Seconds that the first time scale is ahead of the second, since 2017 (IERS, Bulletins C 52 to 70:
no leap second since; GPS time is 19 s behind TAI by definition), and what sets clocks to it."""

ZONE = 900.0
"""Seconds: time zones differ by whole quarters of an hour."""


def is_set(ahead: float) -> bool:
    """Whether two clocks that differ by this, s, may both be set."""
    return abs(ahead) < UNSET


def words_of(ahead: float, other: str = "the recorder's") -> str:
    """Describe the offset of a LiDAR's clock to another, and which known difference that is.

    Parameters
    ----------
    ahead
        Seconds that it is ahead of the other.
    other
        What the other is called.
    """
    if abs(ahead) >= NO_DATE:
        return "is not set: it runs from its start, its times are not dates"
    if not is_set(ahead):
        long = f"is {duration(abs(ahead))} {_way(ahead)} {other}"
        return f"{long}: it was never set, or its data were recorded again later"
    if abs(ahead) < NOTICED:
        return f"agrees with {other} within {NOTICED:g} s"
    size = duration(abs(ahead)) if _zones(ahead) else f"{abs(ahead):.1f} s"
    return f"is {size} {_way(ahead)} {other}, {_cause(ahead)}"


def _way(ahead: float) -> str:
    return "ahead of" if ahead > 0 else "behind"


def _zones(ahead: float) -> int:
    """By how many quarters of an hour time zones differ as clocks do; 0 if no zones do."""
    quarters = round(abs(ahead) / ZONE)
    return quarters if abs(abs(ahead) - quarters * ZONE) < NOTICED else 0


def _cause(ahead: float) -> str:
    for seconds, scales in SCALES.items():
        if abs(abs(ahead) - seconds) < NOTICED:
            one, other = scales if ahead > 0 else scales[::-1]
            return f"as {one} is {_way(ahead)} {other}"
    if _zones(ahead):
        return "as one time zone is from another"
    return "which is not a known difference of time scales"
