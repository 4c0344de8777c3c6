"""The report: one HTML file of a whole run, or of recordings, that opens offline."""

from .render import render_recordings, render_report

__all__ = ["render_recordings", "render_report"]
