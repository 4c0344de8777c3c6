"""How a LiDAR swayed while it recorded, and how far its mean pose may be from where it rests."""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
import numpy as np

from .bounded import Covariance, Number, Size
from .se3 import Array

ENOUGH = 2.0
"""So many periods are asked for; after three, rest is known to less than a tenth of the sway
(tests/surfaces/test_sway.py)."""

LEVER = 6.0
"""A mast that turns shifts its LiDAR by so many metres a radian: the height of a lamppost, whose
top bends by less. Where nothing measures the shift this is taken for it."""


class Sway(msgspec.Struct, frozen=True, eq=False, rename={"frequency": "frequency_hz"}):
    """Motion of one LiDAR about its rest while it recorded, axes of its own frame.

    Attributes
    ----------
    angle_rad
        Root mean square of the angle from rest that was seen; of a sway that was stated and not
        seen, what was stated.
    frequency
        Of the oscillation, Hz; None where it was stated.
    seconds
        How long the recording took.
    covariance
        (6, 6) of what is left between the pose that all points were brought to and rest, over
        rotation and translation, rad and m.
    times_s, angles_rad
        The motion as it was seen, from the first sweep on: the angle in its main direction.
    is_shared
        Whether other LiDARs sway with it, as on one mast.
    """

    angle_rad: Size
    frequency: Size | None
    seconds: Size
    covariance: Covariance
    times_s: tuple[Number, ...] = ()
    angles_rad: tuple[Number, ...] = ()
    is_shared: bool = False

    @property
    def left_rad(self) -> float:
        """1 σ of the angle between the recording and rest, about the axis where it is largest."""
        return float(np.sqrt(np.linalg.eigvalsh(np.asarray(self.covariance)[:3, :3])[-1]))

    @property
    def seconds_more(self) -> float:
        """How much longer to record for `ENOUGH` periods, s; 0 where they are there."""
        if self.frequency is None or self.is_shared:
            return 0.0
        return max(ENOUGH / self.frequency - self.seconds, 0.0)

    @property
    def words(self) -> str:
        """How much it was, how well is known where the LiDAR rests, and how long to record."""
        angle = f"± {math.degrees(self.angle_rad):.2g}°"
        if self.frequency is None:
            return (
                f"{angle} as stated; the recording does not show where it rests, so the stated "
                "error has all of it: record 10 s or more"
            )
        if self.is_shared:
            return (
                f"{angle} at {self.frequency:.2g} Hz together with another LiDAR, as on one mast: "
                "the transform between them does not move"
            )
        more = f": record {math.ceil(self.seconds_more)} s more" if self.seconds_more else ""
        return (
            f"{angle} at {self.frequency:.2g} Hz, {self.periods:.1f} periods; where it rests is "
            f"known to ± {math.degrees(self.left_rad):.1g}°{more}"
        )

    @property
    def periods(self) -> float:
        """How many periods were recorded; 0 of a sway that was stated."""
        return self.seconds * (self.frequency or 0.0)


def stated_sway(sigma: float) -> Sway:
    """Give what a mast is said to sway by, where a recording shows nothing of it.

    `sigma` is the root mean square of its angle from rest, rad. A mast turns about level axes, half
    of the variance about each; which axes of the LiDAR are level is not known: any may be.
    """
    covariance = np.diag(np.repeat([sigma, LEVER * sigma], 3) ** 2) / 2
    return Sway(sigma, None, 0.0, covariance)


def left_of(sways: Sequence[Sway | None]) -> Array:
    """(6, 6) covariance of what is left of the sway of one LiDAR in the mean of its recordings."""
    left = sum((each.covariance for each in sways if each is not None), np.zeros((6, 6)))
    return np.asarray(left / max(len(sways), 1) ** 2)


def left_of_each(rows: Sequence[Sequence[Sway | None]]) -> tuple[Array, ...]:
    """`left_of` each LiDAR's recordings; none where all stood."""
    if not any(each for row in rows for each in row):
        return ()
    return tuple(left_of(row) for row in rows)
