"""What makes an answer weak that is good enough to give."""

from __future__ import annotations

from typing import Literal

from .explanation import Explanation

WarningCode = Literal[
    "not_confirmed",
    "other_times",
    "sensor_doubtful",
    "pole_left_out",
    "not_converged",
    "small_margin",
    "chosen_by_hand",
    "doubtful_poles",
    "nearly_parallel_poles",
    "few_points",
    "few_rings",
    "noisy_poles",
    "weak_direction",
    "offset_not_separable",
    "poles_and_scene_disagree",
    "radius_differs",
    "several_minima",
    "one_place_decides",
    "not_fit_for_purpose",
]

WARNINGS: dict[WarningCode, Explanation] = {
    "not_confirmed": Explanation(
        "The scene does not confirm the answer",
        "Too little stands in view of both LiDARs to confirm what two poles say, or a part of it "
        "denies the pose. Two poles cannot vouch for themselves: had both been carried between the "
        "recordings, they would fit as well. "
        "[How it is told](certainty.md#what-stands-in-the-scene).",
        (
            "Add a third pole, or a second placement.",
            "Or stand boxes or a car where both LiDARs see them, and record again, both LiDARs at "
            "the same time.",
            "If you know that nobody touched the poles in between, `--trust-poles` says so; the "
            "result records it.",
        ),
    ),
    "other_times": Explanation(
        "The two LiDARs recorded at other times",
        "By their timestamps the two recordings of a placement lie more than a minute apart. Poles "
        "or a LiDAR that were moved in between look the same as another pose, and so do files of "
        "two days or two places. Only timestamps that are dates count: those of bags, of packet "
        "captures, and of points in Unix seconds; never the dates of files.",
        (
            "Check that the files belong together, and that nothing was moved in between.",
            "Where a clock is wrong and both recorded at the same time, use the answer.",
            "Better: record both LiDARs at the same time.",
        ),
    ),
    "sensor_doubtful": Explanation(
        "The cloud is hardly of the sensor you named",
        "The rings are those of another sensor than `--sensor-target` or `--sensor-source` names; "
        "or there are none, and more than 5 % of the points are above or below its field of view. "
        "What is known of another sensor makes the stated error wrong; so does a cloud that was "
        "turned or moved.",
        (
            "`retropole info FILE` names the sensors that fit the cloud. Leave the sensor at "
            "`auto` where none is known.",
            "Give the cloud in the LiDAR's own frame, as its driver writes it, or with its rings.",
        ),
    ),
    "pole_left_out": Explanation(
        "A pole was left out",
        "Of three or more poles one does not stand to the others as in the other recording. "
        "Without it they agree, so it was left out. The answer rests on the others.",
        (
            "If the pole was moved or bumped between the recordings, the answer is right without "
            "it; record again to have it count.",
            "If it is another object, a post or a bollard, cover it.",
        ),
    ),
    "not_converged": Explanation(
        "The solution still moved when the iterations ran out",
        "A least-squares step was still larger than its tolerance after the last iteration: of "
        "the poles, or of the refinement by the scene. The message says which, and after how many. "
        "In `retropole compare`, ICP or GICP refuses with this code: it needs a better start.",
        (
            "Compare with `--no-refine`, which keeps to the poles.",
            "Record more frames, or a place with more surfaces that both LiDARs see.",
        ),
    ),
    "small_margin": Explanation(
        "Another answer scores nearly as well",
        "The chosen hypothesis leads the next by less than 0.1.",
        (
            "Look at the hypotheses in the [report](report.md). If walls and ground coincide in "
            "one only, use the answer.",
            "If you know the place, the list of [the hypotheses that stand]"
            "(hypotheses.md#you-know-the-place) says which option decides between them.",
            "Better: a third pole.",
        ),
    ),
    "chosen_by_hand": Explanation(
        "A person chose the hypothesis",
        "`--hypothesis` took one of the ways of laying the poles on each other, and the scene did "
        "not. Everything else was checked as always, but the wrong one may fit as well: that is "
        "why the scene did not decide. [More](hypotheses.md#you-know-the-place).",
        (
            "Look at the clouds in the [report](report.md): what stands on one side only, a door "
            "or a car, must coincide. If roll, pitch, yaw and translation are roughly what you "
            "measure at the LiDARs, use the answer.",
            "Letters are those of the same recordings with the same options; of others they may "
            "mean something else.",
        ),
    ),
    "doubtful_poles": Explanation(
        "The answer rests on doubtful poles",
        "The sure poles gave no answer. Lines near a wall, beside something bright, with 3 to 5 "
        "returns or with dim tape were tried, and both LiDARs and the scene confirm them. "
        "[How](detection.md#doubtful-poles).",
        (
            "Look in the [report](report.md) whether the poles are yours.",
            "Better: move the poles free of walls, vests and signs by 0.6 m, about 5 m away, and "
            "record again.",
        ),
    ),
    "nearly_parallel_poles": Explanation(
        "The poles are nearly parallel",
        "The poles are less than 15° apart: height is weak.",
        ("Lean one more and record again. [What it costs](placing.md).",),
    ),
    "few_points": Explanation(
        "A pole has few returns",
        "One of the two best poles of a LiDAR has fewer than 12 returns from it.",
        ("Stand that pole nearer, about 5 m away, or record some seconds and give all frames.",),
    ),
    "few_rings": Explanation(
        "A pole is on few rings",
        "One of the two best poles of a LiDAR is met by 3 of its rings or fewer: its direction is "
        "weak.",
        ("Stand it nearer or more upright, or use a longer one, so that more rings cross it.",),
    ),
    "noisy_poles": Explanation(
        "The returns on the poles scatter more than they should",
        "Returns on the poles scatter along the beam by more than three times what the "
        "manufacturer states, or 3 cm where the sensor is not known.",
        (
            "Check `--radius` with a calliper, and that the poles stood still.",
            "Name the sensor if it was recognised wrongly: `--sensor-target`, `--sensor-source`.",
        ),
    ),
    "weak_direction": Explanation(
        "One direction of the pose is weak",
        "At the poles, the least certain direction has more than 5 cm, 1 σ. The message names it.",
        (
            "*height along the poles*: lean them more against each other.",
            "*sideways, from pole to pole*, *across the plane of the poles*: stand them nearer, or "
            "further apart.",
            "Any direction: add another placement, "
            "[`--placement`](placing.md#one-placement-is-weak-make-more).",
        ),
    ),
    "offset_not_separable": Explanation(
        "A range offset or the radius may be mistaken for the pose",
        "A range offset of the tape, or an error of the radius, would look the same as another "
        "pose.",
        (
            "Put poles on different sides of the LiDARs.",
            "Measure the radius with a calliper.",
        ),
    ),
    "poles_and_scene_disagree": Explanation(
        "The poles and the scene disagree",
        "The scene moves the pose further from the poles than their uncertainty allows.",
        (
            "If walls coincide and poles do not: a pole moved, or `--radius` is wrong.",
            "If poles coincide and walls do not: something large moved; `--no-refine` keeps to the "
            "poles.",
            "Clouds that another program has moved have lost their beam origin "
            "([accuracy](accuracy.md#what-the-figures-rest-on)).",
        ),
    ),
    "radius_differs": Explanation(
        "The radius is not the one you gave",
        "The data deny the given radius by more than 3 σ. Then the returns alone decide it, and "
        "the answer uses what they say. [Both are stated](certainty.md#the-radius).",
        (
            "Check `--radius` with a calliper: it is half the thickness, tape included, in metres. "
            "An estimate of half of what was given says that `--radius` was given a diameter.",
            "Where the calliper agrees with what was given, look at what was taken for a pole.",
        ),
    ),
    "several_minima": Explanation(
        "The scene fits at more than one pose",
        "Started from different poses within the uncertainty of the poles, the refinement by the "
        "scene ends at different poses. The best fit is given; the message says how far the others "
        "lie from it.",
        (
            "Look at the view of the report: walls and ground must coincide, far away too.",
            "Better poles leave one: stand them nearer, lean them more, or add a placement, "
            "[`--placement`](placing.md#one-placement-is-weak-make-more).",
            "Compare with `--no-refine`, which keeps to the poles.",
        ),
    ),
    "one_place_decides": Explanation(
        "One place decides a direction of the pose",
        "More than 30 % of what is known of the pose along one direction comes from one place of "
        "2 m, or of more where it is far away. If it moved, or is not the same to both LiDARs, "
        "nothing else denies it. The pose was sought again without it, and the stated uncertainty "
        "is that of the rest, with the distance between both answers. The view of the report "
        "marks the place.",
        (
            "Look at the marked place in the [report](report.md): it must be solid, at rest, and "
            "seen by both LiDARs.",
            "Better poles hold the direction themselves: stand them nearer, lean them more, or add "
            "a placement, [`--placement`](placing.md#one-placement-is-weak-make-more).",
        ),
    ),
    "not_fit_for_purpose": Explanation(
        "The answer is not shown to be accurate enough",
        "It is not 95 % sure that no point up to the distance of `--at-m` lands further from its "
        "true place than `--need-cm` says, or `at_m` and `within_cm` under `need` in a site file; "
        "without these, than 30 cm at 30 m. The message says how "
        "sure it is, what is 95 % sure instead, and what would help against the largest "
        "sources of error. "
        "[How it is computed](certainty.md#good-enough-for-what).",
        (
            "Do what the message says would help. "
            "[Every source of error, and what helps](certainty.md#the-error-budget).",
            "Where less is enough, say so: `--need-cm`, and `--at-m` for how far away it matters; "
            "under `need` in a [site file](site.md#the-site-file).",
        ),
    ),
}
