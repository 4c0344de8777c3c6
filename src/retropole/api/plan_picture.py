"""What the page of a plan draws, gathered from the plan."""

from __future__ import annotations

import numpy as np

from ..base import se3
from ..planning.choice import LEAST_ANGLE, LEAST_LEAN, LEAST_SPACING
from ..planning.compressed import compress
from ..planning.planner import Planned
from ..planning.words import leaning_words, pole_words
from ..report.pole_plan import PlanPicture


def picture_of(planned: Planned) -> PlanPicture:
    """Gather what the page of a plan draws."""
    stations, candidates = planned.stations, planned.candidates
    words = []
    for foot, axis in zip(candidates.foot, candidates.axis, strict=True):
        said = pole_words("", foot, *leaning_words(foot, axis, stations), stations)
        words.append(said.partition(": ")[2])
    together, alone = compress(planned.design)
    return PlanPicture(
        lidars=np.stack([each.T for each in stations]),
        points=[se3.apply(each.T, each.cloud.xyz) for each in stations],
        foot=candidates.foot,
        axis=candidates.axis,
        seen=planned.seen,
        words=words,
        pairs=planned.design.rules.pairs,
        chosen=planned.chosen,
        together=together,
        alone=alone,
        spacing=LEAST_SPACING,
        angle=LEAST_ANGLE,
        lean=LEAST_LEAN,
    )
