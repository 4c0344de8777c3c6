"""Calibrate LiDARs to each other with poles wrapped in retro-reflective tape.

Read `retropole.pipeline` first: it is the method on one page.
"""

__version__ = "0.1.0"
