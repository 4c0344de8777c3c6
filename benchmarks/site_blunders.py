"""What goes wrong at a simulated site: a pole is bumped, files are swapped, a point is off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from msgspec import structs
from scipy.linalg import block_diag

from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.base.description import SurveyedPole
from retropole.base.errors import UsageError
from retropole.simulation.raycast import Cylinder
from retropole.simulation.scenes import UP
from retropole.simulation.site_places import Seen, are_linked, arrange
from retropole.simulation.sites import (
    DrawnSite,
    SimulatedSite,
    Survey,
    Surveyed,
    draw_site,
    record_site,
)
from retropole.simulation.writing import write_site

BLUNDERS = "pole", "slide", "files", "control"
"""What can go wrong."""

BUMP_SHIFT = 0.03, 0.15
"""Least and greatest distance by which a pole is pushed, metres."""

BUMP_TURN = float(np.radians(1.0)), float(np.radians(5.0))
"""Least and greatest angle by which a pole is tilted about its foot, rad."""

CONTROL_OFFSET = 0.1
"""By how much a surveyed point is off, metres."""

SEPARABLE = 25.0
"""χ² by which no other surveyed point explains it as well: 5 σ."""

MAX_OFFSETS = 50
"""Draws of what is off in a survey, until no other point explains it as well."""

MAX_UNCHECKED = 12
"""Arrangements that are drawn for one where the others check a blunder."""

LEAST_CHECKED = 1e-6
"""Part of what is known of a point best, below which the others say nothing of it."""

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Blunder:
    """What is wrong at a site; indices are those of the site.

    Attributes
    ----------
    kind
        ``pole``, ``files`` or ``control``.
    name
        In words.
    lidars
        Of a bumped pole those that recorded after it moved; of files those whose they are.
    placements
        That it is about; of files between two placements both.
    pole
        Index in its placement; None where it is about none.
    surveyed, end, point
        Index of the surveyed pole and which end, or of the control point; None where about none.
    moved
        (4, 4) how the pole moved in the world; None for the others.
    offset
        (3,) by how much a surveyed point is off, metres; None for the others.
    checked
        Whether poles link all LiDARs without what is wrong; of a survey, whether no other point
        explains it as well.
    """

    kind: Literal["pole", "files", "control"]
    name: str
    lidars: tuple[int, ...] = ()
    placements: tuple[int, ...] = ()
    pole: int | None = None
    surveyed: int | None = None
    end: Literal["foot", "top"] | None = None
    point: int | None = None
    moved: Array | None = None
    offset: Array | None = None
    checked: bool = True


def simulate_blunder(
    kind: str,
    rng: np.random.Generator,
    blunder: str,
    *,
    placements: int | None = None,
    survey: Survey | None = None,
    frames: int = 1,
    **options: Any,
) -> tuple[SimulatedSite, Blunder]:
    """Simulate a site as `simulate_site` does, with one thing wrong.

    Where it can be, it is one that the others check. Poles of the site stand as they stood first,
    and `SimulatedSite.seen` is of what was recorded, before files were swapped; recordings and
    labels are swapped, and surveyed points are where they are stated to be.

    Parameters
    ----------
    kind, rng, placements, survey, frames, **options
        As of `simulate_site`. With equal generators a site has the same LiDARs with the same errors
        as without a blunder, and stands the same where the first draw has one that others check.
    blunder
        One of `BLUNDERS`: ``pole``, a pole is bumped between two recordings of one placement, and
        those that record later see it elsewhere; ``slide``, it is pushed such that its angle and
        distance to another do not change; ``files``, two recordings are swapped; ``control``, a
        surveyed point is off by 0.1 m.

    Raises
    ------
    UsageError
        An unknown blunder, or one that such a site cannot have; and as of `simulate_site`.
    SimulationError
        As of `simulate_site`.
    """
    if blunder not in BLUNDERS:
        raise UsageError(f"no blunder is called {blunder!r}; there are {', '.join(BLUNDERS)}")
    if blunder == "files" and placements == 1:
        raise UsageError("files are swapped where there are two placements or more")
    if blunder == "control" and (survey is None or not (survey.placements or survey.points)):
        raise UsageError("a control point can only be wrong where something is surveyed")
    drawn = draw_site(kind, rng, placements=placements, **options)
    wrong = choose(blunder, drawn)
    for _ in range(MAX_UNCHECKED):
        if wrong.checked:
            break
        poles = drawn.at.poles
        again = arrange(kind, rng, drawn.sensors, len(poles), len(poles[0]), drawn.radius)
        drawn = replace(drawn, at=again)
        wrong = choose(blunder, drawn)
    standing = [
        [disturbed(poles, wrong, lidar, p) for p, poles in enumerate(drawn.at.poles)]
        for lidar in range(len(drawn.sensors))
    ]
    site = record_site(drawn, survey=survey, frames=frames, standing=standing)
    if wrong.kind == "files":
        clouds, labels = swapped(site.clouds, wrong), swapped(site.labels, wrong)
        site = replace(site, clouds=clouds, labels=labels)
    if wrong.kind == "control":
        stated, wrong = resurveyed((site.surveyed, site.points), drawn.for_changes)
        site = replace(site, surveyed=stated[0], points=stated[1])
    return site, wrong


def choose(kind: str, drawn: DrawnSite) -> Blunder:
    """Draw what goes wrong, rather such that the others check it; a survey's comes after it."""
    if kind == "control":
        return Blunder("control", "")
    if kind == "files":
        return _exchange(drawn.at.seen, drawn.at.recorded, drawn.for_changes)
    return _bump(drawn.at.poles, drawn.at.seen, drawn.for_changes, slides=kind == "slide")


