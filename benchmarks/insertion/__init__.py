"""Taped poles in real recordings, met by the recordings' own beams."""

from .inserting import InsertedPair, InsertedSite, insert_into_site, insert_poles
from .writing import write_inserted

__all__ = [
    "InsertedPair",
    "InsertedSite",
    "insert_into_site",
    "insert_poles",
    "write_inserted",
]
