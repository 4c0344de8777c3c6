"""What numbers, texts and matrices of a document may be: one from elsewhere is not trusted.

No coordinate, angle or count of a recording comes near these bounds. Beyond them squares and
products stop being numbers.
"""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

LARGEST = 1e12
"""Of a number; 1 AU is 1.5e11 m."""

LONGEST_TEXT, LONGEST_LIST = 10_000, 10_000
"""Of a text, in characters, and of a list."""

Status = Literal["ok", "warn", "refused"]

Number = Annotated[float, Meta(ge=-LARGEST, le=LARGEST)]
Size = Annotated[float, Meta(ge=0.0, le=LARGEST)]
"""A length, a time or a standard deviation."""

Share = Annotated[float, Meta(ge=-1e-9, le=1 + 1e-9)]
"""A part of one, with its rounding."""

Count = Annotated[int, Meta(ge=0, le=2**53)]
Text = Annotated[str, Meta(max_length=LONGEST_TEXT)]
Vector = Annotated[list[Number], Meta(min_length=3, max_length=3)]
Pose = Annotated[
    list[Annotated[list[Number], Meta(min_length=4, max_length=4)]],
    Meta(min_length=4, max_length=4),
]
"""4×4, row by row."""

Covariance = Annotated[
    list[Annotated[list[Number], Meta(min_length=6, max_length=6)]],
    Meta(min_length=6, max_length=6),
]
"""6×6, row by row."""
