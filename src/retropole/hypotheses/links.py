"""Links by candidate poles that the scene confirms, for LiDARs without a link by confirmed
poles.

As for a single pair (`candidate_confirmation`): two lines that both LiDARs see with the same angle
and distance, under a pose at which the scenes coincide, and at no other.

LiDARs with a single pole in common with others are linked if the surroundings of that pole
determine the rest of the pose. As for a single pair (`by_place`): the pose must be better than all
other angles about the pole, and the objects in the scene must confirm it. Only LiDARs without
another link are tried, so that the answers for all others are unchanged.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace

import numpy as np

from ..base.datatypes import Placement, Pole, Scan
from ..base.errors import Refusal
from ..extraction.candidates import with_candidates
from .by_place import check_confirmed_by_surroundings
from .evidence import check_confirmation, confirm
from .joint_choice import linked_groups
from .pairs import Pair
from .placements import Chosen
from .scans import SiteScans
from .search import (
    ENOUGH_CONFIRMED,
    choose_about_one_pole,
    choose_with_candidates,
    count_candidates,
)

MOST_TRIED = 12
"""Maximum number of pairs that are tried: each takes as long as half of a pair's calibration."""


def link_by_candidates(
    scans: SiteScans, pairs: Sequence[Pair], radius: float
) -> tuple[SiteScans, tuple[Pair, ...]]:
    """Link groups of LiDARs by candidate poles, until all are linked or no more are found.

    Parameters
    ----------
    scans, pairs
        Of the site.
    radius
        Of the poles, metres.

    Returns
    -------
    SiteScans, tuple of Pair
        With the candidate poles that are confirmed among the poles, and the pairs that they link.
    """
    found = {pair.lidars: pair for pair in pairs}
    tried = 0
    for lidars in between_groups(scans, pairs):
        groups = linked_groups(len(scans.by_lidar), list(found.values()))
        if len(groups) == 1 or tried >= MOST_TRIED:
            break
        if any(set(lidars) <= set(group) for group in groups):
            continue
        tried += 1
        linked = _linked(scans, lidars, radius, by_place=False)
        if linked is not None:
            scans, found[lidars] = linked
    return scans, tuple(found.values())


def with_own_candidates(scans: SiteScans, radius: float) -> SiteScans:
    """Add the candidate poles to recordings with fewer than two confirmed ones.

    They are not evidence by themselves: only a loop that closes with them, and with no other
    choice, confirms them.
    """
    rows = tuple(
        tuple(None if scan is None else _with_own_candidates(scan, radius) for scan in row)
        for row in scans.by_lidar
    )
    return replace(scans, by_lidar=rows)


def _with_own_candidates(scan: Scan, radius: float) -> Scan:
    if scan.detection is None or len(scan.poles) >= ENOUGH_CONFIRMED:
        return scan
    found = with_candidates(scan.cloud, scan.detection, radius, scan.sensor)
    return count_candidates(replace(scan, detection=found))


def between_groups(
    scans: SiteScans, pairs: Sequence[Pair], *, by_two: bool = True
) -> Iterator[tuple[int, int]]:
    """Pairs of LiDARs of different groups: those first whose recordings have most poles of either
    kind. If one has two confirmed ones, and two are requested, a lower threshold may show those
    of the other.
    """
    groups = linked_groups(len(scans.by_lidar), pairs)
    of = {i: k for k, group in enumerate(groups) for i in group}
    counts = {}
    for pair in pairs:
        i, j = pair.lidars
        if of[i] != of[j]:
            both = list(_both(scans, i, j))
            sure = by_two and any(
                max(len(a.poles), len(b.poles)) >= ENOUGH_CONFIRMED for a, b in both
            )
            most = max((min(_candidates(a), _candidates(b)) for a, b in both), default=0)
            if most or sure:
                counts[i, j] = most
    yield from sorted(counts, key=lambda k: -counts[k])


def _both(scans: SiteScans, i: int, j: int) -> Iterator[tuple[Scan, Scan]]:
    for a, b in zip(scans.by_lidar[i], scans.by_lidar[j], strict=True):
        if a is not None and b is not None:
            yield a, b


