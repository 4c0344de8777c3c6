"""What every reason code means to a person, and what to do about it."""

from __future__ import annotations

from typing import NamedTuple

LEAN = "Lean one pole by 15° or more against the other and record again."
NEARER = (
    "Stand that pole nearer, about 5 m away and upright rather than lying, or record some seconds "
    "and give a folder of frames."
)


class Advice(NamedTuple):
    """A reason in a few plain words, and what helps."""

    title: str
    help: str


ADVICE: dict[str, Advice] = {
    "no_intensity": Advice(
        "The recording has no intensity",
        "Record again with the intensity (reflectivity) of each return; without it, tape looks "
        "like anything else.",
    ),
    "too_few_poles": Advice(
        "Too few poles were found",
        "Find the poles in the view below. If one is among the rejected clusters, its reason says "
        "which limit it missed; if it is not marked at all, lower the threshold of that LiDAR, or "
        "stand the pole about 5 m away where its beams hit it. 'retropole view' lets you move the "
        "threshold and see what is found.",
    ),
    "pole_count": Advice(
        "Not the number of poles you asked for",
        "Compare the poles marked in both clouds; cover or remove other retro-reflective objects, "
        "or leave out --poles.",
    ),
    "parallel_poles": Advice("The poles are parallel", LEAN),
    "nearly_parallel_poles": Advice("The poles are nearly parallel", LEAN),
    "degenerate_poles": Advice("The poles leave a part of the pose free", LEAN),
    "no_match": Advice(
        "The two LiDARs' poles do not fit each other",
        "Check that the marked poles are the same objects in both clouds and that nothing moved "
        "between the two recordings.",
    ),
    "prior_contradicted": Advice(
        "Nothing found agrees with the rotation you gave",
        "Check the signs and the order of --prior-rpy-deg (degrees; roll, pitch, yaw of the source "
        "in the target's frame), that no LiDAR hangs upside down where --up is given, or leave the "
        "option out.",
    ),
    "placements_disagree": Advice(
        "The placements do not agree on one pose",
        "Check that each --placement names the target first, and that both recordings of it were "
        "made while neither LiDAR moved. Calibrate the placements one by one to see which differs.",
    ),
    "moving_pole": Advice(
        "A pole moved while it was recorded",
        "Fasten the poles, keep hands off and wind away, and record again; or give a single frame.",
    ),
    "too_few_points": Advice(
        "There are too few points to decide by",
        "Where a pole has too few, stand it nearer or record more frames; where the scene has, "
        "record a place with walls, kerbs or parked cars around the poles.",
    ),
    "no_overlap": Advice(
        "The two clouds do not show the same place",
        "Look at both clouds: they must show the same place at the same time. Then check that the "
        "marked poles are the taped ones and not signs or posts.",
    ),
    "ambiguous": Advice(
        "More than one answer fits",
        "Look at the hypotheses side by side: if a person cannot tell them apart either, the scene "
        "has to change, not a setting. If you know roughly how the LiDARs are turned against each "
        "other, --up or --prior-rpy-deg chooses.",
    ),
    "registration_failed": Advice(
        "The scene could not be laid on itself",
        "Try --no-refine, which keeps to the poles; if the verdict is then ok, record a scene with "
        "more surfaces that both LiDARs see.",
    ),
    "poor_fit": Advice(
        "The returns do not fit round poles",
        "Check --radius against a calliper, and the marked poles against what stood there: a bent "
        "pole, a person holding it, or a sign does not fit.",
    ),
    "noisy_poles": Advice(
        "The returns on the poles scatter more than they should",
        "Check --radius against a calliper and that the poles stood still; if the sensor was "
        "recognised wrongly, name it with --sensor-target or --sensor-source.",
    ),
    "few_points": Advice("A pole has few returns", NEARER),
    "few_rings": Advice("A pole meets few beams", NEARER),
    "small_margin": Advice(
        "Another answer scores nearly as well",
        "Choose hypothesis after hypothesis below: walls and ground must coincide in one only.",
    ),
    "weak_direction": Advice(
        "One direction of the pose is weak",
        "Lean the poles more against each other, stand them further apart or nearer to the "
        "LiDARs, or add a placement with --placement.",
    ),
    "offset_not_separable": Advice(
        "A range offset or the radius may be mistaken for the pose",
        "Put poles on different sides of the LiDARs, and measure the radius with a calliper.",
    ),
    "poles_and_scene_disagree": Advice(
        "The poles and the scene pull apart",
        "Look at walls and poles in the view: if walls coincide and poles do not, check --radius "
        "and that the poles did not move; if poles coincide and walls do not, something in the "
        "scene moved, and --no-refine keeps to the poles.",
    ),
}
"""By code. A code that is not here is shown with its message alone."""
