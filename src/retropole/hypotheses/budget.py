"""How much was tried of what the poles allow, and how a refusal counts the rest.

Beside bright things that may be poles hundreds of ways of laying some on others are possible. So
many of each kind are tried, the best first: counts, not seconds, so that the same recordings give
the same answer on any machine.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from ..base.errors import Refusal


class Share(NamedTuple):
    """How many were tried, the best first, of how many that there are."""

    tried: int
    found: int


class Tried(NamedTuple):
    """How much was tried of what the poles of a placement allow.

    Attributes
    ----------
    pairs
        Of pairs of poles that have the shape of a pair of the other LiDAR: laid on each other.
    ways
        Of the ways of laying the poles on each other: scored by the scene.
    fitting
        Of those that fit exactly: registered.
    """

    pairs: Share = Share(0, 0)
    ways: Share = Share(0, 0)
    fitting: Share = Share(0, 0)


NOTHING = Tried()

VERBS = {"pairs": "laid", "ways": "tried", "fitting": "registered"}


def with_what_was_tried(refusal: Refusal, tried: Iterable[Tried]) -> Refusal:
    """Add to the values of a refusal what was left out to bound the time, where something was.

    Parameters
    ----------
    refusal
        Why there is no answer.
    tried
        In each attempt; what counts is the one that had the most ways.
    """
    most = max(tried, key=lambda each: (each.ways.found, each.fitting.found), default=NOTHING)
    cut = {name: share for name, share in most._asdict().items() if share.tried < share.found}
    if not cut:
        return refusal
    counts = {
        key: count
        for name, share in cut.items()
        for key, count in ((name, share.found), (f"{name}_{VERBS[name]}", share.tried))
    }
    return Refusal(refusal.code, refusal.message, {**refusal.values, **counts})
