"""The page of `retropole watch`, for the phone of who holds a pole: the one next thing to do.

It holds nothing of a watch itself: it fetches ``state`` beside it, a `WatchDoc`, again and again.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from string import Template

from .page import asset, source_of


@dataclass(frozen=True)
class WatchPage:
    """A page, and what it may run and load (its Content-Security-Policy).

    Attributes
    ----------
    html
        The whole page: it loads nothing but the state.
    policy
        Allows its own style and code, by their hashes, and the state.
    """

    html: str
    policy: str


@cache
def watch_page() -> WatchPage:
    """Put the page together."""
    template, style, script = (asset(f"watch.{kind}") for kind in ("html", "css", "js"))
    policy = (
        f"default-src 'none'; script-src {source_of(script)}; style-src {source_of(style)}; "
        "img-src data:; connect-src 'self'; base-uri 'none'; form-action 'none'; "
        "frame-ancestors 'none'"
    )
    return WatchPage(Template(template).substitute(style=style, script=script), policy)