def _candidates(scan: Scan) -> int:
    """Number of clusters that may be poles."""
    found = scan.detection
    return 0 if found is None else len(found.poles) + len(found.rejected)


def _linked(
    scans: SiteScans, lidars: tuple[int, int], radius: float, *, by_place: bool
) -> tuple[SiteScans, Pair] | None:
    """Link two LiDARs by the first placement that does; None if none does.

    By candidate poles that are confirmed, or `by_place`, whose answer is the same in all
    placements.
    """
    i, j = lidars
    for p, (target, source) in enumerate(zip(scans.by_lidar[i], scans.by_lidar[j], strict=True)):
        if target is None or source is None:
            continue
        both = [Placement(target, source)]
        chosen = (
            choose_about_one_pole(both, radius, _untimed)
            if by_place
            else choose_with_candidates(both, radius, _untimed, by_place=False)
        )
        if chosen is None or chosen.refusal is not None or (by_place and not _is_confirmed(chosen)):
            continue
        linked = with_chosen_poles(scans, lidars, p, chosen)
        return linked, _pair(lidars, p, chosen, by_place=by_place)
    return None


def _untimed(step: str) -> AbstractContextManager[None]:
    return nullcontext()


def _pair(lidars: tuple[int, int], placement: int, chosen: Chosen, *, by_place: bool) -> Pair:
    """Express a choice as that of a pair: hypotheses that were not chosen are left out."""
    hypotheses = tuple(
        replace(
            each,
            stands=rank == 0,
            possible=rank == 0,
            poles={placement: len(each.match.pairs)},
        )
        for rank, each in enumerate(chosen.hypotheses)
    )
    return Pair(lidars, hypotheses if by_place else hypotheses[:1], True, by_place=by_place)


def with_chosen_poles(
    scans: SiteScans, lidars: tuple[int, int], placement: int, chosen: Chosen
) -> SiteScans:
    """Add the poles that a choice pairs to those of both LiDARs in a placement."""
    rows = [list(row) for row in scans.by_lidar]
    paired = chosen.paired[0]
    for lidar, poles in zip(lidars, (paired.target_poles, paired.source_poles), strict=True):
        scan = rows[lidar][placement]
        assert scan is not None
        rows[lidar][placement] = _counting(scan, poles)
    return replace(scans, by_lidar=tuple(tuple(row) for row in rows))


def _counting(scan: Scan, poles: Sequence[Pole]) -> Scan:
    assert scan.detection is not None
    new = [pole for pole in poles if not any(pole is own for own in scan.poles)]
    found = scan.detection
    counted = replace(found, poles=(*found.poles, *new), candidates=(*found.candidates, *new))
    return replace(scan, detection=counted)


def link_by_place(
    scans: SiteScans, pairs: Sequence[Pair], radius: float
) -> tuple[SiteScans, tuple[Pair, ...]]:
    """Link groups of LiDARs by one pole that both see, if the surroundings determine the rest.

    Every pair between two groups is tried: if two of them give different poses, they are
    not consistent (`joint_choice.choose_poses`), and the site has no answer.

    Parameters
    ----------
    scans, pairs
        Of the site.
    radius
        Of the poles, metres.

    Returns
    -------
    SiteScans, tuple of Pair
        With the candidate poles that are confirmed among the poles, and the pairs linked by the
        surroundings, `Pair.by_place`.
    """
    found = {pair.lidars: pair for pair in pairs}
    for lidars in list(between_groups(scans, pairs, by_two=False))[:MOST_TRIED]:
        linked = _linked(scans, lidars, radius, by_place=True)
        if linked is not None:
            scans, found[lidars] = linked
    return scans, tuple(found.values())


def _is_confirmed(chosen: Chosen) -> bool:
    """Whether the objects in the scene confirm the pose, and no other angle about the pole."""
    first, *others = chosen.hypotheses
    T = first.match.T_target_source
    found = confirm(chosen.paired, T, others, np.random.default_rng(0))
    try:
        check_confirmation(found)
        check_confirmed_by_surroundings(chosen.paired, found)
    except Refusal:
        return False
    return True
