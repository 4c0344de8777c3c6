"""What numbers, texts and arrays of a document may be: one of another source is not trusted.

No coordinate, angle or count of a recording comes near these bounds. Beyond them squares and
products stop being numbers. `result.decoding` compares a document with all bounds.
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

LARGEST = 1e12
"""Of a number; 1 AU is 1.5e11 m."""

LONGEST_TEXT, LONGEST_LIST = 10_000, 10_000
"""Of a text, in characters, and of a list."""

Status = Literal["ok", "warn", "refused"]

Number = Annotated[float, Meta(ge=-LARGEST, le=LARGEST)]
Whole = Annotated[int, Meta(ge=-int(LARGEST), le=int(LARGEST))]
Size = Annotated[float, Meta(ge=0.0, le=LARGEST)]
"""A length, a time or a standard deviation."""

Positive = Annotated[float, Meta(gt=0.0, le=LARGEST)]
"""A length that is not none."""

Sigma = Annotated[float, Meta(ge=1e-9, le=LARGEST)]
"""A standard deviation that others are divided by, metres: there is no information to a
nanometre."""

Share = Annotated[float, Meta(ge=-1e-9, le=1 + 1e-9)]
"""A part of one, with its rounding."""

ShareOfSome = Annotated[float, Meta(gt=0, le=0.99)]
"""A part of one that has odds: neither none nor all."""

Count = Annotated[int, Meta(ge=0, le=2**53)]
Text = Annotated[str, Meta(max_length=LONGEST_TEXT)]
Name = Annotated[str, Meta(min_length=1, max_length=LONGEST_TEXT)]

# Arrays of numbers are the same to a type checker; a reader distinguishes them by what is noted.
_F = np.dtype[np.float64]
Vector = np.ndarray[tuple[Annotated[int, "3"]], _F]
Direction = np.ndarray[tuple[Annotated[int, "3, a unit vector"]], _F]
Pose = np.ndarray[tuple[Annotated[int, "4, rigid"], int], _F]
"""4×4, row by row."""

Covariance = np.ndarray[tuple[Annotated[int, "6, positive"], int], _F]
"""6×6, row by row."""

PartCovariance = np.ndarray[tuple[Annotated[int, "6, may be zero"], int], _F]
"""The same of one source of error, or of what defines the frame: it may have no variance."""
