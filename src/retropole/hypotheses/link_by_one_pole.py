"""LiDARs that share one pole with others: a link where the place about it tells the rest.

As for a pair alone (`by_place`): the place must lead all other angles about the pole, and
what stands in the scene must confirm the pose. Only LiDARs that nothing else links are asked, so
that all others are answered as without.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext

import numpy as np

from ..base.datatypes import Placement
from ..base.errors import Refusal
from .by_place import check_told
from .evidence import check_confirmation, confirm
from .link_by_candidates import MOST_TRIED, between_groups, with_chosen_poles
from .pairs import Pair, PairHypothesis
from .placements import Chosen
from .scans import SiteScans
from .search import choose_about_one_pole


def link_by_place(
    scans: SiteScans, pairs: Sequence[Pair], radius: float
) -> tuple[SiteScans, tuple[Pair, ...]]:
    """Link groups of LiDARs by one pole that both see, where the place tells the rest.

    Every pair between two groups is asked: where two of them tell different poses, they do not go
    together (`joint_choice.choose_poses`), and the site has no answer.

    Parameters
    ----------
    scans, pairs
        Of the site.
    radius
        Of the poles, metres.

    Returns
    -------
    SiteScans, tuple of Pair
        With the candidate poles that are confirmed among the poles, and the pairs that the place
        links, `Pair.by_place`.
    """
    found = {pair.lidars: pair for pair in pairs}
    for lidars in list(between_groups(scans, pairs, by_two=False))[:MOST_TRIED]:
        linked = _linked_by_place(scans, lidars, radius)
        if linked is not None:
            scans, found[lidars] = linked
    return scans, tuple(found.values())


def _linked_by_place(
    scans: SiteScans, lidars: tuple[int, int], radius: float
) -> tuple[SiteScans, Pair] | None:
    """Link two LiDARs by the first placement whose place tells: it is the same in all of them."""
    i, j = lidars
    for p, (target, source) in enumerate(zip(scans.by_lidar[i], scans.by_lidar[j], strict=True)):
        if target is None or source is None:
            continue
        placement = Placement(target, source)
        chosen = choose_about_one_pole([placement], radius, lambda step: nullcontext())
        if chosen is not None and chosen.refusal is None and _is_confirmed(chosen):
            return with_chosen_poles(scans, lidars, p, chosen), _pair_by_place(lidars, p, chosen)
    return None


def _is_confirmed(chosen: Chosen) -> bool:
    """Whether what stands in the scene confirms the pose, and no other angle about the pole."""
    first, *others = chosen.hypotheses
    T = first.match.T_target_source
    found = confirm(chosen.paired, T, others, np.random.default_rng(0))
    try:
        check_confirmation(found)
        check_told(chosen.paired, found)
    except Refusal:
        return False
    return True


def _pair_by_place(lidars: tuple[int, int], placement: int, chosen: Chosen) -> Pair:
    """State a choice as that of a pair: other angles about the pole are none to choose from."""
    hypotheses = tuple(
        PairHypothesis(
            each.match.T_target_source,
            (placement,),
            len(each.match.pairs),
            each.overlap,
            each.free_space_violation,
            each.score,
            stands=rank == 0,
            possible=rank == 0,
        )
        for rank, each in enumerate(chosen.hypotheses)
    )
    return Pair(lidars, hypotheses, True, by_place=True)
