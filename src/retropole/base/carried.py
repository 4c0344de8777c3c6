"""What is known of the walk with one pole behind an answer, as in the result document."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

from .bounded import LONGEST_LIST, Count, Number, Share, Size, Vector

Row = Annotated[list[Number], Meta(max_length=4)]


class LidarWalk(msgspec.Struct, frozen=True, eq=False):
    """What one LiDAR of a site saw of a walk, and its clock.

    Attributes
    ----------
    clock_offset_s, clock_sigma_s, clock_drift, middle_s
        What makes its times those of the reference, as of `CarriedWalk`; 0 of the reference.
    sweeps, found, range_scale, edge_jitter_rad, clock_windows
        Of this LiDAR, as of `CarriedWalk`.
    """

    clock_offset_s: Number
    clock_sigma_s: Size
    clock_drift: Number
    middle_s: Number
    sweeps: Count
    found: Count
    range_scale: Size
    edge_jitter_rad: Size
    clock_windows: Annotated[list[Row], Meta(max_length=LONGEST_LIST)]


class SiteWalk(msgspec.Struct, frozen=True, eq=False):
    """A walk before the LiDARs of a site.

    Attributes
    ----------
    begin_s
        When the pole was first seen, by the clock of the reference.
    seconds, along_m, across_m, lean_rad, left_out, up, path
        As of `CarriedWalk`, in the frame of the site.
    lidars
        Of each LiDAR of the site, in their order.
    """

    begin_s: Number
    seconds: Size
    along_m: Size
    across_m: Size
    lean_rad: Size
    left_out: Share
    up: Vector
    path: Annotated[list[Row], Meta(max_length=LONGEST_LIST)]
    lidars: Annotated[list[LidarWalk], Meta(max_length=LONGEST_LIST)]


class CarriedWalk(msgspec.Struct, frozen=True, eq=False):
    """A walk before two LiDARs, and their clocks.

    Times of the source become those of the target by::

        t_target = t_source + clock_offset_s + clock_drift (t_target − middle_s)

    Attributes
    ----------
    clock_offset_s, clock_sigma_s
        The offset in the middle of the walk, and its 1 σ, s.
    clock_drift, middle_s
        By how much the target's clock is faster, s for each s; and the middle of the walk by it.
    seconds
        How long the pole was seen.
    sweeps, found
        Of the target and the source: how many were recorded, and in how many the pole was found.
    along_m, across_m, lean_rad
        Root mean squares of the way along its longest direction and across it, and of the lean.
    left_out
        Share of the returns, ring by ring, that have less weight than half.
    range_scale, edge_jitter_rad
        Of the target and the source: the factor by which ranges scatter beyond the sensor's stated
        noise, and the jitter of the pole's edges.
    clock_windows
        Of each window of 5 s: its middle, the offset relative to that of the walk and its 1 σ, s.
    up
        (3,) the way the pole points on average, target axes.
    path
        Where the pole was, evenly taken: s since it was first seen, and x, y and z, metres, in the
        target's frame.
    """

    clock_offset_s: Number
    clock_sigma_s: Size
    clock_drift: Number
    middle_s: Number
    seconds: Size
    sweeps: tuple[Count, Count]
    found: tuple[Count, Count]
    along_m: Size
    across_m: Size
    lean_rad: Size
    left_out: Share
    range_scale: tuple[Size, Size]
    edge_jitter_rad: tuple[Size, Size]
    clock_windows: Annotated[list[Row], Meta(max_length=LONGEST_LIST)]
    up: Vector
    path: Annotated[list[Row], Meta(max_length=LONGEST_LIST)]

    @property
    def of_site(self) -> SiteWalk:
        """The same of a site of two LiDARs."""
        both = zip(self.sweeps, self.found, self.range_scale, self.edge_jitter_rad, strict=True)
        own = self.clock_offset_s, self.clock_sigma_s, self.clock_drift
        clocks = (0.0, 0.0, 0.0, self.middle_s), (*own, self.middle_s)
        windows: tuple[list[Row], ...] = [], self.clock_windows
        lidars = [
            LidarWalk(*clock, *seen, window)
            for clock, seen, window in zip(clocks, both, windows, strict=True)
        ]
        shared = {name: getattr(self, name) for name in SiteWalk.__struct_fields__[1:-1]}
        return SiteWalk(self.middle_s - self.seconds / 2, **shared, lidars=lidars)
