"""Reasons of ``retropole check``: why it cannot tell, or what to know of its answer."""

from __future__ import annotations

from typing import Literal

from .explanation import Explanation

CheckCode = Literal[
    "swapped",
    "poles_not_trusted",
    "no_covariance",
    "no_common_surfaces",
    "clouds_do_not_fit",
    "too_weak",
    "wider_tolerance",
    "within_tolerance",
    "size_unsure",
    "stored_fits_as_well",
    "scene_denies_stored",
]

CHECK: dict[CheckCode, Explanation] = {
    "swapped": Explanation(
        "Target and source are swapped",
        "The new recordings fit the stored pose the other way round: TARGET is of the LiDAR that "
        "was the source when the result was made. Nothing is said of whether it moved.",
        ("Give the recordings in the order in which the result was made, and check again.",),
    ),
    "poles_not_trusted": Explanation(
        "The new poles do not fit the scene",
        "The new poles gave a pose that does not fit the scene. The scene was used instead.",
        (
            "Check for other retro-reflective objects, and that the poles stood still between the "
            "two recordings.",
        ),
    ),
    "no_covariance": Explanation(
        "The stored transform has no covariance",
        "The stored file does not say how certain it is.",
        ("Give `result.json`, or `--sigma-deg` and `--sigma-m`.",),
    ),
    "no_common_surfaces": Explanation(
        "The clouds have no surfaces in common",
        "Near the stored pose the clouds have no surfaces in common.",
        ("A LiDAR was moved far, or the files are swapped. Calibrate again, with poles.",),
    ),
    "clouds_do_not_fit": Explanation(
        "The clouds do not fit together",
        "The clouds do not fit together at or near the stored pose.",
        ("Moved far, other LiDARs, or recorded at different times. Calibrate again.",),
    ),
    "too_weak": Explanation(
        "A movement might have been missed",
        "No movement was found, but these data tell a larger one only than they must: than the "
        "tolerance asked for, or than the widest that is of any use.",
        (
            "The message says what they tell, and whether the stored calibration or the new "
            "recordings are weak. Calibrate with the scene, add poles, record more frames, or "
            "widen `--tolerance-deg` and `--tolerance-m`.",
        ),
    ),
    "wider_tolerance": Explanation(
        "The same, within more than the default tolerance",
        "No movement was found, and by more than the tolerance that the message names there was "
        "none. A smaller one, of the default, might have been missed. The answer is *same*.",
        (
            "Nothing, where that is enough. Otherwise give `--tolerance-deg` and `--tolerance-m`, "
            "which are held to, and see in the message what is weak.",
        ),
    ),
    "within_tolerance": Explanation(
        "It moved by less than the tolerance",
        "A movement was found, and it is surely smaller than the tolerance. The answer is *same*.",
        ("Nothing. Narrow the tolerance where it matters.",),
    ),
    "size_unsure": Explanation(
        "It moved, by how much is uncertain",
        "That it moved is certain, by how much is not.",
        ("Calibrate again; after a gross movement, with poles.",),
    ),
    "stored_fits_as_well": Explanation(
        "The stored pose fits as well as the one that was found",
        "Another pose was found, but the surfaces of the new clouds fit each other no better under "
        "it than under the stored one.",
        ("Record again, more frames, or set up the poles.",),
    ),
    "scene_denies_stored": Explanation(
        "What stands in the scene denies the stored pose",
        "No movement was found, but too many places off the ground stand, under the stored pose, "
        "where the other LiDAR looked through. See "
        "[what stands in the scene](certainty.md#what-stands-in-the-scene).",
        (
            "Record both clouds at the same time, with nothing large moving between the LiDARs.",
            "Calibrate again, where it stays so.",
        ),
    ),
}

Prefix = Literal["stored", "poles"]
"""Put in front of a code of the stored result, and of the new recordings' poles."""

PREFIXED: dict[Prefix, Explanation] = {
    "stored": Explanation(
        "The stored result has a weakness",
        "In front of any code above: a warning or a refusal of the stored result itself.",
        ("Calibrate again, better, and store that.",),
    ),
    "poles": Explanation(
        "The new recordings could not be calibrated by poles",
        "In front of any code above: why the new recordings could not be calibrated by poles. The "
        "scene was used instead.",
        ("Nothing, where no poles stand there. Otherwise see the code.",),
    ),
}
