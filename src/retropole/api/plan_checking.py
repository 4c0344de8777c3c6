"""A stored plan against the poles as set up: which is out of place, and what that cost."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..base.errors import UsageError, printable
from ..base.quantities import counted, error
from ..base.uncertainty import predicted_error
from ..planning.comparison import against_plan
from ..result import PLAN_FILE, PoleDoc, pole_documents
from ..result.decoding import decode_plan
from ..result.pole_plan import PolePlanDoc
from .result import CalibrationResult
from .stored import loaded

COSTLY = 1.25
"""An error this many times the planned one is not as planned: noise alone changes it by less."""


def load_plan(path: Path, lidars: Sequence[str] = (), *, of_pair: bool = False) -> PolePlanDoc:
    """Read ``plan.json``, or that of a folder.

    Parameters
    ----------
    path
        Of the file or the folder.
    lidars
        Names of LiDARs that the plan must have.
    of_pair
        Whether it must be of two LiDARs.

    Raises
    ------
    ReadError
        If there is none, or it is not a plan; names the file and the field.
    UsageError
        If it is of other LiDARs.
    """
    file = path / PLAN_FILE if path.is_dir() else path
    plan = loaded(file, decode_plan)
    names = [each.name for each in plan.lidars]
    if of_pair and len(names) != 2:
        raise UsageError(
            f"{file} is a plan of {len(names)} LiDARs ({printable(', '.join(names))}), a plan of "
            "the two LiDARs that are calibrated is needed"
        )
    for name in lidars:
        if name not in names:
            raise UsageError(
                f"the plan has no LiDAR {printable(name)!r}, it has {printable(', '.join(names))}"
            )
    return plan


def against(plan: PolePlanDoc, poles: Sequence[PoleDoc], lidar: str | None = None) -> list[str]:
    """Report which of the poles that one LiDAR of the plan sees is out of place."""
    compared = against_plan(plan, poles, lidar)
    several = len(plan.placements) > 1
    where = f" in placement {compared.placement + 1}" if several else ""
    lines = [f"as seen by {compared.lidar}{where}:", *(each.text for each in compared.deviations)]
    if compared.others:
        lines.append(f"{counted(compared.others, 'pole')} more than planned")
    return lines


def cost_of(plan: PolePlanDoc, result: CalibrationResult) -> list[str]:
    """Compare the poles of a calibration with the plan, and state what that cost.

    Parameters
    ----------
    plan
        Of the same two LiDARs, in the same order.
    result
        Of a run; each of its placements is compared with that of the plan which it fits best.
    """
    lines = []
    placements = result.placements or ()
    for placement in placements:
        for scan, station in zip(placement.scans, plan.lidars, strict=False):
            compared = against_plan(plan, pole_documents(scan.poles), station.name)
            where = f"placement {compared.placement + 1}, " if len(plan.placements) > 1 else ""
            lines += [f"{where}{station.name}: {each.text}" for each in compared.deviations]
    if len(placements) != len(plan.placements):
        recorded = counted(len(placements), "placement")
        lines.append(f"{recorded} recorded, {len(plan.placements)} planned")
    covariance = result.covariance
    if covariance is not None:
        at = plan.range_m
        stated, planned = predicted_error(covariance, (at,))[0].sigma_m, planned_error(plan)
        ratio = stated / planned
        ratio_text = "as planned" if ratio < COSTLY else f"{ratio:.1f} times as much as planned"
        by = " by its page, since poles were moved" if plan.moved is not None else ""
        lines.append(
            f"error at {at:g} m: {error(stated)}, planned{by} {error(planned)}: {ratio_text}"
        )
    return lines


def planned_error(plan: PolePlanDoc) -> float:
    """Largest 1 σ of all LiDARs at the plan's range, metres."""
    if plan.moved is not None:
        return max(each.sigma_m for each in plan.moved.errors)
    at = (plan.range_m,)
    return max(predicted_error(each.covariance, at)[0].sigma_m for each in plan.predicted)
