"""A reason code in words."""

from __future__ import annotations

import re
from typing import NamedTuple


class Explanation(NamedTuple):
    """What a code means, and what to do about it; help and advice are Markdown.

    Attributes
    ----------
    title
        A few plain words.
    help
        What it means, with the limit in numbers.
    advice
        What to do, one action each; empty where there is nothing to do.
    """

    title: str
    help: str
    advice: tuple[str, ...] = ()


def plain(markdown: str) -> str:
    """Take links, emphasis and code marks out of help or advice, for a terminal."""
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", markdown)
    return re.sub(r"[`*]", "", text)
