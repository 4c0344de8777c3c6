"""Why two LiDARs could not be tested by ``retropole certify``."""

from __future__ import annotations

from typing import Literal

from .explanation import Explanation

FieldTestCode = Literal["too_few_distances"]

FIELD_TEST: dict[FieldTestCode, Explanation] = {
    "too_few_distances": Explanation(
        "Too few distances between poles",
        "Both LiDARs see fewer than four distances between poles that are the same for both. Four "
        "poles give six, three give three, two give one; the distances of several placements add "
        "up.",
        (
            "Stand four poles where both LiDARs see them, each leaning another way, or record "
            "more placements and give each with `--placement`.",
            "See which poles are found with `retropole detect`.",
        ),
    ),
}
