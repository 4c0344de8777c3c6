"""Every observation tested against all others: which one does not fit, and what would go unseen.

Data snooping (Baarda 1968): an observation gets a bias of its own beside all unknowns. How much
the fit would improve is its test (score test, Rao 1948), a χ² with as many degrees of freedom as
the error has; how well the others determine that error is its redundancy, and tells the least
error that the test finds.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc, erfcinv

from ..alignment.certainty import excess
from ..alignment.unknowns import POSE
from ..base.datatypes import Array
from ..base.description import Site
from ..base.uncertainty.purpose import DEFAULT_AT
from .answer import Test
from .biases import (
    Bias,
    lidar_apart,
    placement_moved,
    pole_moved,
    pole_seen_elsewhere,
    splits,
    value_wrong,
)
from .shared import SharedPole
from .solved import Solved

NONCENTRALITY = 17.07
"""Of a test at 0.1 % with a power of 80 %: (3.29 + 0.84)² (Baarda 1968)."""

LEAST_CHECKED = 1e-9
"""Part of an error's own information below which the others do not determine it at all."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """How a bias of its own was tested; see `answer.Test`."""

    chi2: float
    w: float
    redundancy: float
    minimal_detectable: float | None
    external: float | None


def normalised(chi2: float, freedom: int, among: int = 1) -> float:
    """Give a χ², the largest of some, as a standard normal number of the same probability."""
    p = min(among * float(chdtrc(freedom, chi2)), 1.0)
    return float(np.sqrt(2.0) * erfcinv(p)) if p > 0 else float(np.sqrt(chi2))


def outcome(at: Solved, error: Bias, unit: float) -> Outcome:
    """Test a bias of its own against all other observations.

    Parameters
    ----------
    at
        The answer.
    error
        That is tested.
    unit
        Metres for each of its lengths, where it is counted in σ.
    """
    taken_up = at.inverse @ error.cross
    left = error.own - error.cross.T @ taken_up
    # What is considered moves the slope by so much.
    by = error.wide - taken_up.T @ at.by_wide
    # And the scene's patches, correlated as they are, by more than their information says.
    by_scene = error.cross.T @ at.scene
    scatter = excess(by_scene @ by_scene.T, taken_up.T @ at.scene_information @ taken_up)
    spread = left + by @ by.T + scatter
    # Of what nothing checks only rounding is left: none of it is a test.
    least_checked = LEAST_CHECKED * max(float(np.diag(error.own).max()), 1e-300)
    size, way = np.linalg.eigh(spread)
    told = size > least_checked
    # All else follows: what the iterations left of its slope counts where little is tested.
    along = way.T @ (error.slope - taken_up.T @ at.remainder)
    chi2 = float(np.sum(along[told] ** 2 / size[told]))
    # An error ∇ moves the slope by S ∇.
    seen = (way[:, told].T @ left) / np.sqrt(size[told])[:, None]
    w = normalised(chi2, error.freedom)
    size, way = np.linalg.eigh(error.own)
    whole = size > LEAST_CHECKED * size[-1]
    inverse = (way[:, whole] / size[whole]) @ way[:, whole].T
    redundancy = float(
        np.clip(np.trace(inverse @ left) / max(np.count_nonzero(whole), 1), 0.0, 1.0)
    )
    of_lengths = seen[:, error.metres]
    size, way = np.linalg.eigh(of_lengths.T @ of_lengths)
    # Moved together, all LiDARs' poles are the pole itself: only differences count.
    found = np.flatnonzero(size > least_checked)
    if not len(found):
        return Outcome(chi2, w, redundancy, None, None)
    least, direction = float(size[found[0]]), way[:, found[0]]
    detectable = float(np.sqrt(NONCENTRALITY / least))
    moved = -taken_up[:, error.metres] @ (detectable * direction)
    return Outcome(chi2, w, redundancy, unit * detectable, _at_range(moved, at))


