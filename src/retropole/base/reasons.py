"""Every reason code: what it means, and what to do about it.

The texts are in ``reasons.toml``, one table for each place where codes are given. The report, the
command line and the page *Every reason code* of the documentation take their words from there.
`Code` is the type of all codes, so that mypy finds one that is in no table: a new code is added to
both.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cache
from typing import Any, Literal, cast

import msgspec

Code = Literal[
    # refused
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
    "map_differs",
    "map_leaves_open",
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
    # warning
    "not_confirmed",
    "without_poles",
    "sensor_doubtful",
    "nominal_angles",
    "pole_left_out",
    "not_converged",
    "small_margin",
    "chosen_by_hand",
    "noisy_poles",
    "poles_and_scene_disagree",
    "radius_differs",
    "several_minima",
    "not_fit_for_purpose",
    # note
    "by_place",
    "other_times",
    "doubtful_poles",
    "nearly_parallel_poles",
    "few_points",
    "few_rings",
    "weak_direction",
    "offset_not_separable",
    "one_place_decides",
    "sways",
    # plan
    "no_ground",
    "nowhere_seen",
    "not_linked",
    "pose_contradicted",
    # carried
    "no_times",
    "no_walk",
    "two_walks",
    "no_common_walk",
    "too_little_walk",
    "several_walks_fit",
    "walk_does_not_fit",
    "clock_jumps",
    # level
    "too_little_ground",
    "two_grounds",
    # check
    "recordings_of_result",
    "carrier_moved",
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
    # site
    "too_few_lidars",
    "disconnected",
    "ambiguous_loop",
    "recordings_exchanged",
    "lidar_moved",
    "survey_unmatched",
    "survey_ambiguous",
    "survey_contradicts",
    "survey_too_weak",
    "site_inconsistent",
    "pole_moved",
    "survey_unmet",
    "survey_outlier",
    "recording_left_out",
    "recording_unusable",
    "misfit",
    "loop_open",
    "not_checked",
    # field_test
    "too_few_distances",
    # other_methods
    "unmatched",
    "no_scene",
    # cluster
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

Prefix = Literal["stored", "poles"]
"""Prefixes of a code of the stored result, and of the new recordings' poles."""


class Explanation(msgspec.Struct, frozen=True):
    """What a code means, and what to do about it; help and advice are Markdown.

    Attributes
    ----------
    title
        A few plain words.
    help
        What it means, with the limit in numbers.
    advice
        What to do, one action each; empty if there is nothing to do.
    """

    title: str
    help: str
    advice: tuple[str, ...] = ()


class Group(msgspec.Struct, frozen=True):
    """The codes of one place where they occur, with the words that introduce them."""

    title: str
    introduction: str
    reasons: Mapping[str, Explanation]


class Tables(msgspec.Struct, frozen=True):
    """All of ``reasons.toml``.

    Attributes
    ----------
    groups, prefixes
        Codes by where they occur, and their possible prefixes.
    remedies
        What makes each source of error smaller, by its name in the error budget: those that are no
        matter of a single LiDAR.
    of_a_lidar
        What makes all others smaller.
    """

    groups: Mapping[str, Group]
    prefixes: Mapping[Prefix, Explanation]
    remedies: Mapping[str, str]
    of_a_lidar: str


@cache
def tables() -> Tables:
    """Read the texts, when they are first requested; line breaks in them are spaces."""
    from importlib.resources import files

    text = files("retropole.base").joinpath("reasons.toml").read_bytes()
    return msgspec.convert(_joined(msgspec.toml.decode(text)), Tables)


def _joined(given: Any) -> Any:
    if isinstance(given, dict):
        return {key: _joined(value) for key, value in given.items()}
    return " ".join(given.split()) if isinstance(given, str) else [_joined(each) for each in given]


@cache
def reasons() -> Mapping[str, Explanation]:
    """Every code with its explanation."""
    return {
        code: text for group in tables().groups.values() for code, text in group.reasons.items()
    }


def is_note(code: str) -> bool:
    """Whether a code is something to know of an answer, and no reason to doubt it."""
    return code in tables().groups["note"].reasons


def explain(code: str) -> Explanation | None:
    """Look a code up, with or without a prefix; None if it is not known."""
    if code in reasons():
        return reasons()[code]
    prefixes = tables().prefixes.items()
    return next((text for prefix, text in prefixes if code.startswith(f"{prefix}_")), None)


def page(code: str) -> str | None:
    """Name the page of the documentation that explains a code; None if it is not known."""
    known = explain(code)
    if known is None:
        return None
    anchor = code if code in reasons() else f"{code.partition('_')[0]}_"
    return f"docs/reasons.md#{anchor}"


def prefixed(prefix: Prefix, code: str) -> Code:
    """Add a prefix to a code: ``prefixed("stored", "few_points")``."""
    return cast("Code", f"{prefix}_{code}")


def remedy(source: str, unknown_lidar: str | None = None) -> str:
    """Advise how to reduce a source of error; nothing helps against unmodelled errors.

    Parameters
    ----------
    source
        Its name in the error budget.
    unknown_lidar
        ``target`` or ``source``, where it is an error of a LiDAR whose sensor is not known.
    """
    if unknown_lidar is not None and source not in tables().remedies:
        return (
            f"name the sensor of the {unknown_lidar} (--sensor), so that the figures of that "
            "model are used"
        )
    return tables().remedies.get(source, tables().of_a_lidar)


MARKDOWN_LINK = re.compile(r"\[([^\]]*)\]\([^)]*\)")
MARKDOWN_LINK_SENTENCE = re.compile(rf"(?:^|(?<=[.!?]))\s*{MARKDOWN_LINK.pattern}\.")


def unlinked(markdown: str) -> str:
    """Remove the links from help or advice: a page or terminal is read away from the documentation.

    A link becomes its words; a sentence that is nothing but a link goes.
    """
    return MARKDOWN_LINK.sub(r"\1", MARKDOWN_LINK_SENTENCE.sub("", markdown)).strip()


def plain(markdown: str) -> str:
    """Remove links, emphasis and code marks from help or advice, for a terminal."""
    return re.sub(r"[`*]", "", unlinked(markdown))
