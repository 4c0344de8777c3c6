"""What the calibration of a site answers: poses, their joint covariance, and what was checked.

Poses map a LiDAR's points into the frame of the site.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import msgspec
from msgspec import Meta

from ..base.bounded import Count, Direction, PartCovariance, Pose, Size, Status, Text, Vector
from ..base.carried import SiteWalk
from ..base.datatypes import Array, Scan, Test
from ..base.description import Site
from ..base.errors import Reason
from ..base.uncertainty import BudgetEntry, ErrorAtRange
from ..base.uncertainty.purpose import Fitness

MOST_LIDARS = 100
"""Of one document: its joint covariance has then 360,000 numbers."""

Indices = Annotated[tuple[Count, ...], Meta(max_length=MOST_LIDARS)]


@dataclass(frozen=True, eq=False)
class LidarPose:
    """Where one LiDAR of the site is.

    Attributes
    ----------
    lidar
        Its index in `Site.lidars`.
    T_site_lidar
        (4, 4) maps its points into the frame of the site (less `Frame.offset`).
    covariance
        (6, 6) over ``[φ, δ]``, rad and m, axes of the site: ``R_true = Exp(φ) R``, ``t_true = t +
        δ``; zero for the LiDAR whose frame is the site's.
    budget
        Every source of error of this pose, the largest first; its name says whose it is.
    predicted_error
        At several ranges.
    fitness
        Whether it is as accurate as was requested.
    """

    lidar: int
    T_site_lidar: Pose
    covariance: PartCovariance
    budget: tuple[BudgetEntry, ...]
    predicted_error: tuple[ErrorAtRange, ...]
    fitness: Fitness | None = None


class SitePole(
    msgspec.Struct,
    frozen=True,
    eq=False,
    rename={
        "point": "point_m",
        "length": "length_m",
        "sigma": "sigma_m",
        "direction_sigma": "direction_sigma_rad",
    },
):
    """A pole of one placement, as all LiDARs that saw it have it together.

    Attributes
    ----------
    name
        ``pole 2 of placement 1``, or its surveyed name.
    placement
        Index of the placement.
    point, direction
        (3,) a point on its axis and the unit direction, in the frame of the site.
    length
        Of its taped part as far as it was seen, metres; `point` is its middle.
    seen_by
        Indices of the LiDARs.
    surveyed
        Index in `Site.poles`; None if it was not surveyed.
    sigma, direction_sigma
        1 σ of the axis across itself at `point`, metres, and of its direction, rad, where they are
        largest; None in documents of earlier versions.
    """

    name: Text
    placement: Count
    point: Vector
    direction: Direction
    length: Size
    seen_by: Indices
    surveyed: Count | None = None
    sigma: Size | None = None
    direction_sigma: Size | None = None


@dataclass(frozen=True, eq=False)
class PairCheck:
    """Two LiDARs of the site, and how well they agree.

    Attributes
    ----------
    lidars
        Their indices, the lower first.
    shared_poles
        How many poles of all placements both see.
    standing
        How many hypotheses the data of the pair alone do not rule out: 0 if there is none and
        the pair is linked through others; 1 if it decides by itself.
    patches
        How many pairs of surface patches the adjustment took from them; 0 if none.
    w
        Largest normalised residual (Baarda's w) of what the two share; None if nothing is
        tested.
    refusal
        Why the pair alone has no answer; None if it has.
    """

    lidars: tuple[int, int]
    shared_poles: int
    standing: int
    patches: int
    w: float | None
    refusal: Reason | None = None


@dataclass(frozen=True, eq=False)
class LoopClosure:
    """LiDARs around a loop: their pairwise poses must compose to the identity.

    Attributes
    ----------
    lidars
        Indices, around the loop.
    rotation, translation
        Of the composed pose, rad and m.
    chi2, freedom, probability
        Its squared size in units of its covariance, and the probability of as much or more.
    """

    lidars: tuple[int, ...]
    rotation: float
    translation: float
    chi2: float
    freedom: int
    probability: float


class WithoutPlacement(
    msgspec.Struct,
    frozen=True,
    rename={"rotation": "rotation_rad", "translation": "translation_m"},
):
    """How the poses change without one placement.

    Attributes
    ----------
    placement
        Its index.
    rotation, translation
        Largest change of a pose relative to the reference, rad and m; None if the others give
        none.
    lidar
        Index of the LiDAR that changes so.
    """

    placement: Count
    rotation: Size | None
    translation: Size | None
    lidar: Count | None


@dataclass(frozen=True, eq=False)
class SiteCalibration:
    """The answer of `pipeline.calibrate_site`, or why there is none.

    Attributes
    ----------
    status, reasons
        ``ok``, ``warn`` or ``refused``; and what is wrong or doubtful, empty when ok.
    site
        What it started from.
    datum
        What fixes the frame, in words.
    scans
        For each LiDAR, what was found in each placement, in the frame of its clouds; None if it
        recorded none.
    lidars
        Poses of all LiDARs, in the order of `Site.lidars`; empty when refused.
    covariance
        (6 L, 6 L) of all poses together, in that order; None when refused.
    groups
        Indices of the LiDARs that are linked with each other; one group where all are.
    poles, pairs, loops, tests, without
        Poles in the frame of the site; what was checked.
    seconds
        Time of each step.
    notes
        What to know of an answer that makes it no less true.
    walk
        Of a pole that was carried: the walk, and the clocks of all LiDARs; else None.
    """

    status: Status
    reasons: tuple[Reason, ...]
    site: Site
    scans: tuple[tuple[Scan | None, ...], ...]
    seconds: Mapping[str, float]
    datum: str = ""
    lidars: tuple[LidarPose, ...] = ()
    covariance: Array | None = None
    groups: tuple[tuple[int, ...], ...] = ()
    poles: tuple[SitePole, ...] = ()
    pairs: tuple[PairCheck, ...] = ()
    loops: tuple[LoopClosure, ...] = ()
    tests: tuple[Test, ...] = ()
    without: tuple[WithoutPlacement, ...] = ()
    notes: tuple[Reason, ...] = ()
    walk: SiteWalk | None = None