def _at_range(step: Array, at: Solved) -> float:
    """Farthest that a step of the unknowns moves a point at `DEFAULT_AT` of a LiDAR, metres."""
    poses = step[: at.network.unknowns.poses].reshape(-1, POSE)
    turned = DEFAULT_AT * np.linalg.norm(poses[:, :3], axis=1)
    return float((turned + np.linalg.norm(poses[:, 3:], axis=1)).max())


def all_tests(
    at: Solved, site: Site, poles: Sequence[SharedPole], astray: Mapping[tuple[int, int], float]
) -> Iterator[Test]:
    """Test every observation: poles, each LiDAR's view of them, placements, LiDARs, the survey.

    Parameters
    ----------
    at
        The answer.
    site, poles
        For names, and who sees which pole.
    astray
        From `astray.astray`: by LiDAR and pole the χ² of returns that lie beside it.
    """
    names = [lidar.name for lidar in site.lidars]
    for k in range(len(poles)):
        yield from _pole_tests(at, poles[k].name(site), k, poles[k].placement, names, astray)
    for one in at.network.observations:
        # Where the place puts a LiDAR nobody observed: it is only as wide as the poles need it.
        if one.kind == "pose":
            continue
        if one.poles is None:
            error = value_wrong(at, one)
            assert one.by_value is not None
            unit = one.by_value[2]
            assert one.kind != "returns"
            yield _test(one.kind, one.name, one.lidar, None, None, error, outcome(at, error, unit))
            continue
        assert one.lidar is not None
        assert one.placement is not None
        stood = placement_moved(at, one)
        name = f"{names[one.lidar]} in placement {site.placements[one.placement]}"
        yield _test(
            "placement", name, one.lidar, one.placement, None, stood, outcome(at, stood, 1.0)
        )
    for lidar in range(len(names)):
        apart = lidar_apart(at, lidar)
        if apart is not None:
            yield _test("lidar", names[lidar], lidar, None, None, apart, outcome(at, apart, 1.0))


def _pole_tests(
    at: Solved,
    name: str,
    pole: int,
    placement: int,
    names: Sequence[str],
    astray: Mapping[tuple[int, int], float],
) -> Iterator[Test]:
    """Test a pole: as a whole, as each LiDAR sees it, and parted as is likeliest."""
    moved = pole_moved(at, pole)
    views = [one for one in at.network.observations if one.poles is not None and pole in one.poles]
    if moved is not None:
        yield _test("pole", name, None, placement, pole, moved, outcome(at, moved, 1.0))
    for one in views:
        assert one.lidar is not None
        beside = astray.get((one.lidar, pole))
        # That one LiDAR alone sees, its survey checks.
        if len(views) != 2 or beside is not None:
            seen = pole_seen_elsewhere(at, [one], pole)
            found = outcome(at, seen, 1.0)
            if beside is not None and beside > found.chi2:
                found = replace(found, chi2=beside, w=normalised(beside, seen.freedom))
            of_one = f"{name} as {names[one.lidar]} sees it"
            yield _test("pole", of_one, one.lidar, placement, pole, seen, found)
    parted = [
        (part, pole_seen_elsewhere(at, [views[i] for i in part], pole))
        for part in splits(len(views))
    ]
    if parted:
        found, part, seen = max(
            ((outcome(at, seen, 1.0), part, seen) for part, seen in parted),
            key=lambda each: each[0].chi2,
        )
        found = replace(found, w=normalised(found.chi2, seen.freedom, len(parted)))
        some = ", ".join(names[i] for i in (views[j].lidar for j in part) if i is not None)
        yield _test("pole", f"{name} as {some} see it", None, placement, pole, seen, found)


def _test(
    kind: str,
    name: str,
    lidar: int | None,
    placement: int | None,
    pole: int | None,
    error: Bias,
    found: Outcome,
) -> Test:
    return Test(
        kind,  # type: ignore[arg-type]
        name,
        lidar,
        placement,
        pole,
        found.chi2,
        error.freedom,
        found.w,
        found.redundancy,
        found.minimal_detectable,
        found.external,
    )
