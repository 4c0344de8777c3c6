"""Why a retro-reflective cluster is not a pole. Signs and vests ought to be rejected."""

from __future__ import annotations

from typing import Literal

from .explanation import Explanation

ClusterCode = Literal[
    "too_short",
    "too_long",
    "too_wide",
    "too_few_rows",
    "along_a_beam",
    "part_of_a_surface",
    "goes_on_without_tape",
    "interrupted",
    "end_on",
    "on_a_body",
]

CLUSTER: dict[ClusterCode, Explanation] = {
    "too_short": Explanation(
        "Too short",
        "Less than 0.25 m long: a pole hidden in part, or a small plate.",
        ("If it is your pole, move it into view.",),
    ),
    "too_long": Explanation("Too long", "More than 4 m long: a rail, or a line on the road."),
    "too_wide": Explanation(
        "Too wide",
        "Too thick for its length, or for the radius of the poles: a plate, a vest, or a post.",
        (
            "If it is your pole, check `--radius`; or it moved while it was recorded, or the noise "
            "is large: record again, or nearer.",
        ),
    ),
    "too_few_rows": Explanation(
        "On too few rings",
        "On fewer than 3 rings.",
        ("If it is your pole, stand it nearer, or more upright.",),
    ),
    "along_a_beam": Explanation(
        "Along one ring",
        "Points that follow each other on one ring of the sweep: the edge of a plate, or a band.",
        ("If it is your pole, it lies nearly level; stand it up.",),
    ),
    "part_of_a_surface": Explanation(
        "Part of a surface",
        "Other returns lie all along it: a stripe, a plate, bright ground.",
        ("If it is your pole, it stands too near a wall or a person; move it free by 0.6 m.",),
    ),
    "goes_on_without_tape": Explanation(
        "Continues without tape",
        "It continues without tape: a sign on its post.",
        ("If it is your pole, tape it from end to end, 0.8 m at least.",),
    ),
    "interrupted": Explanation(
        "Two pieces with a gap",
        "A gap takes up half of its length or more, and the rings do not explain it: two things in "
        "line, or a pole that something hides.",
        ("If it is your pole, move what hides its middle.",),
    ),
    "end_on": Explanation(
        "Seen nearly end on",
        "It runs within 15° of the line of sight: a line on the ground, or the edge of something.",
        ("If it is your pole, lean it less towards the LiDAR.",),
    ),
    "on_a_body": Explanation(
        "A band on a person",
        "Something with air about it stands within 0.65 m of it, and goes on above it and below "
        "it: a band that a person wears or holds. People walk on between the recordings. It counts "
        "only where the other LiDAR and the scene confirm it.",
        ("If it is your pole, let nobody stand beside it, or tape it to its top.",),
    ),
}
