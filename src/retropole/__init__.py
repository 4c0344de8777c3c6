"""Calibrate LiDARs to each other with poles wrapped in retro-reflective tape.

Read `retropole.pipeline` first: it is the method on one page.
"""

from importlib.metadata import version

__version__ = version("retropole")
