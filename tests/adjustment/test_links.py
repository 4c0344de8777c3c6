"""Pairs that link all LiDARs, and the poles across each link."""

from dataclasses import replace

import pytest

from retropole.adjustment.site import find_links
from tests.adjustment.adjusting import Steps

pytestmark = pytest.mark.full


def test_links_are_told_with_the_poles_that_both_their_sides_see(steps: Steps) -> None:
    """Two groups of LiDARs, of three poles each, and two poles more that one of each sees."""
    pole = steps.adjusted.datum.poles[0]
    own = next(iter(pole.seen.values()))
    seen = [*[(0, 1)] * 3, *[(2, 3)] * 3, (1, 2), (1, 2, 3)]
    poles = [replace(pole, seen=dict.fromkeys(each, own)) for each in seen]
    datum = replace(steps.adjusted.datum, poles=poles)
    four = replace(steps.adjusted.end, T=steps.adjusted.end.T[[0, 0, 0, 0]], scene=())
    found = {
        link.lidars: link for link in find_links(replace(steps.adjusted, datum=datum, end=four))
    }
    assert found[0, 1].poles == (0, 1, 2)
    assert found[2, 3].poles == (3, 4, 5, 7)
    # All that the one group has to do with the other are two poles, though each LiDAR sees more.
    assert found[1, 2].poles == (6, 7)
    assert found[1, 2].near == {0, 1}
    assert len(found) == 3


def test_links_of_one_pair_are_that_pair(pair_steps: Steps) -> None:
    (link,) = find_links(pair_steps.adjusted)
    assert link.lidars == (0, 1)
    assert link.near == {0}
    assert link.poles == (0, 1, 2)
