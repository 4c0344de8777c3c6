"""The page of `retropole watch`, for the phone of who holds a pole: the one next thing to do.

It holds nothing of a watch itself: it fetches ``state`` beside it, a `WatchDoc`, again and again.
"""

from __future__ import annotations

import base64
import hashlib
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from string import Template


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
    template, style, script = (_asset(f"watch.{kind}") for kind in ("html", "css", "js"))
    policy = (
        f"default-src 'none'; script-src {_hash(script)}; style-src {_hash(style)}; "
        "img-src data:; connect-src 'self'; base-uri 'none'; form-action 'none'; "
        "frame-ancestors 'none'"
    )
    return WatchPage(Template(template).substitute(style=style, script=script), policy)


def _asset(name: str) -> str:
    return (files("retropole.report") / "assets" / name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    """Name a script or a style as a policy does."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