def _bump(
    poles: Sequence[Sequence[Cylinder]], seen: Seen, rng: np.random.Generator, *, slides: bool
) -> Blunder:
    """Push or tilt a pole; one that slides, such that another one's angle and distance stay."""
    count = len(seen[0])
    both = [
        (p, k)
        for p, own in enumerate(poles)
        for k in range(len(own))
        if sum(view[k] for view in seen[p]) >= 2
    ]
    checked = [at for at in both if are_linked(_without(seen, [(at[0], None, at[1])]), count)]
    p, k = (checked or both)[int(rng.integers(len(checked or both)))]
    who = [lidar for lidar in range(count) if seen[p][lidar][k]]
    # LiDARs record in their order; one that sees the pole is the first to see it elsewhere.
    first = who[int(rng.integers(1, len(who)))]
    pole = poles[p][k]
    if slides:
        other = poles[p][(k + int(rng.integers(1, len(poles[p])))) % len(poles[p])]
        level = np.cross(np.cross(pole.axis, other.axis), UP)
        level *= rng.choice([-1.0, 1.0]) / np.linalg.norm(level)
    else:
        heading = rng.uniform(0, 2 * np.pi)
        level = np.array([np.cos(heading), np.sin(heading), 0.0])
    across = level - pole.axis * (level @ pole.axis)
    shift, turn = rng.uniform(*BUMP_SHIFT), rng.uniform(*BUMP_TURN)
    if slides:
        moved = se3.from_rt(np.eye(3), shift * level)
        how = f"pushed by {100 * shift:.1f} cm in the plane of another"
    elif rng.uniform() < 0.5:
        moved = se3.from_rt(np.eye(3), shift * across / np.linalg.norm(across))
        how = f"pushed by {100 * shift:.1f} cm"
    else:
        about = np.cross(UP, across)
        foot = pole.centre - pole.axis * pole.length / 2
        # About an axis across the pole: about its own it would not show.
        about -= pole.axis * (about @ pole.axis)
        R = se3.exp_so3(turn * about / np.linalg.norm(about))
        moved = se3.from_rt(R, foot - R @ foot)
        how = f"tilted by {np.degrees(turn):.1f}°"
    return Blunder(
        "pole",
        f"pole {k + 1} of placement {p + 1} {how} before LiDAR {first + 1} recorded it",
        lidars=tuple(range(first, count)),
        placements=(p,),
        pole=k,
        moved=moved,
        checked=bool(checked),
    )


