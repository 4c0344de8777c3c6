"""Which poles of one placement are the same for two LiDARs, and which way round."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..base.datatypes import Array, Pole
from ..hypotheses.correspondence import left_out, match_poles


@dataclass(frozen=True, eq=False)
class Correspondence:
    """Which poles of one placement are the same, and which way round.

    Attributes
    ----------
    pairs
        ``((i, j), …)``: target pole ``i`` is source pole ``j``.
    target, source
        (K,) the poles themselves, in the order of the pairs.
    signs
        (K,) 1 where the direction of the source's pole is that of the target's, else -1.
    """

    pairs: tuple[tuple[int, int], ...]
    target: tuple[Pole, ...]
    source: tuple[Pole, ...]
    signs: Array

    def poles(self, lidar: int) -> tuple[Pole, ...]:
        """The poles of the target (0) or the source (1)."""
        return self.source if lidar else self.target

    def directions(self, lidar: int) -> Array:
        """(K, 3) their directions, with the sense that both LiDARs agree on."""
        directions = np.array([pole.direction for pole in self.poles(lidar)])
        return np.asarray(self.signs[:, None] * directions if lidar else directions)


def correspond(target: Sequence[Pole], source: Sequence[Pole]) -> Correspondence:
    """Tell which poles are the same, by their distances and angles alone.

    Poles that stand up to half a metre from where the others say they are count as the same: that
    they do not fit is for the test to find.

    Raises
    ------
    Refusal
        As `match_poles`.
    """
    candidates = []
    for match in match_poles(target, source):
        if match.exact:
            near = tuple((i, j) for i, j, _ in left_out(target, source, match))
            candidates.append((match, (*match.pairs, *near)))
    # Of equals the first, which fits best.
    match, pairs = max(candidates, key=lambda each: len(each[1]))
    own, others = tuple(target[i] for i, _ in pairs), tuple(source[j] for _, j in pairs)
    turned = np.array([pole.direction for pole in others]) @ match.T_target_source[:3, :3].T
    along = np.einsum("ki,ki->k", turned, np.array([pole.direction for pole in own]))
    return Correspondence(pairs, own, others, np.where(along < 0, -1.0, 1.0))
