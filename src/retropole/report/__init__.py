"""The report: one HTML file that holds a whole run and opens offline in any browser."""

from .render import render_report, render_site

__all__ = ["render_report", "render_site"]
