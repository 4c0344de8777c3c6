"""What a page is of: a site of LiDARs. A pair is a site of two, the first of which is the frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from ..adjustment.answer import WithoutPlacement
from ..base.datatypes import Placement, Scan
from ..base.description import Frame
from ..base.errors import UsageError, shortened
from ..base.quantities import counted
from ..base.uncertainty.confirmation import UNUSABLE
from ..hypotheses.choice import hypothesis_name
from ..result import ResultDoc, chance_wrong
from ..result.site import (
    FoundDoc,
    LidarDoc,
    SiteConfig,
    SiteDoc,
    found_document,
    recording_document,
)

__all__ = ["LIDARS", "Subject", "hypothesis_name", "input_names", "of_pair", "of_site"]

LIDARS = ("target", "source")
"""The two LiDARs of a pair, in their order."""

LONGEST_IN_SENTENCE = 40
"""Characters of the name of a recording in a sentence."""

COLOURS = 8
"""So many LiDARs have a colour of their own; more begin again. Each has its name beside it."""

SHARED = (
    *("status", "reasons", "notes", "covariance_order", "covariance_frame", "sways"),
    *("version", "created", "seconds"),
)
"""Fields that the documents of a pair and of a site have alike."""

STATED = ("covariance", "budget", "predicted_error", "fitness")
"""Fields of a pair that are those of its source in a site."""

NO_SITE: dict[str, Any] = {
    **{name: [] for name in ("joint_order", "groups", "poles", "pairs", "loops", "tests")},
    **{name: [] for name in ("surveyed_poles", "control_points")},
    **{"need": None, "joint_covariance": None},
    **{"datum": "", "reference": 0, "config": SiteConfig()},
}
"""What two LiDARs have nothing of."""

Scans = Sequence[Sequence[Scan | None]]


@dataclass(frozen=True, eq=False)
class Subject:
    """What a page is of.

    Attributes
    ----------
    site
        The document of a site; that of a pair in the same form.
    pair
        The document of a pair, for what only two LiDARs have; None of a site.
    scans
        What each LiDAR recorded of each placement; empty where the page shows no clouds.
    """

    site: SiteDoc
    pair: ResultDoc | None = None
    scans: Scans = ()

    @property
    def answered(self) -> bool:
        """Whether every LiDAR has a pose."""
        return all(each.T_site_lidar is not None for each in self.site.lidars)

    @property
    def chance_wrong(self) -> float | None:
        """How likely the answer is wrong where that is too likely for it to be used; else None."""
        if not self.answered:
            return None
        if self.pair is not None:
            found = self.pair.confirmation
            return found.probability_wrong if found is not None and found.is_unusable else None
        wrong = chance_wrong(self.site.reasons)
        return wrong if wrong > UNUSABLE else None

    @property
    def frame(self) -> str:
        """Whose frame the poses are in, as in *the frame of …*."""
        return "the site" if self.pair is None else "the target"

    def called(self, k: int) -> str:
        """Name the k-th LiDAR within a sentence."""
        return self.site.lidars[k].name if self.pair is None else f"the {LIDARS[k]}"

    def placement(self, j: int) -> str:
        """Name a placement by its number, from 1, and what it is called: ``2: noon``, or ``2``."""
        number, name = str(j + 1), self.site.placements[j]
        return number if name in ("", number) else f"{number}: {name}"

    @property
    def placements(self) -> list[str]:
        """Names of all placements."""
        return [self.placement(j) for j in range(len(self.site.placements))]

    def pole(self, lidar: int, k: int) -> str:
        """Name the k-th pole that a LiDAR sees in a placement: ``S1`` of a pair, or its number."""
        return f"pole {k + 1}" if self.pair is None else pole_name(LIDARS[lidar], k)

    @property
    def size(self) -> str:
        """How many LiDARs and placements there are."""
        placements = counted(len(self.site.placements), "placement")
        return f"{counted(len(self.site.lidars), 'LiDAR')}, {placements}"


def of_site(
    document: SiteDoc, scans: Scans = (), serials: Mapping[str, str] | None = None
) -> Subject:
    """Take a site as it is, with its clouds where they are at hand.

    Raises
    ------
    ValueError
        Where there are not as many LiDARs and placements of scans as of the document.
    UsageError
        Where a serial number is given of a LiDAR that is none of the site.
    """
    names, given = [each.name for each in document.lidars], serials or {}
    for name in given.keys() - {*names}:
        raise UsageError(f"no LiDAR {name!r}; there are {', '.join(names)}")
    lidars = [
        msgspec.structs.replace(each, serial=given.get(each.name, each.serial))
        for each in document.lidars
    ]
    document = msgspec.structs.replace(document, lidars=lidars)
    counts = [len(of_lidar) for of_lidar in scans]
    if counts and counts != [len(document.placements)] * len(document.lidars):
        raise ValueError("the scans are of other LiDARs or placements than the document")
    return Subject(document, None, scans)


def of_pair(
    result: ResultDoc, placements: Sequence[Placement], serials: Sequence[str] = ("", "")
) -> Subject:
    """Take a pair as a site of two LiDARs in the frame of the target."""
    scans = [[each.target for each in placements], [each.source for each in placements]]
    names, T = input_names(result), result.T_target_source
    count = max((len(names) + 1) // 2, len(placements), len(result.placements), 1)
    found: list[list[FoundDoc | None]] = []
    for of_lidar, listed in zip(scans, (result.poles.target, result.poles.source), strict=True):
        # The poles of the first placement are those that the result lists, whatever is shown.
        searched = [found_document(scan) for scan in of_lidar]
        first = (searched[0] if searched else None) or FoundDoc(None, [], [], None)
        others = [*searched[1:], *[None] * (count - max(len(searched), 1))]
        found.append([msgspec.structs.replace(first, poles=listed), *others])
    sensors = [*(item.sensor for item in result.inputs), "auto", "auto"]
    stated = {name: getattr(result, name) for name in STATED}
    poses = (
        {"T_site_lidar": None if T is None else np.eye(4), "covariance": np.zeros((6, 6))},
        {"T_site_lidar": T, **stated},
    )
    site = SiteDoc(
        **{name: getattr(result, name) for name in SHARED},
        **NO_SITE,
        name=" ← ".join(names[:2] if len(names) >= 2 else LIDARS),
        frame=Frame("LiDAR target"),
        placements=[" ← ".join(names[2 * j : 2 * j + 2]) for j in range(count)],
        radius_m=result.config.radius_m,
        radius_sigma_m=0.0 if result.radius is None else result.radius.sigma,
        lidars=[
            LidarDoc(name=LIDARS[k], sensor=sensors[k], serial=serials[k], up=None, **poses[k])
            for k in range(2)
        ],
        without=[
            WithoutPlacement(j, each.left_out_rotation_rad, each.left_out_translation_m, 1)
            for j, each in enumerate(result.placements)
            if len(result.placements) > 1
        ],
        found=found,
        inputs=[recording_document(item, k % 2, k // 2) for k, item in enumerate(result.inputs)],
    )
    return Subject(site, result, scans)


def pole_name(lidar: str, k: int) -> str:
    """Name the k-th pole of a LiDAR of a pair: ``T0``, ``S1``."""
    return f"{lidar[0].upper()}{k}"


def pair_name(pair: tuple[int, int]) -> str:
    """Name a pair of a target pole and a source pole: ``T0–S1``."""
    return f"{pole_name('target', pair[0])}–{pole_name('source', pair[1])}"


def input_names(result: ResultDoc) -> list[str]:
    """Name the inputs by their files, and by their topics where they are in bags."""
    topics = (result.config.target_topic, result.config.source_topic)
    return [
        " ".join([Path(item.path).name, topics[k % 2] or ""]).strip()
        for k, item in enumerate(result.inputs)
    ]


def recorded_by(result: ResultDoc) -> tuple[str, str]:
    """Name target and source of a pair by what they recorded: ``the source (rear.pcd)``.

    Files of one name are named with their folders; of several placements, the first. Of long names
    the ends are given: the list of the recordings has them whole.
    """
    names = input_names(result)[:2]
    if len(names) == 2 and names[0] == names[1]:
        names = [item.path for item in result.inputs[:2]]
    more = ", …" if len(result.inputs) > 2 else ""
    short = (shortened(name, LONGEST_IN_SENTENCE) for name in names)
    target, source = (f" ({name}{more})" for name in short) if len(names) == 2 else ("", "")
    return f"the target{target}", f"the source{source}"


def pole_labels(document: SiteDoc) -> list[str]:
    """Name each pole for the pictures: ``2.1`` is the first pole of the second placement."""
    count = [0] * len(document.placements)
    labels = []
    for pole in document.poles:
        count[pole.placement] += 1
        labels.append(f"{pole.placement + 1}.{count[pole.placement]}")
    return labels


def colour_class(lidar: int) -> str:
    """Name the class of a LiDAR's colour."""
    return f"lidar-{lidar % COLOURS}"
