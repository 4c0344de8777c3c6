"""The report: one HTML file that holds a whole run, or recordings, and opens offline."""

from .render import render_recordings, render_report

__all__ = ["render_recordings", "render_report"]
