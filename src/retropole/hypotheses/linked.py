"""Whether the LiDARs are linked at all, before anything is adjusted."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from ..base.description import Site
from ..base.errors import Refusal
from .pairs import Pair
from .scans import SiteScans


def check_linked(
    site: Site, scans: SiteScans, groups: Sequence[Sequence[int]], pairs: Sequence[Pair]
) -> None:
    """Refuse a site that falls into groups, or has no two LiDARs with poles.

    Raises
    ------
    Refusal
        ``too_few_lidars`` or ``disconnected``; of two LiDARs why they have no pose.
    """
    if len(groups) == 1:
        return
    if len(site.lidars) == 2:
        # As of a pair: what keeps it from an answer is no matter of the site.
        for refusal in (*(refusal for _, refusal in scans.faults), pairs[0].refusal):
            if refusal is not None:
                raise Refusal(refusal.code, refusal.message, refusal.values)
    named = "; ".join(", ".join(site.lidars[i].name for i in group) for group in groups)
    first = next((pair.refusal for pair in pairs if pair.refusal is not None), None)
    why = "" if first is None else f" ({first.message})"
    if len(groups[0]) < 2:
        raise Refusal(
            "too_few_lidars",
            f"no two LiDARs see the same two poles in one placement{why}",
            {"lidars": len(site.lidars)},
        )
    unmatched = "; ".join(_unmatched(site, scans, groups, pairs))
    other = f", or correct the files: {unmatched} see poles that do not match" if unmatched else ""
    raise Refusal(
        "disconnected",
        f"the LiDARs fall into {len(groups)} groups that share no two poles: {named}; add a "
        "placement with two poles that LiDARs of both groups see" + other,
        {"groups": len(groups), "names": named, "unmatched": unmatched},
    )


def _unmatched(
    site: Site, scans: SiteScans, groups: Sequence[Sequence[int]], pairs: Sequence[Pair]
) -> Iterator[str]:
    """Name LiDARs of two groups that both see three poles of a placement, of which no two match.

    Two may be others; of three that stand about both something is wrong more likely.
    """
    group_of = {i: number for number, group in enumerate(groups) for i in group}
    for pair in pairs:
        i, j = pair.lidars
        apart = group_of[i] != group_of[j] and pair.refusal is not None
        for p, name in enumerate(site.placements):
            if apart and min(len(scans.poles(i, p)), len(scans.poles(j, p))) > 2:
                yield f"{site.lidars[i].name} and {site.lidars[j].name} in placement {name}"
