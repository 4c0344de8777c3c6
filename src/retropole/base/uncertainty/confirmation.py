"""What the scene shows about a pose, and how likely it makes it that the pose is wrong."""

from __future__ import annotations

import msgspec
import numpy as np
from msgspec.structs import force_setattr

from ..bounded import Count, Number, Share, ShareOfSome, Size, Vector
from ..quantities import counted, percent

MAX_Z_MARGIN = 4.0
"""A larger margin adds nothing: its σ takes voxels for independent, which neighbours are not."""

CLEAR_Z_MARGIN = 1.5
"""Up to this many σ a margin may be chance, and each σ is weaker evidence than beyond. That another
pose is better by more is no more evidence against the answer: on bare ground it is as frequent of
right ones."""

PRIOR, PER_SHARE, PER_Z_MARGIN, PER_CLEAR_Z_MARGIN = 0.23, 0.29, -0.42, -3.65
"""Of the log odds that an answer is wrong: for the share of the voxels that conflict with it (its
logarithm), for its z-margin within `CLEAR_Z_MARGIN`, and for the rest. A logistic regression of 407
answers with two poles, 66 of them wrong (benchmarks/deception.py, seeds 20000 to 20022; the least
chance that it gives a wrong one is 27 %). So it applies where as many recordings deceive as there;
docs/evidence/verdicts.md shows how well, on other seeds."""

DECEIVING = 66 / 407
"""Share of the recordings that deceive, unless the user states another: that of those answers."""

TOGETHER = 0.023
"""The same where both LiDARs recorded at the same time: poles cannot have been carried in between.
What is left are other objects taken for poles, and clouds that were changed. Chosen: eight times
smaller odds, with which no wrong answer to such recordings was confirmed (benchmarks/deception.py
--times, seeds 100 to 135)."""

UNUSABLE = 0.2
"""An answer is not to be used above this probability that it is wrong; the report then advises what
to do instead. Chosen: one in five and more of such answers are wrong."""

REDUNDANT = -4.0
"""The same for poles that are redundant: of the answers with three or four poles in 1,000
hard scenes (benchmarks/hard_scenes.py) none was wrong. A lie then takes poles carried as one."""


class Confirmation(
    msgspec.Struct,
    frozen=True,
    kw_only=True,
    rename={
        "better_at": "better_at_m",
        "z_margin": "lead",
        "redundant": "vouched",
        "deceiving": "deceiving_share",
    },
):
    """What the scene shows about a pose (docs/results.md, The scene check).

    Attributes
    ----------
    agreeing, contradicting
        Voxels off the ground, of both clouds, that agree with the pose, and that are where the
        other LiDAR looked through.
    contradicted
        Share of the voxels that conflict with the pose; 0 if there is none. It follows from the
        others.
    missing
        Voxels that should agree besides, by how much is in both clouds.
    better_at
        How far away a pose lies under which the scene fits better, metres; None if none does.
    z_margin
        By how many σ the pose agrees better than the best of others near it; None if it was
        not compared with any.
    redundant
        Whether a third pole, or a placement of another shape, checks the poles.
    trusted
        Whether the user does.
    together
        Whether both LiDARs recorded every placement at the same time, by their clocks.
    deceiving
        Share of such recordings that deceive, which the next is stated for.
    along
        (3,) unit vector, target axes, along which the scene constrains the pose least; None if that
        is not a shift, or nothing is above the ground.
    probability_wrong
        Probability that the answer is off by more than 1° or 0.3 m, if this share of recordings
        deceives; None without a margin. It follows from the others.
    """

    agreeing: Count
    contradicting: Count
    contradicted: Share = 0.0
    missing: Count = 0
    better_at: Size | None = None
    z_margin: Number | None = None
    redundant: bool = False
    trusted: bool = False
    together: bool = False
    deceiving: ShareOfSome = DECEIVING
    along: Vector | None = None
    probability_wrong: Share | None = None

    def __post_init__(self) -> None:
        """Work out what follows: a document states it too, and is not trusted with it."""
        force_setattr(self, "contradicted", self.conflicting / max(self.total, 1))
        force_setattr(self, "probability_wrong", self._probability_wrong())

    @property
    def conflicting(self) -> int:
        """Voxels that conflict with the pose, one way or the other."""
        return self.contradicting + self.missing

    @property
    def total(self) -> int:
        """Voxels that say anything."""
        return self.agreeing + self.conflicting

    def _probability_wrong(self) -> float | None:
        if self.z_margin is None:
            return None
        share = np.log((self.conflicting + 1) / (self.total + 2))
        margin = np.clip(self.z_margin, -CLEAR_Z_MARGIN, CLEAR_Z_MARGIN)
        beyond = np.clip(self.z_margin, CLEAR_Z_MARGIN, MAX_Z_MARGIN) - CLEAR_Z_MARGIN
        odds = PRIOR + PER_SHARE * share + PER_Z_MARGIN * margin + PER_CLEAR_Z_MARGIN * beyond
        odds += REDUNDANT * self.redundant + _log_odds(self.deceiving) - _log_odds(DECEIVING)
        return float(1 / (1 + np.exp(-odds)))

    @property
    def is_unusable(self) -> bool:
        """Whether it is too likely wrong to be used, and nobody trusts the poles."""
        wrong = self.probability_wrong
        return not self.trusted and wrong is not None and wrong > UNUSABLE

    @property
    def counts(self) -> str:
        """What was counted, for a person: ``412 patches agree, 3 contradict``.

        Each count is that of the field of its name: what should agree and does not is
        distinguished.
        """
        text = counted(self.agreeing, "patch agrees", "patches agree")
        text += f", {counted(self.contradicting, 'contradicts', 'contradict')}"
        return f"{text}, {self.missing:,} should agree and do not" if self.missing else text

    @property
    def text(self) -> str:
        """The figures for a person: ``412 patches agree, 3 contradict (0.7 % against it); …``."""
        text = self.counts
        if self.conflicting:
            text += f" ({100 * self.contradicted:.1f} % against it)"
        if self.better_at is not None:
            text += f"; it fits better {self.better_at:.1f} m away"
        if self.probability_wrong is None:
            return text
        at_once = "; both LiDARs recorded at the same time" if self.together else ""
        return f"{text}{at_once}; chance of a wrong pose {self.chance_words}"

    @property
    def chance_words(self) -> str:
        """How likely the pose is wrong, and what that assumes of recordings like these.

        ``0.9 % (assuming that poles were moved or mistaken in 31 % of recordings)``.
        """
        assumed = f"poles were moved or mistaken in {percent(self.deceiving)} of recordings"
        return f"{self.chance} (assuming that {assumed})"

    @property
    def chance(self) -> str:
        """How likely the pose is wrong: ``5.2 %``."""
        wrong = self.probability_wrong or 0.0
        # Fewer than a thousand answers set it: it is not known better than to a thousandth.
        return f"{100 * wrong:.1f} %" if wrong >= 0.001 else "below 0.1 %"


def _log_odds(share: float) -> float:
    return float(np.log(share / (1.0 - share)))
