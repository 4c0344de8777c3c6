"""What a worker is told of the check of one site, beside its recordings."""

from __future__ import annotations

from datetime import datetime

import msgspec


class Check(msgspec.Struct, frozen=True, kw_only=True):
    """What a site is held against.

    Attributes
    ----------
    tolerance
        Movement that matters, rad and m; None for as little as the data tell.
    tried
        When the run began: the time of a site whose recordings tell none.
    document
        The stored result itself; None where it is at the place that the site names.
    lidars
        Target and source by their names, of the stored result of a site; None of a pair.
    known
        Keys of the checks that the history has: these are not done again.
    """

    tolerance: tuple[float | None, float | None]
    tried: datetime
    document: str | None = None
    lidars: tuple[str, str] | None = None
    known: list[str] = []