def _exchange(seen: Seen, recorded: Sequence[tuple[int, ...]], rng: np.random.Generator) -> Blunder:
    """Swap two recordings of one placement, or of one LiDAR."""
    count = len(seen[0])
    two = [((a, b), (p,)) for p, who in enumerate(recorded) for a, b in combinations(who, 2)]
    one = [
        ((lidar,), (p, q))
        for p, q in combinations(range(len(recorded)), 2)
        for lidar in range(count)
        if lidar in recorded[p] and lidar in recorded[q]
    ]
    of_two = rng.uniform() < 0.5 or not one
    choices: list[tuple[tuple[int, ...], tuple[int, ...]]] = [*two] if of_two else [*one]
    # Of a file with no two poles that another LiDAR sees as well nothing shows that it is wrong.
    shown = [
        own
        for own in choices
        if all(_shares_two(seen[p], lidar) for lidar in own[0] for p in own[1])
    ]
    choices = shown or choices
    checked = [
        own
        for own in shown
        if are_linked(_without(seen, [(p, lidar, None) for lidar in own[0] for p in own[1]]), count)
    ]
    lidars, placements = (checked or choices)[int(rng.integers(len(checked or choices)))]
    name = (
        f"recordings of LiDARs {lidars[0] + 1} and {lidars[1] + 1} of placement "
        f"{placements[0] + 1} swapped"
        if len(lidars) == 2
        else f"recordings of placements {placements[0] + 1} and {placements[1] + 1} of LiDAR "
        f"{lidars[0] + 1} swapped"
    )
    return Blunder("files", name, lidars, placements, checked=bool(checked))


def _shares_two(seen: Sequence[Sequence[bool]], lidar: int) -> bool:
    """Whether another LiDAR sees two of the poles that one sees in a placement."""
    return any(
        sum(a and b for a, b in zip(seen[lidar], own, strict=True)) >= 2
        for other, own in enumerate(seen)
        if other != lidar
    )


def _without(
    seen: Seen, hidden: Sequence[tuple[int, int | None, int | None]]
) -> list[list[list[bool]]]:
    """Who sees what without some (placement, LiDAR, pole), where None is all of them."""
    left = [[list(own) for own in view] for view in seen]
    for p, lidar, pole in hidden:
        for a, view in enumerate(left[p]):
            if lidar in (None, a):
                left[p][a] = [own and pole not in (None, k) for k, own in enumerate(view)]
    return left


def disturbed(
    poles: Sequence[Cylinder], wrong: Blunder, lidar: int, placement: int
) -> list[Cylinder]:
    """The poles of a placement as they stand when a LiDAR records it."""
    standing = list(poles)
    if (
        wrong.moved is not None
        and wrong.pole is not None
        and placement in wrong.placements
        and lidar in wrong.lidars
    ):
        pole = standing[wrong.pole]
        standing[wrong.pole] = replace(
            pole,
            centre=se3.apply(wrong.moved, pole.centre[None])[0],
            axis=wrong.moved[:3, :3] @ pole.axis,
        )
    return standing


def swapped(recordings: Sequence[Sequence[T]], wrong: Blunder) -> tuple[tuple[T, ...], ...]:
    """Swap two of ``recordings[lidar][placement]``."""
    rows = [list(own) for own in recordings]
    a, p = wrong.lidars[0], wrong.placements[0]
    b, q = wrong.lidars[-1], wrong.placements[-1]
    rows[a][p], rows[b][q] = rows[b][q], rows[a][p]
    return tuple(tuple(own) for own in rows)


