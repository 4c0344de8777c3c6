"""The report of a site: one HTML file that holds all its LiDARs and opens offline."""

from .render import render_site, write_site_report

__all__ = ["render_site", "write_site_report"]
