"""Why a calibration was refused: exit code 3, and no transform."""

from __future__ import annotations

from typing import Literal

from .explanation import Explanation

RefusedCode = Literal[
    "no_intensity",
    "threshold_too_low",
    "far_from_lidar",
    "same_recording",
    "wrong_unit",
    "wrong_sensor",
    "too_few_poles",
    "parallel_poles",
    "no_match",
    "pole_count",
    "ambiguous",
    "no_overlap",
    "too_few_points",
    "prior_contradicted",
    "placements_disagree",
    "moving_pole",
    "moving_lidar",
    "poor_fit",
    "poles_inconsistent",
    "degenerate_poles",
    "poles_scene_contradict",
    "scene_contradicts",
    "mirrored",
    "wrong_scale",
    "registration_failed",
    "refused",
]

REFUSED: dict[RefusedCode, Explanation] = {
    "no_intensity": Explanation(
        "The recording has no intensity",
        "The file has no intensity, or the same for every point. Tape cannot be told from the "
        "rest.",
        (
            "Record with intensity (reflectivity, signal). `retropole info FILE` shows what a file "
            "has.",
            "Some converters drop it: convert again, or use the bag itself. "
            "[Names that are known](formats.md#names).",
            "In Python, give an array of shape (N, 4): x, y, z, intensity.",
        ),
    ),
    "threshold_too_low": Explanation(
        "Most of the recording passes the threshold",
        "Tape is a small part of what a LiDAR sees. Where most returns are as bright, the "
        "threshold is on another scale than the file's intensities, or too low.",
        (
            "Leave `--threshold-target` and `--threshold-source` away: they come from the sensor "
            "or the cloud.",
            "`retropole info FILE` shows the range of the intensities; "
            "[`retropole view`](viewer.md) shows what each threshold does.",
        ),
    ),
    "far_from_lidar": Explanation(
        "The points are too far away from the LiDAR",
        "Hardly a point is so near to where the beams are taken to start that a pole could be seen "
        "there (100 m with a radius of 2 cm), or a coordinate is beyond 10 km. Clouds in the frame "
        "of a map are like that.",
        (
            "Give the cloud in the LiDAR's own frame, as its driver writes it.",
            "A cloud in another frame needs its rings, or a PCD its viewpoint: they tell "
            "[where the LiDAR was](formats.md#where-the-beams-start). Of map coordinates, subtract "
            "the same offset from all points before they are stored as 32-bit floats.",
            "Bring the cloud to metres; `--unit` reads millimetres and centimetres.",
            "A LAS file in map coordinates does not say where the LiDAR stood: export it from the "
            "LiDAR's own software in its own frame, or subtract the LiDAR's position from all "
            "points.",
            "A few points far beyond all others are damaged: leave them out.",
        ),
    ),
    "same_recording": Explanation(
        "A recording is given twice",
        "Two recordings are one file or copies of it, or more than half of the points of one are "
        "in the other, too, number for number. Two LiDARs never measure alike to the last digit, "
        "nor does one LiDAR twice.",
        (
            "Give the recording of one LiDAR as the target and that of the other as the source.",
            "With `--placement`, give recordings of each placement: poles moved, recorded again. "
            "The same one twice says nothing more.",
            "If both LiDARs' points were joined in one cloud, take them apart first.",
        ),
    ),
    "wrong_unit": Explanation(
        "The coordinates are not in metres",
        "Half of the points are farther away than any LiDAR with poles around it sees, as where a "
        "file holds millimetres or centimetres. Nothing is converted unasked.",
        (
            "Give `--unit mm` or `--unit cm`, and `--unit-source` where only one of the two is; in "
            "Python `unit` and `unit_source`. The result keeps it, and `report` and `check` use "
            "it. [How it is told](formats.md#units).",
            "`retropole info FILE` shows the ranges. The pole's distance from the LiDAR, which you "
            "know, says which unit it is.",
        ),
    ),
    "wrong_sensor": Explanation(
        "The cloud is not of the sensor you named",
        "The cloud has more rings than the sensor that `--sensor-target` or `--sensor-source` "
        "names, or rings where that sensor has none. Its threshold, noise and beam width would be "
        "those of another. So it is where rings lie outside of its field of view. A cloud of fewer "
        "rings is never refused.",
        (
            "`retropole info FILE` names the sensors that fit the cloud. Check that target and "
            "source are not swapped.",
            "Leave the sensor at `auto` where it is not in the [table](sensors.md), and give "
            "`--threshold-target` or `--threshold-source` where the cloud's own is not right.",
            "Where two LiDARs' points were joined in one cloud, take them apart first.",
        ),
    ),
    "too_few_poles": Explanation(
        "Too few poles were found",
        "One LiDAR sees fewer than two poles, or fewer than `--poles` asks for.",
        (
            "`retropole detect FILE` lists what it found and "
            "[why the rest was rejected](#why-a-cluster-is-no-pole); the report marks it.",
            "If the pole is not marked at all, its returns are below the threshold. Lower "
            "`--threshold-target` or `--threshold-source`; [`retropole view`](viewer.md) shows "
            "what that does.",
            "If the pole is marked with few returns, stand it nearer, about 5 m, or record more "
            "frames.",
            "If the pole is beside a wall, a person or a sign, move it free.",
        ),
    ),
    "parallel_poles": Explanation(
        "The poles are parallel",
        "All poles seen by a LiDAR are less than 5° apart. The place along them is left open.",
        ("Lean one by 15° or more against the other and record again.",),
    ),
    "no_match": Explanation(
        "The two LiDARs' poles do not fit each other",
        "The poles of the two LiDARs do not agree in angle and distance.",
        (
            "Check with `retropole detect` that both see the same two poles, not a post or another "
            "object.",
            "If a pole moved between the recordings, record again.",
            "Check that the points are in metres and that no other program has distorted them.",
        ),
    ),
    "pole_count": Explanation(
        "Not the number of poles you asked for",
        "Poles agree between the LiDARs, but not as many as `--poles` says.",
        (
            "Cover or remove other retro-reflective objects, make the missing pole visible, or "
            "leave `--poles` out.",
        ),
    ),
    "ambiguous": Explanation(
        "More than one answer fits",
        "More than one way of laying the poles on each other fits the surroundings equally. "
        "[Why](hypotheses.md). In `retropole compare`, of `planes`: two matches of planes fit "
        "equally well.",
        (
            "A third pole always decides.",
            "Move a car, a box or the poles so that the place is no longer symmetric about them.",
            "If you know how the LiDARs are mounted, the list of [the hypotheses that stand]"
            "(hypotheses.md#you-know-the-place) says what decides: `--hypothesis a`, and `--up` or "
            "`--prior-rpy-deg R P Y` only where they leave one.",
        ),
    ),
    "no_overlap": Explanation(
        "The two clouds do not show the same place",
        "Under the best hypothesis fewer than 25 % of the points find a neighbour in the other "
        "cloud; or fewer than 15 %, or of those that both LiDARs could see fewer than 35 %. In "
        "`retropole compare`, of a rival: too few points end near the other cloud, its start was "
        "too far off.",
        (
            "Check that both LiDARs see the same place, and that it was recorded at the same time.",
            "Check with `retropole detect` that signs or posts were not taken for the poles.",
            "If the fields of view hardly overlap, stand the poles, and some objects, where both "
            "look.",
        ),
    ),
    "too_few_points": Explanation(
        "There are too few points to decide by",
        "Too few returns: on a pole, in a cluster, or in a cloud that was downsampled to compare "
        "it.",
        (
            "On a pole: stand it nearer, or record more frames.",
            "In the scene: record a place with walls, kerbs or parked cars. `check`, `evaluate` "
            "and `compare` need that too.",
        ),
    ),
    "prior_contradicted": Explanation(
        "Nothing found agrees with the rotation you gave",
        "No way of laying the poles on each other agrees with `--up` or `--prior-rpy-deg` within "
        "3 σ.",
        (
            "Check signs and order: roll, pitch, yaw in degrees, about fixed axes, of the source "
            "in the target's frame.",
            "Leave out `--up` where a LiDAR hangs upside down.",
            "Widen `--prior-sigma-deg`, or leave the prior out.",
        ),
    ),
    "placements_disagree": Explanation(
        "The placements do not agree on one pose",
        "No pose fits all placements.",
        (
            "Check that each `--placement` names the target first.",
            "If a LiDAR moved between placements, those before and after cannot be used together.",
            "Calibrate them one by one to see which differs.",
        ),
    ),
    "moving_pole": Explanation(
        "A pole moved while it was recorded",
        "A pole strays between frames by more than 2 cm and more than its noise allows.",
        (
            "Fasten the poles, keep hands and wind off, and record again.",
            "Or read the frames while it stood still: `--frames A:B`.",
        ),
    ),
    "moving_lidar": Explanation(
        "A LiDAR moved while it recorded",
        "The last frames of a recording are turned against the first by more than 0.3°.",
        (
            "Fasten the LiDAR, wait until nothing sways, and record again.",
            "Or read the frames while it stood still: `--frames A:B`.",
        ),
    ),
    "poor_fit": Explanation(
        "The returns do not fit round poles",
        "The returns do not lie on poles that both LiDARs share: more than 5 cm of noise, or fewer "
        "than half of the returns fit.",
        (
            "Check `--radius` with a calliper. It is half the thickness, in metres.",
            "Check what was taken for a pole: a bent pole, a sign or the hand that holds the pole "
            "does not fit.",
        ),
    ),
    "poles_inconsistent": Explanation(
        "The poles do not stand alike in both recordings",
        "Distances and angles between the poles differ between the two LiDARs by more than the "
        "noise and the instruments' errors allow (χ², the message gives it with its limit). A pose "
        "moves all poles together; it cannot put one right.",
        (
            "If a pole was moved or bumped between the recordings, record again. The message names "
            "the pole that fits worst.",
            "If that one is another object, a post or a bollard, cover it. All poles must have the "
            "radius that `--radius` says.",
            "Record both LiDARs at the same time.",
            "Name the sensors with `--sensor-target` and `--sensor-source`: how wide their beams "
            "are is then known. Where `--frames` asks for millions of points, take fewer: what all "
            "sweeps have wrong alike does not average out.",
        ),
    ),
    "degenerate_poles": Explanation(
        "The poles leave a part of the pose free",
        "The poles leave the pose free in some direction by more than 0.1 rad or 0.5 m.",
        ("Lean one by 15° or more against the other; stand them apart, upright, about 5 m away.",),
    ),
    "poles_scene_contradict": Explanation(
        "The poles and the scene contradict each other",
        "Poles and scene give poses further apart than any stated error explains. One of them is "
        "wrong, and the data do not say which.",
        (
            "If a pole moved between the recordings, or something large in the scene did, record "
            "again, both LiDARs at the same time.",
            "Check with `retropole detect` that both see the same poles, and `--radius` with a "
            "calliper.",
            "If you know that the poles stood still, `--no-refine` keeps to them.",
        ),
    ),
    "scene_contradicts": Explanation(
        "The scene denies what the poles say",
        "Under the pose that the poles give, much of what stands in the scene is where the other "
        "LiDAR looked through. The poles fit each other, but not the place. Or far surfaces lead "
        "the pose away from the poles, and ground and walls near them lie further apart there. "
        "[How it is told](certainty.md#what-stands-in-the-scene).",
        (
            "Both LiDARs must record the same poles in the same place: check that the two files "
            "are of one placement, and that nobody carried or turned a pole in between.",
            "Check with `retropole detect` that both LiDARs found the same poles.",
            "If much of the scene itself moved, record again, both LiDARs at the same time.",
        ),
    ),
    "mirrored": Explanation(
        "One of the two clouds is mirrored",
        "With one axis of one cloud reversed, poles and scene fit each other clearly better than "
        "under any rigid motion. Which of two horizontal axes it is cannot be told: they differ by "
        "a rotation. [How it is told](certainty.md#mirrored-and-scaled-clouds).",
        (
            "Look at the driver and at what converted the files: one of them has a left-handed "
            "frame, or swaps or negates a coordinate.",
            "In `retropole view`, what stands left and right of a LiDAR shows which cloud it is.",
            "Reverse that coordinate again, and calibrate again.",
        ),
    ),
    "wrong_scale": Explanation(
        "One of the two clouds is scaled",
        "Lengths in the two clouds differ by a factor, which the message gives, with the unit "
        "where it is that of one. [How it is told](certainty.md#mirrored-and-scaled-clouds).",
        (
            "Bring both clouds to metres: some programs write feet, centimetres or millimetres. "
            "`--unit mm` reads both in millimetres, `--unit-source mm` the source alone, and "
            "`--unit mm --unit-source m` the target alone; `cm` is there, too.",
            "Where the factor is near 1, one LiDAR's ranges may be corrected twice or not at all. "
            "Measure a known distance in both clouds.",
        ),
    ),
    "registration_failed": Explanation(
        "The scene could not be registered",
        "The registration of the scene did not end in a rigid transform.",
        (
            "Try `--no-refine`, which keeps to the poles. If that gives an answer, record a "
            "place with more surfaces that both see.",
        ),
    ),
    "refused": Explanation(
        "The result was refused",
        "`retropole export`, `evaluate` and `check` were given a result that was refused and gives "
        "no reason. Where it gives one, its code is shown instead.",
        ("Calibrate until there is a transform; the result's own `reasons` say what is missing.",),
    ),
}