def resurveyed(stated: Surveyed, rng: np.random.Generator) -> tuple[Surveyed, Blunder]:
    """Move one surveyed point by `CONTROL_OFFSET`; the end of a pole across its axis.

    Along the axis nobody sees where a surveyed point lies on it. Rather one is drawn that the
    others tell apart: of four points nearly in one plane one number alone checks the heights.
    """
    ends = 2 * len(stated[0])
    for _ in range(MAX_OFFSETS):
        which = int(rng.integers(ends + len(stated[1])))
        step = rng.normal(size=3)
        if which < ends:
            axis = axis_of(stated[0][which // 2])
            step -= axis * (step @ axis)
        offset = CONTROL_OFFSET * step / np.linalg.norm(step)
        checked = told_apart(stated, which, offset) > SEPARABLE
        if checked:
            break
    return _moved(stated, which, offset, checked)


def _moved(stated: Surveyed, which: int, offset: Array, checked: bool) -> tuple[Surveyed, Blunder]:
    surveyed, points = list(stated[0]), list(stated[1])
    k = which - 2 * len(surveyed)
    if k >= 0:
        points[k] = structs.replace(points[k], at=points[k].at + offset)
        blunder = Blunder(
            "control",
            f"control point {points[k].name} off by 0.1 m",
            point=k,
            offset=offset,
            checked=checked,
        )
        return (tuple(surveyed), tuple(points)), blunder
    k = which // 2
    own = surveyed[k]
    assert own.foot is not None
    assert own.top is not None
    end: Literal["foot", "top"] = "top" if which % 2 else "foot"
    surveyed[k] = (
        structs.replace(own, foot=own.foot + offset)
        if end == "foot"
        else structs.replace(own, top=own.top + offset)
    )
    blunder = Blunder(
        "control",
        f"{end} of surveyed pole {own.name} off by 0.1 m",
        placements=(own.placement,),
        surveyed=k,
        end=end,
        offset=offset,
        checked=checked,
    )
    return (tuple(surveyed), tuple(points)), blunder


def axis_of(pole: SurveyedPole) -> Array:
    """(3,) direction of a pole whose ends are both surveyed, from foot to top."""
    assert pole.foot is not None
    assert pole.top is not None
    along = pole.top - pole.foot
    return np.asarray(along / np.linalg.norm(along))


def told_apart(stated: Surveyed, which: int, offset: Array) -> float:
    """χ² that an offset of one point leaves where any other point is taken for the one that is off.

    The LiDARs are one rigid body, which six of the coordinates place in the world: what the others
    say against an offset is theirs together (Förstner 1983).

    Parameters
    ----------
    stated
        Poles and control points.
    which
        Whose: foot and top of each pole in turn, then the control points.
    offset
        (3,) in metres.
    """
    at, weights = [], []
    for pole in stated[0]:
        axis = axis_of(pole)
        for end in (pole.foot, pole.top):
            assert end is not None
            at.append(end)
            # Along its axis nobody sees where an end is.
            weights.append((np.eye(3) - np.outer(axis, axis)) / pole.sigma**2)
    for point in stated[1]:
        at.append(point.at)
        sighted = 1.0 / sum(own.sigma**-2 for own in point.seen)
        weights.append(np.eye(3) / (point.sigma**2 + sighted))
    W = block_diag(*weights)
    middle = np.mean(at, axis=0)
    A = np.vstack([np.hstack([-se3.hat(own - middle), np.eye(3)]) for own in at])
    left = W - W @ A @ np.linalg.pinv(A.T @ W @ A, hermitian=True) @ A.T @ W
    blocks = [slice(3 * k, 3 * k + 3) for k in range(len(at))]
    slopes = left[:, blocks[which]] @ offset
    chi2 = [
        slopes[own]
        @ np.linalg.pinv(left[own, own], rcond=LEAST_CHECKED, hermitian=True)
        @ slopes[own]
        for own in blocks
    ]
    return float(chi2.pop(which) - max(chi2, default=0.0))


def write_blunder(site: SimulatedSite, wrong: Blunder, out: Path) -> None:
    """Write a site as `write_site` does; ``truth.json`` says what is wrong, too."""
    blunder = {
        "kind": wrong.kind,
        "name": wrong.name,
        "lidars": [site.names[k] for k in wrong.lidars],
        "placements": [site.placements[k] for k in wrong.placements],
        "pole": None if wrong.pole is None else wrong.pole + 1,
        "surveyed_pole": None if wrong.surveyed is None else site.surveyed[wrong.surveyed].name,
        "end": wrong.end,
        "control_point": None if wrong.point is None else site.points[wrong.point].name,
        "moved": None if wrong.moved is None else wrong.moved.tolist(),
        "offset_m": None if wrong.offset is None else wrong.offset.tolist(),
        "checked": wrong.checked,
    }
    write_site(site, out, {"blunder": blunder})
