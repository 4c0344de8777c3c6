"""Whether target and source were given the other way round: the stored pose reversed then fits.

A swap looks like a movement by metres or by half a turn. No movement ends by chance where the pose
reversed is.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..base import se3
from ..base.datatypes import Array, Placement
from ..base.errors import Reason, Refusal
from ..base.sensors import Sensor
from ..base.uncertainty.confirmation import Confirmation
from ..extraction.sensor_pattern import check_sensor
from ..hypotheses.evidence import MAX_CONFLICTING, MIN_TOTAL, count, is_in_conflict
from ..surfaces.consistency import Standing

NEAR_ROTATION, NEAR_TRANSLATION = float(np.radians(2.0)), 0.2
"""A pose that was found is the stored one reversed where it is so near to it, rad and m. Twice the
range over which `drift` searches about the stored pose."""

MORE = 3.0
"""So many times more voxels agree with the stored pose reversed than with the stored one. In six
simulated scenes, swapped, it was 10 and more."""

APART = 3.0
"""The stored pose and its reverse must be so many times farther apart. Where they are not, as of
two LiDARs back to back at one height, either order gives the same answer."""


def swapped_sensors(
    placement: Placement, sensors: tuple[Sensor | None, Sensor | None]
) -> Reason | None:
    """Say that each cloud is of the other's sensor; None where it is not so."""
    if sensors[0] is None or sensors[1] is None:
        return None
    try:
        check_sensor(placement.target.cloud, sensors[1])
        check_sensor(placement.source.cloud, sensors[0])
    except Refusal:
        return None
    return swap(
        f"TARGET's rings are not those of the {sensors[0].name} that the result's target is, or "
        f"SOURCE's not those of the {sensors[1].name}, and the other way round they fit",
        {"told_by": "sensors"},
    )


def swapped_clouds(
    T_stored: Array,
    T_found: Array | None,
    scenes: Sequence[tuple[Standing, Standing]],
    found: Confirmation,
) -> Reason | None:
    """Say that the stored pose reversed fits where the stored pose does not; None if it is not so.

    Parameters
    ----------
    T_stored, T_found
        (4, 4) the stored pose and the one that poles gave, target from source; None where none did.
    scenes
        What stands in the target's and in the source's scene.
    found
        What that says of the stored pose.
    """
    reverse = se3.inverse(T_stored)
    rotation, translation = _apart(T_stored, reverse)
    if rotation < APART * NEAR_ROTATION and translation < APART * NEAR_TRANSLATION:
        return None
    there = count(scenes, reverse)
    agrees = (
        there.total >= MIN_TOTAL
        and not is_in_conflict(there)
        and found.contradicted > MAX_CONFLICTING
        and there.agreeing >= MORE * found.agreeing
    )
    if T_found is not None:
        # Poles that give another pose say more than voxels that happen to agree.
        rotation, translation = _apart(T_found, reverse)
        agrees = rotation < NEAR_ROTATION and translation < NEAR_TRANSLATION
    if not agrees:
        return None
    return swap(
        f"under the stored pose reversed {there.agreeing} of {there.total} voxels off the ground "
        f"agree, under the stored pose {found.agreeing} of {found.total}",
        {
            "told_by": "scene",
            "agreeing": found.agreeing,
            "total": found.total,
            "agreeing_reversed": there.agreeing,
            "total_reversed": there.total,
        },
    )


def swap(why: str, values: dict[str, float | int | str]) -> Reason:
    """Say that target and source are swapped, and what to do."""
    return Reason(
        "swapped", f"TARGET and SOURCE are swapped: {why}; give them the other way round", values
    )


def _apart(T: Array, other: Array) -> tuple[float, float]:
    step = se3.local(T, other)
    return float(np.linalg.norm(step[:3])), float(np.linalg.norm(step[3:]))
