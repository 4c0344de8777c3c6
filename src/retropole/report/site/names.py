"""What the parts of a site are called on its page."""

from __future__ import annotations

from collections.abc import Sequence

from ...result.site import SiteDoc


def placement_name(names: Sequence[str], j: int) -> str:
    """Name a placement by its number, from 1, and what it is called: ``2: noon``, or ``2``."""
    number = str(j + 1)
    return number if names[j] in ("", number) else f"{number}: {names[j]}"


def pole_labels(document: SiteDoc) -> list[str]:
    """Name each pole for the pictures: ``2.1`` is the first pole of the second placement."""
    count = [0] * len(document.placements)
    labels = []
    for pole in document.poles:
        count[pole.placement] += 1
        labels.append(f"{pole.placement + 1}.{count[pole.placement]}")
    return labels
