"""What ``retropole watch`` sees and reports now, as the terminal and the page show it.

Schema ``retropole/watch/1``: metres and radians.
"""

from __future__ import annotations

from typing import Literal

import msgspec

from ..base.bounded import Count, Number, Share, Size, Text
from ..base.uncertainty import ErrorAtRange
from ..base.uncertainty.purpose import Need

WATCH_SCHEMA: Literal["retropole/watch/1"] = "retropole/watch/1"

Phase = Literal["waiting", "placing", "capturing", "walking", "calibrating", "done"]
"""No sweeps yet; something is to be done first; sweeps are kept; of a pole that is carried; the
answer is worked out; over."""

Points = list[tuple[Number, Number]]
"""Seen from above, metres."""


class PoleNow(msgspec.Struct, frozen=True, kw_only=True):
    """A pole as one LiDAR sees it now.

    Attributes
    ----------
    name
        What it is called in words: ``1``, of a plan ``A``.
    rings
        None if the LiDAR does not number them.
    is_still, is_good
        Whether it was stationary for as long as a capture needs, and whether nothing is to be
        done about it.
    word
        What is wrong with it, in two or three words; empty if nothing is.
    """

    name: Text
    distance_m: Size
    returns: Count
    rings: Count | None
    is_still: bool
    is_good: bool
    word: Text = ""


class LidarNow(msgspec.Struct, frozen=True, kw_only=True):
    """A LiDAR now.

    Attributes
    ----------
    source
        Where its sweeps come from.
    sweeps_per_s, age_s
        How many come, and how old the newest is; None if none came.
    points
        Of the newest sweep.
    word
        Why nothing comes, or what is wrong with what comes; empty if all is well.
    skipped
        In words, how many sweeps were left out of those that came lately; empty if none was.
    """

    name: Text
    source: Text
    sweeps_per_s: Size
    age_s: Size | None
    points: Count
    poles: list[PoleNow]
    word: Text = ""
    skipped: Text = ""


class ChartNow(msgspec.Struct, frozen=True, kw_only=True):
    """Where the pole was carried, from above, in the frame of the first LiDAR in it.

    Attributes
    ----------
    names, lidars, paths
        Of each LiDAR: its name, where it is, and where it saw the pole.
    """

    names: list[Text]
    lidars: Points
    paths: list[Points]


class WalkNow(msgspec.Struct, frozen=True, kw_only=True):
    """A walk with one pole, as far as it is solved.

    Attributes
    ----------
    seconds
        How long both LiDARs saw the pole.
    charts
        One of both LiDARs where their pose is known, else one for each.
    at_m
        Range of the need.
    bounds
        What no point up to there is off by more than, with 95 % probability, after each solution:
        how long the walk was, s, and metres.
    """

    seconds: Size
    charts: list[ChartNow]
    at_m: Size
    bounds: Points


class WatchDoc(msgspec.Struct, frozen=True, kw_only=True):
    """What is seen now, and the one next thing to do.

    Attributes
    ----------
    is_good
        Green: nothing is to be done but to keep still.
    code, next
        What is to be done, as a name that stays the same and in words.
    angle_rad
        Between the two poles that differ most in direction; None if no two are seen.
    captured, wanted
        Sweeps of each LiDAR kept of this placement, and how many are requested.
    placements
        How many are kept whole.
    predicted_error, bound_m
        Of the answer with what is kept until now, 1 σ at several ranges; and what no point up to
        the need's range is off by more than, with 95 % probability. None and empty before the
        first.
    probability
        That the need is fulfilled.
    status
        Verdict of the answer; None before there is one.
    words
        What happened, the newest last.
    walk
        Of a pole that is carried; None before the pole was seen for long enough.
    """

    schema: Literal["retropole/watch/1"] = WATCH_SCHEMA
    phase: Phase
    is_good: bool
    code: Text
    next: Text
    seconds: Size
    lidars: list[LidarNow]
    angle_rad: Size | None = None
    captured: Count = 0
    wanted: Count = 0
    placements: Count = 0
    need: Need | None = None
    predicted_error: list[ErrorAtRange] = []
    bound_m: Size | None = None
    probability: Share | None = None
    status: Text | None = None
    words: list[Text] = []
    walk: WalkNow | None = None
