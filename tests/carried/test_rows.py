"""Rows of exact hits: their depth and their middle are as close to the axis as they are said."""

from dataclasses import replace

import numpy as np

from retropole.base.datatypes import Array
from retropole.carried.rows import Open, Rows, left_open, rows_of
from tests.carried.walks import RADIUS, STEP, axis_at, seen_walk


def off_axis(rows: Rows) -> tuple[Array, Array, Open]:
    """How far rows of the target are off the true axis, along beams and across, metres."""
    middle, n = axis_at(rows.times)
    d = rows.directions
    across = d - np.einsum("ni,ni->n", d, n)[:, None] * n
    sideways = np.linalg.norm(across, axis=1)
    b1 = across / sideways[:, None]
    b2 = np.cross(n, b1)
    east = np.stack([-d[:, 1], d[:, 0], 0 * d[:, 0]], axis=1)
    lever = np.abs(np.einsum("ni,ni->n", east, b2)) * rows.ranges
    left = left_open(rows, lever, RADIUS)
    off = rows.ranges[:, None] * d - middle
    return (
        np.einsum("ni,ni->n", off, b1) + left.depth,
        np.einsum("ni,ni->n", off, b2),
        left,
    )


def test_rows_are_off_by_what_their_hits_leave_open() -> None:
    rows = rows_of(seen_walk().tracks[0], None, RADIUS)
    along, across, left = off_axis(rows)
    sigma, known = left.sigma, np.isfinite(left.sigma)
    assert known.mean() > 0.97
    assert abs(rows.step - STEP) < 1e-9
    assert abs(along[known].mean()) < 1e-4
    assert 0.85 < np.std(across[known] / sigma[known]) < 1.4


def test_rows_of_single_returns_share_what_they_leave_open() -> None:
    """A column of returns says once where the pole is, and how deep it is hit no better."""
    track = seen_walk().tracks[0]
    rows = rows_of(replace(track, rings=np.full(len(track.rings), -1)), None, RADIUS)
    # Exact beams have no width, and the rows' noise must not hide the depth.
    along, across, left = off_axis(replace(rows, divergence=0.0))
    known = np.isfinite(left.sigma)
    assert known.mean() > 0.95
    assert 2.0 <= np.sum(1 / rows.sharing) / len(track.times) < 2.5
    share = 1 / rows.sharing[known]
    across, along = across[known] / left.sigma[known], along[known] / left.depth_sigma[known]
    assert 0.7 < np.sqrt(np.sum(share * across**2) / share.sum()) < 1.3
    assert 0.5 < np.sqrt(np.sum(share * along**2) / share.sum()) < 1.5


def test_the_width_of_beams_is_seen_in_the_width_of_the_pole() -> None:
    assert rows_of(seen_walk().tracks[0], None, RADIUS).divergence < 5e-4


def test_which_rows_lack_hits_does_not_depend_on_the_width_found() -> None:
    """A width that is found from rows that it chooses itself goes to and fro."""
    rows = replace(rows_of(seen_walk().tracks[0], None, RADIUS), divergence=0.003)
    lever = rows.ranges
    lacking = [~np.isfinite(left_open(rows, lever, RADIUS, wider).sigma) for wider in (0.0, 0.5)]
    assert 0 < lacking[0].sum() < len(lever)
    assert np.array_equal(lacking[0], lacking[1])


def test_rings_with_one_azimuth_share_what_they_leave_open() -> None:
    leaning = rows_of(seen_walk(6.0).tracks[0], None, RADIUS).sharing
    upright = rows_of(seen_walk(6.0, lean=0.0).tracks[0], None, RADIUS).sharing
    assert np.median(upright) > 2 * np.median(leaning)
