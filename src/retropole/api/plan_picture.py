"""What the page of a plan draws, gathered from the plan."""

from __future__ import annotations

import numpy as np

from ..base import se3
from ..planning.choice import LEAST_ANGLE, LEAST_LEAN, LEAST_SPACING
from ..planning.compressed import compress
from ..planning.planner import Planned
from ..planning.words import leaning_words, pole_words, sights_of
from ..report.pole_plan import PlanPicture


def picture_of(planned: Planned) -> PlanPicture:
    """Gather what the page of a plan draws."""
    stations, candidates = planned.stations, planned.candidates
    words, towards = [], []
    for foot, axis in zip(candidates.foot, candidates.axis, strict=True):
        lean, way = leaning_words(foot, axis, stations)
        words.append(pole_words("", foot, lean, way, stations).partition(": ")[2])
        towards.append(way)
    together, alone = compress(planned.design)
    return PlanPicture(
        lidars=np.stack([each.T for each in stations]),
        points=[se3.apply(each.T, each.cloud.xyz) for each in stations],
        foot=candidates.foot,
        axis=candidates.axis,
        seen=planned.seen,
        sights=sights_of(planned, range(len(candidates))),
        words=words,
        towards=towards,
        pairs=planned.design.rules.pairs,
        chosen=planned.chosen,
        together=together,
        alone=alone,
        spacing=LEAST_SPACING,
        angle=LEAST_ANGLE,
        lean=LEAST_LEAN,
    )
