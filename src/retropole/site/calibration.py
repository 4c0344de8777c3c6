"""The calibration of a site on one page: recordings of many LiDARs in, all poses out."""

from __future__ import annotations

from collections.abc import Callable

from .model import Site, SiteCalibration


def calibrate_site(
    site: Site, *, progress: Callable[[str], None] = lambda step: None
) -> SiteCalibration:
    """Find the poses of all LiDARs of a site in one frame.

    Parameters
    ----------
    site
        LiDARs with their clouds, and what was surveyed.
    progress
        Called with the name of each step as it starts.

    Returns
    -------
    SiteCalibration
        With `status` ``refused``, the reasons and no poses where the data carry no answer.
    """
    raise NotImplementedError
