"""A stored plan against what stands: which pole is out of place, and what that cost."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from ..base.errors import UsageError
from ..base.quantities import counted, error
from ..base.uncertainty.purpose import DEFAULT_AT
from ..planning.comparison import against_plan
from ..result import PoleDoc, pole_documents
from ..result.decoding import parsed
from ..result.folder import PLAN_FILE
from ..result.pole_plan import PolePlanDoc
from .result import CalibrationResult
from .stored import loaded

COSTLY = 1.25
"""An error so many times the planned one is not as planned: noise alone changes it by less."""


def load_plan(path: Path) -> PolePlanDoc:
    """Read ``plan.json``, or that of a folder.

    Raises
    ------
    ReadError
        Where there is none, or it is no plan; names the file and the field.
    """
    file = path / PLAN_FILE if path.is_dir() else path
    return loaded(file, partial(parsed, kind=PolePlanDoc, what="plan"))


def against(plan: PolePlanDoc, poles: Sequence[PoleDoc], lidar: str | None = None) -> list[str]:
    """Say which of the poles that one LiDAR sees is out of place.

    Raises
    ------
    UsageError
        Where the plan has no LiDAR of that name.
    """
    names = [each.name for each in plan.lidars]
    if lidar is not None and lidar not in names:
        raise UsageError(f"the plan has no LiDAR {lidar!r}, it has {', '.join(names)}")
    stood = against_plan(plan, poles, lidar)
    several = len(plan.placements) > 1
    where = f" in placement {stood.placement + 1}" if several else ""
    lines = [f"as seen by {stood.lidar}{where}:", *(each.words for each in stood.deviations)]
    if stood.others:
        lines.append(f"{counted(stood.others, 'pole')} more than planned")
    return lines


def cost_of(plan: PolePlanDoc, result: CalibrationResult) -> list[str]:
    """Say where the poles of a calibration stood against the plan, and what that cost.

    Parameters
    ----------
    plan
        Of the same two LiDARs, in the same order.
    result
        Of a run; each of its placements is held against that of the plan which it fits best.
    """
    lines = []
    placements = result.placements or ()
    for placement in placements:
        for scan, station in zip(placement.scans, plan.lidars, strict=False):
            stood = against_plan(plan, pole_documents(scan.poles), station.name)
            where = f"placement {stood.placement + 1}, " if len(plan.placements) > 1 else ""
            lines += [f"{where}{station.name}: {each.words}" for each in stood.deviations]
    if len(placements) != len(plan.placements):
        recorded = counted(len(placements), "placement")
        lines.append(f"{recorded} recorded, {len(plan.placements)} planned")
    stated = {each.range_m: each.sigma_m for each in result.document.predicted_error or []}
    planned = {each.range_m: each.sigma_m for each in plan.predicted[0].predicted_error}
    at = DEFAULT_AT
    if at in stated and at in planned:
        ratio = stated[at] / planned[at]
        words = "as planned" if ratio < COSTLY else f"{ratio:.1f} times as much as planned"
        lines.append(
            f"error at {at:g} m: {error(stated[at])}, planned {error(planned[at])}: {words}"
        )
    return lines
