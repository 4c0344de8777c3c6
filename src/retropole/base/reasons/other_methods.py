"""Reasons of the other methods in ``retropole compare``."""

from __future__ import annotations

from typing import Literal

from .explanation import Explanation

OtherMethodCode = Literal[
    "unmatched",
    "too_few_planes",
    "planes_unmatched",
    "no_scene",
]

OTHER_METHODS: dict[OtherMethodCode, Explanation] = {
    "unmatched": Explanation(
        "Too few features agree",
        "KISS-Matcher or FPFH found too few features that agree.",
        ("Record where the LiDARs see more of the same.",),
    ),
    "too_few_planes": Explanation(
        "Too few planes",
        "A cloud has no three linearly independent planes.",
        ("Record where the ground and two walls that are not parallel are seen.",),
    ),
    "planes_unmatched": Explanation(
        "The planes do not match",
        "No three planes of the target stand as three of the source do.",
        ("Record where both see the same walls.",),
    ),
    "no_scene": Explanation(
        "The scene could not refine",
        "`poles+scene` had too few surfaces that both LiDARs see.",
        ("The answer of `poles` stands.",),
    ),
}
