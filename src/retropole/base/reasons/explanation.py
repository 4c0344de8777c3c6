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


MARKDOWN_LINK = re.compile(r"\[([^\]]*)\]\([^)]*\)")
MARKDOWN_LINK_SENTENCE = re.compile(rf"(?:^|(?<=[.!?]))\s*{MARKDOWN_LINK.pattern}\.")


def unlinked(markdown: str) -> str:
    """Take the links out of help or advice: a page or terminal is read away from the documentation.

    A link becomes its words; a sentence that is nothing but a link goes.
    """
    return MARKDOWN_LINK.sub(r"\1", MARKDOWN_LINK_SENTENCE.sub("", markdown)).strip()


def plain(markdown: str) -> str:
    """Take links, emphasis and code marks out of help or advice, for a terminal."""
    return re.sub(r"[`*]", "", unlinked(markdown))
