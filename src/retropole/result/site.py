"""The result document of a site: every LiDAR's pose in one frame, and what was checked, as JSON.

Schema ``retropole/site-result/1``: metres and radians, matrices row by row. LiDARs, placements and
poles are told by their index in the lists of the document. What is no number is null, and so is
every pose where the run was refused.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from ..base.bounded import LONGEST_LIST, Count, Size, Status, Text
from ..base.datatypes import Array
from ..base.uncertainty.purpose import Need
from ..base.version import __version__
from ..site.answer import MOST_LIDARS, Indices, SiteCalibration, SitePole, WithoutPlacement
from ..site.description import ControlPoint, Frame, SurveyedPole
from . import COVARIANCE_ORDER, Document, ReasonDoc, reason_document
from .detected import InputDoc
from .site_checks import LoopDoc, PairDoc, TestDoc, check_document
from .site_parts import (
    FoundDoc,
    LidarDoc,
    RecordingDoc,
    SiteConfig,
    found_document,
    lidar_document,
    recording_document,
)

__all__ = [
    "SITE_COVARIANCE_FRAME",
    "SITE_SCHEMA",
    "SiteConfig",
    "SiteDoc",
    "joint_order",
    "site_document",
]

SITE_SCHEMA: Literal["retropole/site-result/1"] = "retropole/site-result/1"
SITE_COVARIANCE_FRAME = "site axes: R_true = Exp(phi) R, t_true = t + delta; rad and m"


class SiteDoc(Document, frozen=True, eq=False, kw_only=True):
    """The whole document.

    `joint_covariance` is that of all poses together: 6 rows for each, in the order of
    `lidars`, named by `joint_order`, in the `covariance_frame`.
    """

    schema: Literal["retropole/site-result/1"] = SITE_SCHEMA
    name: Text
    status: Status
    reasons: list[ReasonDoc]
    datum: Text
    frame: Frame
    reference: Count
    placements: Annotated[list[Text], Meta(min_length=1, max_length=LONGEST_LIST)]
    radius_m: Size
    radius_sigma_m: Size
    need: Need | None
    lidars: Annotated[list[LidarDoc], Meta(min_length=1, max_length=MOST_LIDARS)]
    covariance_order: tuple[str, ...] = COVARIANCE_ORDER
    covariance_frame: str = SITE_COVARIANCE_FRAME
    joint_order: list[Text]
    joint_covariance: Array | None
    groups: list[Indices]
    poles: Annotated[list[SitePole], Meta(max_length=LONGEST_LIST)]
    pairs: Annotated[list[PairDoc], Meta(max_length=LONGEST_LIST)]
    loops: Annotated[list[LoopDoc], Meta(max_length=LONGEST_LIST)]
    tests: Annotated[list[TestDoc], Meta(max_length=LONGEST_LIST)]
    without: Annotated[list[WithoutPlacement], Meta(max_length=LONGEST_LIST)]
    found: list[list[FoundDoc | None]]
    surveyed_poles: list[SurveyedPole]
    control_points: list[ControlPoint]
    inputs: Annotated[list[RecordingDoc], Meta(max_length=LONGEST_LIST)]
    config: SiteConfig
    version: Text
    created: Text
    seconds: dict[Text, Size]


def joint_order(names: Sequence[str]) -> list[str]:
    """Name the rows of the joint covariance: ``mast-a.phi_x`` to ``mast-b.delta_z``."""
    return [f"{name}.{state}" for name in names for state in COVARIANCE_ORDER]


def site_document(
    calibration: SiteCalibration,
    *,
    inputs: Mapping[tuple[int, int], InputDoc],
    config: SiteConfig,
    seconds: Mapping[str, float],
) -> SiteDoc:
    """Write a site's calibration as its result document.

    Parameters
    ----------
    calibration
        The answer, or the refusal.
    inputs
        What was read, by the indices of the LiDAR and of the placement.
    config
        How it was read.
    seconds
        Time of each step, reading included.

    Raises
    ------
    ValueError
        Where a pose or a covariance of an answer is not finite.
    """
    site = calibration.site
    answered = calibration.status != "refused"
    names = [lidar.name for lidar in site.lidars]
    poses = calibration.lidars if answered else (None,) * len(names)
    joint = calibration.covariance if answered else None
    if joint is not None and not np.isfinite(joint).all():
        raise ValueError("joint covariance: a number of the answer is not finite")
    scans = calibration.scans
    return SiteDoc(
        name=site.name,
        status=calibration.status,
        reasons=[reason_document(reason) for reason in calibration.reasons],
        datum=calibration.datum,
        frame=site.frame,
        reference=site.reference,
        placements=list(site.placements),
        radius_m=site.radius,
        radius_sigma_m=site.radius_sigma,
        need=site.need,
        lidars=[lidar_document(*each) for each in zip(site.lidars, poses, strict=True)],
        joint_order=joint_order(names),
        joint_covariance=joint,
        groups=list(calibration.groups),
        poles=list(calibration.poles),
        pairs=[check_document(PairDoc, pair) for pair in calibration.pairs],
        loops=[check_document(LoopDoc, loop) for loop in calibration.loops],
        tests=[check_document(TestDoc, test) for test in calibration.tests],
        without=list(calibration.without),
        found=[[found_document(scan) for scan in of_lidar] for of_lidar in scans],
        surveyed_poles=list(site.poles),
        control_points=list(site.points),
        inputs=[
            recording_document(source, lidar, placement, scans)
            for (lidar, placement), source in sorted(inputs.items())
        ],
        config=config,
        version=__version__,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        seconds={name: round(value, 4) for name, value in seconds.items()},
    )
