"""Reasons of ``retropole site calibrate``: why a site has no answer, or what to know of it."""

from __future__ import annotations

from typing import Literal

from .explanation import Explanation

SiteCode = Literal[
    "too_few_lidars",
    "disconnected",
    "ambiguous_loop",
    "recordings_exchanged",
    "lidar_moved",
    "survey_unmatched",
    "survey_ambiguous",
    "survey_too_weak",
    "site_inconsistent",
    "pole_moved",
    "survey_outlier",
    "recording_left_out",
    "recording_unusable",
    "misfit",
    "loop_open",
    "not_checked",
]

SITE: dict[SiteCode, Explanation] = {
    "too_few_lidars": Explanation(
        "Fewer than two LiDARs have poles",
        "A site needs two LiDARs whose recordings show poles.",
        ("Check tape, radius and threshold with `retropole detect` on the recordings named.",),
    ),
    "disconnected": Explanation(
        "Some LiDARs are linked to no other",
        "Two LiDARs are linked where both see the same two poles in one placement; all must be "
        "linked, directly or through others. The groups that are linked are named.",
        (
            "Add a placement with two poles that LiDARs of both groups see.",
            "Or make two site files, one for each group.",
        ),
    ),
    "ambiguous_loop": Explanation(
        "Several arrangements of the LiDARs fit as well",
        "Neither the scene nor the loops of the site decide which poles are which for the LiDARs "
        "named: turned poles fit all recordings as well.",
        (
            "Lean the poles so that no half turn lays them on each other: by different angles, to "
            "different sides.",
            "Add a third pole, or a placement, that the LiDARs named see with another one.",
        ),
    ),
    "recordings_exchanged": Explanation(
        "Two recordings are exchanged",
        "The two recordings named fit all others in each other's place.",
        ("Exchange them in the site file, and calibrate again.",),
    ),
    "lidar_moved": Explanation(
        "The recordings of a LiDAR do not show one place",
        "A LiDAR stands still in all placements, so that its recordings overlap by half as they "
        "are.",
        (
            "Check whether it was moved between the placements, or the file is another LiDAR's.",
            "A LiDAR that was moved is another one: give it another name from then on.",
        ),
    ),
    "survey_unmatched": Explanation(
        "The survey does not fit what the LiDARs see",
        "No way of laying the surveyed poles and control points on those that the LiDARs see was "
        "found.",
        (
            "Check the placement of each surveyed pole, the unit, and the order of coordinates "
            "(east, north, up).",
            "Survey both ends of two poles of one placement, or three control points not in line.",
        ),
    ),
    "survey_ambiguous": Explanation(
        "The survey fits in several ways",
        "Surveyed poles that a half turn lays on each other do not tell which is which.",
        ("Survey a third pole, or a control point.",),
    ),
    "survey_too_weak": Explanation(
        "The survey does not fix the frame",
        "Under the survey alone the site may still turn or shift by more than 0.1 rad or 0.5 m.",
        ("Survey both ends of a second pole, or more control points.",),
    ),
    "site_inconsistent": Explanation(
        "The recordings contradict each other",
        "Without the observation that fits worst, the others still do not fit; or several may be "
        "the wrong one, and nothing tells which: they are named.",
        (
            "Look at the tests in the report, the largest w first.",
            "Record the placements named again.",
        ),
    ),
    "pole_moved": Explanation(
        "A pole did not stand still",
        "The pole named stands elsewhere for some LiDARs than for the others, and was left out: it "
        "does not fit the other poles, or the surroundings coincide without it and not with it.",
        (
            "Nothing to do where enough poles are left: the answer does not use it.",
            "Else record the placement again, all LiDARs while the poles stand.",
        ),
    ),
    "survey_outlier": Explanation(
        "A surveyed point does not fit",
        "The surveyed end of a pole or control point named contradicts the others by more than "
        "their uncertainty allows, and was left out.",
        ("Check its coordinates, and survey it again.",),
    ),
    "recording_left_out": Explanation(
        "A recording does not fit the others of its placement",
        "Its poles were left out; its surroundings were used.",
        ("Check whether the poles were moved before it, or it belongs to another placement.",),
    ),
    "recording_unusable": Explanation(
        "A recording cannot be used",
        "The message says why. The others were used.",
        ("See the reason named in the message.",),
    ),
    "misfit": Explanation(
        "An observation fits poorly",
        "The observation named fits the others worse than healthy sites do, but not so badly that "
        "it was left out.",
        (
            "Look at the tests in the report.",
            "Add a placement: with more that checks it, it shows what is wrong.",
        ),
    ),
    "loop_open": Explanation(
        "A loop does not close",
        "The poses of the pairs around a loop do not compose to the identity within their "
        "uncertainty (less than once in 100,000 by chance).",
        ("Look at the tests of what its pairs share; record again what fits worst.",),
    ),
    "not_checked": Explanation(
        "Nothing checks a LiDAR",
        "The pose of the LiDAR named rests on observations that no other one checks: a blunder "
        "there would not show.",
        ("Add a pole, a placement, or a LiDAR that sees the same poles.",),
    ),
}
