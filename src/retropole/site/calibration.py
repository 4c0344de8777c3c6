"""The calibration of a site on one page: recordings of many LiDARs in, all poses out."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from threadpoolctl import threadpool_limits

from ..alignment.adjustment import RADIUS_TOLERANCE
from ..alignment.certainty import WORKING_SHARE
from ..alignment.climb import START_NOISE
from ..alignment.posterior import beam_geometry
from ..systematic import MIN_ERROR_SIGMA, sizes_of
from .choice import choose_poses, linked_groups
from .model import Site, SiteCalibration
from .network import bands_of, observe
from .pairs import find_pairs, poles_of
from .posterior import SitePriors, SiteState, climb_site
from .refinement import patches_of, refine_site, scene_pairs
from .scans import find_scans, views_of
from .shared import shared_poles, sights_of
from .survey import Surveyed
from .unknowns import known_sigmas


def experiment(site: Site):
    t0 = time.time()
    seconds = {}

    def lap(name):
        nonlocal t0
        seconds[name] = time.time() - t0
        t0 = time.time()

    with threadpool_limits(1, user_api="blas"):
        scans = find_scans(site)
        lap("scans")
        views = views_of(scans)
        pairs = find_pairs(scans, views)
        lap("pairs")
        groups = linked_groups(len(site.lidars), pairs)
        at = [poles_of(scans, i) for i in range(len(site.lidars))]
        choices = choose_poses(groups[0], pairs, at, site.reference)
        lap("choose")
        poses = choices.best.poses
        poles = [p for p in shared_poles(scans, poses, site.radius) if len(p.seen) > 1]
        sights = sights_of(scans, poles)
        L = len(site.lidars)
        sizes = [sizes_of(l.sensor) for l in site.lidars]
        T = np.stack([poses.get(i, np.eye(4)) for i in range(L)])
        state = SiteState(
            T,
            np.zeros(L),
            site.radius,
            np.array([p.point for p in poles]),
            np.array([p.direction for p in poles]),
            np.zeros((0, 3)),
        )
        noise = np.zeros((L, 2))
        for s in sights:
            seen = beam_geometry(
                state.of(s.lidar, s.own),
                1,
                s.beams.origin,
                s.beams.directions,
                s.beams.ranges,
                s.beams.pole,
            )
            spread = np.sqrt(np.mean((seen.depth - site.radius) ** 2 + seen.lateral_offset**2))
            noise[s.lidar] = np.log(np.clip(spread, *START_NOISE))
        free = np.ones(6 * L, dtype=bool)
        free[6 * site.reference : 6 * site.reference + 6] = False
        rs = max(site.radius_sigma, RADIUS_TOLERANCE * site.radius, MIN_ERROR_SIGMA)
        priors = SitePriors(
            T,
            WORKING_SHARE * np.array([np.hypot(s.zero, s.tape) for s in sizes]),
            site.radius,
            rs,
            free,
        )
        found = climb_site(state, noise, sights, Surveyed(), priors)
        lap("climb")
        patches = patches_of(scans)
        lap("patches")
        none = np.zeros(0, dtype=np.int64)
        bands = bands_of(sights, [none if p is None else np.unique(p.bands) for p in patches])
        network = observe(found.point, sights, poles, Surveyed(), site, bands, free)
        lap("expand")
        eg = network.unknowns.groups()
        known = known_sigmas(eg, sizes, rs)
        ready = scene_pairs(patches, groups[0])
        end = refine_site(network, ready, eg, known)
        lap("refine")
    return dict(
        scans=scans,
        pairs=pairs,
        choices=choices,
        poles=poles,
        found=found,
        network=network,
        end=end,
        seconds=seconds,
    )


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
