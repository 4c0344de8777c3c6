"""Why a LiDAR has no pose in a map, in words of a map and not of poles."""

from __future__ import annotations

from collections.abc import Mapping

from ..base.errors import Refusal
from ..base.quantities import counted
from ..hypotheses.by_place import MAX_CONTRADICTED
from ..hypotheses.evidence import MIN_TOTAL

MORE_OF_MAP = (
    "take a larger part of the map or one with more in it, record where the LiDAR sees more of it, "
    "or compare with surveyed points"
)
"""What helps where a map leaves a direction to little."""

DIFFERS = {"scene_contradicts", "too_few_poles", "poles_scene_contradict"}
"""Refusals of poses in a map that what the LiDAR sees speaks against."""


def of_map(refusal: Refusal) -> Refusal:
    """Say of a refusal what it means where the target is a map."""
    values = refusal.values
    place = "give a heading (--prior-rpy-deg) or a better place (--prior-xyz, --prior-sigma-m)"
    if "lead" in values and _hardly_contradicted(values):
        return Refusal(
            "ambiguous",
            "shifted or turned, what the LiDAR sees fits the map nearly as well: the pose leads by "
            f"{values['lead']:.1f} σ only, chance of a wrong one "
            f"{100 * float(values['probability_wrong']):.0f} %: {place}, or {MORE_OF_MAP}",
            values,
        )
    if refusal.code in DIFFERS:
        found = "hardly anything of it lies on the map"
        if "agreeing" in values:
            agreeing, against = int(values["agreeing"]), int(values["contradicting"])
            found = (
                f"of the patches off the ground {counted(agreeing, 'agrees', 'agree')}, and the "
                f"LiDAR looked through {against:,} of the map that are too high to have driven off"
            )
        return Refusal(
            "map_differs",
            f"the map does not show what the LiDAR sees: {found}; has the place changed since, or "
            "is the map of another one? Take a newer map, or another place (--prior-xyz)",
            values,
        )
    if refusal.code == "degenerate_poles":
        sizes = ""
        if "rotation_sigma_rad" in values:
            sizes = refusal.message.partition("hold the pose to ")[2].partition(";")[0]
            sizes = f": they hold the pose to {sizes}"
        return Refusal(
            "map_leaves_open",
            f"the surfaces of the map that the LiDAR sees leave a part of its pose open{sizes}; "
            "take a map that has more of what is around, or set up poles that two LiDARs see",
            values,
        )
    if refusal.code in ("ambiguous", "no_overlap"):
        said = refusal.message.rpartition(": ")[0] or refusal.message
        return Refusal(refusal.code, f"{said}: {place}", values)
    return refusal


def _hardly_contradicted(values: Mapping[str, float | int | str]) -> bool:
    """Whether enough was counted, and no more speaks against a pose than may."""
    against = int(values["contradicting"]) + int(values["missing"])
    total = int(values["agreeing"]) + against
    return total >= MIN_TOTAL and against <= MAX_CONTRADICTED * total
