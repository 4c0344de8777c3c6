"""Why a LiDAR has no pose in a map: messages about maps instead of poles."""

from __future__ import annotations

from collections.abc import Mapping
from math import degrees

from ..base.errors import Refusal
from ..base.quantities import counted
from ..hypotheses.by_place import MAX_CONTRADICTED
from ..hypotheses.evidence import MIN_TOTAL

MORE_OF_MAP = (
    "use a larger part of the map or a map with more objects, record where the LiDAR sees more "
    "of the map, or compare with surveyed points"
)
"""Advice if little in a map determines a direction."""

DIFFERS = {"scene_contradicts", "too_few_poles", "poles_scene_contradict"}
"""Refusals of poses in a map that the recording contradicts."""


def of_map(refusal: Refusal) -> Refusal:
    """Reword a refusal for a target that is a map."""
    values = refusal.values
    place = "give a heading (--prior-rpy-deg) or a better position (--prior-xyz, --prior-sigma-m)"
    if "lead" in values and _hardly_contradicted(values):
        return Refusal(
            "ambiguous",
            "shifted or rotated, the cloud fits the map nearly as well: the pose is better by "
            f"{values['lead']:.1f} σ only, chance of a wrong one "
            f"{100 * float(values['probability_wrong']):.0f} %: {place}, or {MORE_OF_MAP}",
            values,
        )
    if refusal.code in DIFFERS:
        found = "hardly any of its surfaces coincide with the map"
        if "agreeing" in values:
            agreeing, against = int(values["agreeing"]), int(values["contradicting"])
            found = (
                f"of the patches above the ground {counted(agreeing, 'agrees', 'agree')}, and "
                f"the LiDAR measured through {against:,} of the map that are too high to have "
                "driven off"
            )
        return Refusal(
            "map_differs",
            f"the map does not show what the LiDAR sees: {found}; has the place changed since, or "
            "is this a map of another place? Use a newer map, or another position (--prior-xyz)",
            values,
        )
    if refusal.code == "degenerate_poles":
        sizes = ""
        if "rotation_sigma_rad" in values:
            rotation, translation = (
                float(values[name]) for name in ("rotation_sigma_rad", "translation_sigma_m")
            )
            sizes = (
                f": they determine the pose to {degrees(rotation):.2f}° and {translation:.2f} m "
                "(1 σ)"
            )
        return Refusal(
            "map_leaves_open",
            f"the surfaces of the map that the LiDAR sees do not determine its whole pose{sizes}; "
            "use a map with more of the surroundings, or set up poles that two LiDARs see",
            values,
        )
    if refusal.code in ("ambiguous", "no_overlap"):
        said = refusal.message.rpartition(": ")[0] or refusal.message
        return Refusal(refusal.code, f"{said}: {place}", values)
    return refusal


def _hardly_contradicted(values: Mapping[str, float | int | str]) -> bool:
    """Whether enough was counted, and the contradictions to a pose are within the limit."""
    against = int(values["contradicting"]) + int(values["missing"])
    total = int(values["agreeing"]) + against
    return total >= MIN_TOTAL and against <= MAX_CONTRADICTED * total
