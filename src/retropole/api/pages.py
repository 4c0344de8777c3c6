"""A custom page in the style of the reports, for whoever sums up many results.

`fill_page` makes one HTML file that needs no network and runs no other code; its parts are `table`
and pieces of `pieces.html`, which `fill` fills; `inline` is for lines
of Markdown, as `api.explain` gives them.
"""

from ..report.page import (
    EMPTY,
    Html,
    fill,
    fill_page,
    folded,
    inline,
    join,
    share_styles,
    table,
)

__all__ = [
    "EMPTY",
    "Html",
    "fill",
    "fill_page",
    "folded",
    "inline",
    "join",
    "share_styles",
    "table",
]
