"""A page of one's own in the style of the reports, for whoever sums up many results.

`fill_page` makes one HTML file that needs no network and runs no other code; `table` and
`share_styles` are of what it shows.
"""

from ..report.page import fill_page, share_styles, table

__all__ = ["fill_page", "share_styles", "table"]
