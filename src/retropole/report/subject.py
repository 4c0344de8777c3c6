"""What a page is of: a site of LiDARs. A pair is a site of two, the first of which is the frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import msgspec

from ..base.datatypes import Placement, Scan
from ..base.errors import UsageError, shortened
from ..base.quantities import counted
from ..base.uncertainty.confirmation import UNUSABLE
from ..result import ResultDoc, chance_wrong
from ..result.site import LIDARS, SiteDoc, as_site, found_document, input_names

LONGEST_IN_SENTENCE = 40
"""Characters of the name of a recording in a sentence."""

COLOURS = 8
"""Number of LiDARs that have a colour each; more begin again. Each has its name next to it."""

Scans = Sequence[Sequence[Scan | None]]
Recorded = Sequence[Placement] | Scans
"""What was recorded, by placements of a pair or LiDAR by LiDAR."""


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
        What each LiDAR recorded of each placement; empty if the page shows no clouds.
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


def as_subject(
    document: ResultDoc | SiteDoc,
    recorded: Recorded = (),
    serials: Mapping[str, str] | None = None,
) -> Subject:
    """Use a site unchanged, and a pair as a site of two LiDARs in the frame of the target.

    Parameters
    ----------
    document
        Of either.
    recorded
        What the LiDARs recorded, where it is at hand.
    serials
        Serial numbers by the names of LiDARs, before those of the document.

    Raises
    ------
    ValueError
        If there are not as many LiDARs and placements of scans as of the document of a site.
    UsageError
        If a serial number is given of a LiDAR that is none of the site.
    """
    scans = _by_lidar(recorded)
    pair = document if isinstance(document, ResultDoc) else None
    site = as_site(document)
    names, given = [each.name for each in site.lidars], serials or {}
    for name in given.keys() - {*names}:
        raise UsageError(f"no LiDAR {name!r}; there are {', '.join(names)}")
    lidars = [
        msgspec.structs.replace(each, serial=given.get(each.name, each.serial))
        for each in site.lidars
    ]
    site = msgspec.structs.replace(site, lidars=lidars)
    counts = [len(of_lidar) for of_lidar in scans]
    if pair is None and counts and counts != [len(site.placements)] * len(site.lidars):
        raise ValueError("the scans are of other LiDARs or placements than the document")
    if pair is not None and scans:
        site = _with_found(site, scans)
    return Subject(site, pair, scans)


def _with_found(site: SiteDoc, scans: Scans) -> SiteDoc:
    """Add what was found in the recordings of a pair, but for the poles that it lists."""
    found = []
    for of_lidar, listed in zip(scans, site.found, strict=True):
        searched = [found_document(scan) for scan in of_lidar]
        if searched[0] is not None and listed[0] is not None:
            searched[0] = msgspec.structs.replace(searched[0], poles=listed[0].poles)
        found.append([*searched, *listed[len(searched) :]])
    names = [*site.placements, *[""] * (len(scans[0]) - len(site.placements))]
    return msgspec.structs.replace(site, found=found, placements=names)


def _by_lidar(recorded: Recorded) -> Scans:
    """List what each LiDAR recorded, placement by placement."""
    placements = [each.scans for each in recorded if isinstance(each, Placement)]
    rows = [each for each in recorded if not isinstance(each, Placement)]
    return rows or list(zip(*placements, strict=True))


def pole_name(lidar: str, k: int) -> str:
    """Name the k-th pole of a LiDAR of a pair: ``T0``, ``S1``."""
    return f"{lidar[0].upper()}{k}"


def pair_name(pair: tuple[int, int]) -> str:
    """Name a pair of a target pole and a source pole: ``T0–S1``."""
    return f"{pole_name('target', pair[0])}–{pole_name('source', pair[1])}"


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
