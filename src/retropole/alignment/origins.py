"""The method counts from where the beams start; its answer is moved back into the clouds' frames.

In the frame of a map a small turn moves everything by metres: nothing there distinguishes a pose
that is free from one that is certain, and sums of squares lose the digits that count.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..base import se3
from ..base.datatypes import (
    Array,
    Calibration,
    Hypothesis,
    Placement,
    Pole,
    PoseEstimate,
    Scan,
)
from ..base.uncertainty import Uncertainty, covariance_at

Move = Callable[[Array], Array]
"""What moves points, or directions, (N, 3)."""


@dataclass(frozen=True, eq=False)
class BeamOrigins:
    """(3,) where the beams of the target and of the source start, each in its cloud's frame."""

    target: Array
    source: Array

    def about(self, placements: Sequence[Placement]) -> tuple[Placement, ...]:
        """Express placements about the beam origins; those that are there already stay as are."""
        return tuple(_shifted(each, -self.target, -self.source) for each in placements)

    def moved_back(self, answer: Calibration) -> Calibration:
        """Express an answer that was found about the beam origins in the frames of the clouds."""
        if not (self.target.any() or self.source.any()):
            return answer
        T, covariance, uncertainty = answer.T_target_source, answer.covariance, answer.uncertainty
        if T is not None and covariance is not None:
            covariance = self._covariance(covariance, T)
        if T is not None and uncertainty is not None:
            uncertainty = Uncertainty(
                self._covariance(uncertainty.random, T),
                self._covariance(uncertainty.systematic, T),
                uncertainty.budget,
            )
        return replace(
            answer,
            T_target_source=None if T is None else self._pose(T),
            covariance=covariance,
            poles=self._estimate(answer.poles),
            refined=self._estimate(answer.refined),
            hypotheses=tuple(self._hypothesis(each) for each in answer.hypotheses),
            placements=tuple(
                _shifted(each, self.target, self.source) for each in answer.placements
            ),
            uncertainty=uncertainty,
        )

    def _pose(self, T: Array) -> Array:
        return se3.from_rt(T[:3, :3], T[:3, 3] + self.target - T[:3, :3] @ self.source)

    def _covariance(self, covariance: Array, T: Array) -> Array:
        """Express a covariance about the origin of the source cloud's frame instead."""
        return covariance_at(covariance, T, se3.apply(T, -self.source[None])[0])

    def _estimate(self, pose: PoseEstimate | None) -> PoseEstimate | None:
        if pose is None:
            return None
        T, covariance = pose.T_target_source, pose.covariance
        moved = None if covariance is None else self._covariance(covariance, T)
        return PoseEstimate(self._pose(T), moved, pose.rms)

    def _hypothesis(self, hypothesis: Hypothesis) -> Hypothesis:
        match = hypothesis.match
        T = match.T_target_source
        # Information changes by the inverse of what a covariance changes by.
        back = np.eye(6)
        back[3:, :3] = -se3.hat(T[:3, :3] @ self.source)
        moved = replace(
            match,
            T_target_source=self._pose(T),
            information=np.asarray(back.T @ match.information @ back),
        )
        return replace(hypothesis, match=moved)


def beam_origins(placements: Sequence[Placement]) -> BeamOrigins:
    """Use the beam origins of the first placement; the LiDARs did not move between them."""
    return BeamOrigins(placements[0].target.cloud.origin, placements[0].source.cloud.origin)


def _shifted(placement: Placement, by_target: Array, by_source: Array) -> Placement:
    if not (by_target.any() or by_source.any()):
        return placement
    return replace(
        placement,
        target=shifted(placement.target, by_target),
        source=shifted(placement.source, by_source),
    )


def shifted(scan: Scan, by: Array) -> Scan:
    """Express a scan in a frame whose origin lies at ``-by`` (3,), metres, of the one it is in."""
    return moved(scan, lambda xyz: xyz + by, lambda axes: axes) if by.any() else scan


def moved(scan: Scan, points: Move, directions: Move) -> Scan:
    """Move a scan with all that was found in it, by what moves its points and its directions."""
    cloud, found = scan.cloud, scan.detection

    def pole(each: Pole) -> Pole:
        point, direction = points(each.point[None])[0], directions(each.direction[None])[0]
        return replace(each, point=point, direction=direction, xyz=points(each.xyz))

    if found is not None:
        found = replace(
            found,
            poles=tuple(map(pole, found.poles)),
            rejected=tuple(
                replace(each, centre=points(each.centre[None])[0]) for each in found.rejected
            ),
            candidates=tuple(map(pole, found.candidates)),
        )
    origin = points(cloud.origin[None])[0]
    cloud = replace(cloud, xyz=points(cloud.xyz), origin=origin)
    return replace(scan, cloud=cloud, detection=found)
