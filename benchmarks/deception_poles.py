"""Recordings in which the poles agree with each other and not with the place, for `deception`.

Every function draws what is recorded at a site, or gives None where this draw has nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from deception_sites import (
    Shot,
    Site,
    about_vertical,
    carried,
    foot_of,
    leaning,
    on_foot,
)
from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.simulation import Box, Cylinder
from retropole.simulation.scenes import BARK, METAL, SURROUNDINGS, TAPE, UP


@dataclass(frozen=True, eq=False)
class Drawn:
    """What is recorded: target and source of each placement, the truths, and the lie if any."""

    shots: tuple[tuple[Shot, Shot], ...]
    truths: tuple[Array, ...]
    lie: Array | None = None


def honest(site: Site, rng: np.random.Generator) -> Drawn:
    return Drawn(((site.shot(0), site.shot(1)),), (site.truth,))


def carry(site: Site, G: Array) -> Drawn | None:
    """Carry all poles between the recordings."""
    poles = [carried(pole, G) for pole in site.poles]
    if not site.allows(*(foot_of(pole) for pole in poles)):
        return None
    shots = site.shot(0), replace(site.shot(1), poles=poles)
    return Drawn((shots,), (site.truth,), _lie(site, G))


def _lie(site: Site, G: Array) -> Array:
    """The pose of poles that are taken to stand where they were before a motion of the world."""
    return se3.inverse(site.poses[0]) @ se3.inverse(G) @ site.poses[1]


def anywhere(site: Site, rng: np.random.Generator) -> Array:
    """A motion of the world that carries the poles' middle anywhere, turned by any angle."""
    to = rng.uniform(-1, 1, 2) * site.clear
    return about_vertical(rng.uniform(0, 2 * np.pi), _middle(site), to - _middle(site)[:2])


def _middle(site: Site) -> Array:
    return np.asarray(np.mean([foot_of(pole) for pole in site.poles], axis=0))


def carried_elsewhere(site: Site, rng: np.random.Generator) -> Drawn | None:
    return carry(site, anywhere(site, rng))


def carried_along(site: Site, rng: np.random.Generator) -> Drawn | None:
    """Along the corridor or street, which looks much the same there."""
    return carry(site, about_vertical(0.0, np.zeros(3), np.r_[sign(rng) * rng.uniform(1, 5), 0]))


def nudged(site: Site, rng: np.random.Generator) -> Drawn | None:
    """Shoved by little together, as on one stand."""
    bearing, far = rng.uniform(0, 2 * np.pi), rng.uniform(0.35, 0.9)
    shift = far * np.array([np.cos(bearing), np.sin(bearing)])
    turn = float(np.radians(rng.uniform(-5, 5)))
    return carry(site, about_vertical(turn, _middle(site), shift))


def turned_about_upright(site: Site, rng: np.random.Generator) -> Drawn | None:
    return carry(site, _turn_about_first(site, rng))


def _turn_about_first(site: Site, rng: np.random.Generator) -> Array:
    angle = float(np.radians(rng.uniform(20, 340)))
    return about_vertical(angle, foot_of(site.poles[0]), np.zeros(2))


def walker_with_band(site: Site, rng: np.random.Generator) -> Drawn | None:
    """The band walks by 0.3 to 1.5 m; in half of the draws along the pole's lean.

    The lines then keep their distance, so that a wrong pose fits them. The band is worn, or held up
    to 0.5 m off the body: worn close it is part of a surface, and no pole.
    """
    pole, band = site.poles
    bearing, far = rng.uniform(0, 2 * np.pi), rng.uniform(0.3, 1.5)
    if rng.uniform() < 0.5:
        bearing = float(np.arctan2(pole.axis[1], pole.axis[0])) + np.pi * rng.integers(2)
    step = far * np.array([np.cos(bearing), np.sin(bearing), 0.0])
    there = replace(band, centre=band.centre + step)
    if not site.allows(there.centre):
        return None
    yaw, off = rng.uniform(0, 2 * np.pi), float(rng.uniform(0.0, 0.5))
    half = np.array([0.12, rng.uniform(0.15, 0.25), rng.uniform(0.75, 0.95)])
    shots = [
        replace(site.shot(k), poles=[pole, each]).with_things(_body(each, yaw, off, half))
        for k, each in enumerate((band, there))
    ]
    return Drawn(((shots[0], shots[1]),), (site.truth,), _slid(site, pole, step))


def _slid(site: Site, pole: Cylinder, step: Array) -> Array | None:
    """The pose that slides the pole along itself by as much as the band walked along its lean."""
    lean = pole.axis[:2] @ pole.axis[:2]
    if abs(float(np.cross(np.r_[pole.axis[:2], 0.0], step)[2])) > 1e-9:
        return None
    along = float(pole.axis[:2] @ step[:2]) / lean
    return _lie(site, se3.from_rt(np.eye(3), along * pole.axis))


def _body(band: Cylinder, yaw: float, off: float, half: Array) -> Box:
    """A person, so far behind the band; half of a worn one is sunk in."""
    ahead = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    axes = np.stack([ahead, np.cross(UP, ahead), UP], axis=1)
    at = band.centre - (half[0] + off) * ahead
    return Box(np.r_[at[:2], half[2]], axes, half, BARK)


def one_pole_moved(site: Site, rng: np.random.Generator) -> Drawn:
    k, poles = int(rng.integers(2)), list(site.poles)
    bearing = rng.uniform(0, 2 * np.pi)
    if rng.uniform() < 0.5:
        shift = rng.uniform(0.03, 0.2) * np.array([np.cos(bearing), np.sin(bearing)])
        poles[k] = carried(poles[k], about_vertical(0.0, np.zeros(3), shift))
    else:
        foot, phi = foot_of(poles[k]), np.radians(rng.uniform(1, 3))
        R = se3.exp_so3(phi * np.array([np.cos(bearing), np.sin(bearing), 0.0]))
        poles[k] = carried(poles[k], se3.from_rt(R, foot - R @ foot))
    shots = site.shot(0), replace(site.shot(1), poles=poles)
    return Drawn((shots,), (site.truth,))


def sign(rng: np.random.Generator) -> float:
    return float(rng.choice([-1.0, 1.0]))


def other_place(site: Site, rng: np.random.Generator) -> Drawn | None:
    """The source's file is of another place, half of the draws of another sort, same poles."""
    names = [site.scene] if rng.uniform() < 0.5 else sorted(SURROUNDINGS)
    place = SURROUNDINGS[names[int(rng.integers(len(names)))]](rng)
    drawn = carry(replace(site, clear=place.clear), anywhere(site, rng))
    if drawn is None or min(place.clear) <= 0:
        return None
    target, source = drawn.shots[0]
    shots = target, replace(source, surroundings=place.surfaces)
    return replace(drawn, shots=(shots,), truths=())


def decoy(site: Site, rng: np.random.Generator) -> Drawn | None:
    """Panels hide the leaning pole from the source, and its like, turned, from the target."""
    upright, pole = site.poles
    other = carried(pole, _turn_about_first(site, rng))
    if not site.allows(foot_of(other)):
        return None
    eyes = [pose[:3, 3] for pose in site.poses]
    panels = _panel(other, eyes[0]), _panel(pole, eyes[1])
    shots = [
        replace(site.shot(k), poles=[upright, seen]).with_things(*panels, hidden)
        for k, (seen, hidden) in enumerate(((pole, other), (other, pole)))
    ]
    lie = _lie(site, _motion(pole, other))
    return Drawn(((shots[0], shots[1]),), (site.truth,), lie)


def _panel(pole: Cylinder, eye: Array) -> Box:
    """A board, 2.6 m high, that hides a pole from a LiDAR at an eye."""
    toward = (eye - pole.centre) * np.array([1.0, 1.0, 0.0])
    toward /= np.linalg.norm(toward)
    tip = pole.length / 2 * pole.axis
    reach, side = (abs(float(tip @ each)) for each in (toward, np.cross(UP, toward)))
    axes = np.stack([toward, np.cross(UP, toward), UP], axis=1)
    at = np.r_[(pole.centre + (reach + 0.25) * toward)[:2], 1.3]
    return Box(at, axes, np.array([0.02, side + 0.25, 1.3]), METAL)


def _motion(pole: Cylinder, other: Cylinder) -> Array:
    """Turn about a vertical (4, 4) that carries a leaning pole to another of the same lean."""
    bearings = [float(np.arctan2(each.axis[1], each.axis[0])) for each in (pole, other)]
    G = about_vertical(bearings[1] - bearings[0], np.zeros(3), np.zeros(2))
    G[:3, 3] = other.centre - G[:3, :3] @ pole.centre
    return G


def swapped_by_hand(site: Site, rng: np.random.Generator) -> Drawn:
    """Each pole is set up on the other's foot, leaning as it did."""
    first, second = site.poles
    poles = [
        on_foot(foot_of(second), first.axis, first.length),
        on_foot(foot_of(first), second.axis, second.length),
    ]
    return Drawn(((site.shot(0), replace(site.shot(1), poles=poles)),), (site.truth,))


def tape_fallen_off(site: Site, rng: np.random.Generator) -> Drawn | None:
    """Of three poles one is bare when the source records, and its tape lies beside it."""
    k = int(rng.integers(3))
    bare, poles = site.poles[k], [pole for i, pole in enumerate(site.poles) if i != k]
    length, bearing = float(rng.uniform(0.5, 1.8)), rng.uniform(0, 2 * np.pi)
    flat = leaning(np.pi / 2 - 0.02, bearing)
    at = foot_of(bare)[:2] + rng.uniform(-0.6, 0.6, 2)
    if not site.allows(np.r_[at, 0.0]):
        return None
    strip = Cylinder(np.r_[at, 0.05], flat, 0.02, length, TAPE)
    source = replace(site.shot(1), poles=poles).with_things(replace(bare, material=METAL), strip)
    return Drawn(((site.shot(0), source),), (site.truth,))


def placements_mixed_up(site: Site, rng: np.random.Generator) -> Drawn | None:
    """Two placements of poles on one stand; the source's files come in the wrong order.

    In half of the draws the stand was turned by half a turn: both mixed placements then tell the
    same lie.
    """
    G = anywhere(site, rng)
    if rng.uniform() < 0.5:
        to = rng.uniform(-1, 1, 2) * site.clear
        G = about_vertical(np.pi, _middle(site), to - _middle(site)[:2])
    other = carry(site, G)
    if other is None:
        return None
    poles = other.shots[0][1].poles
    there = replace(site.shot(0), poles=poles), replace(site.shot(1), poles=poles)
    return Drawn(((site.shot(0), there[1]), (there[0], site.shot(1))), (site.truth,), other.lie)


def two_of_three_carried(site: Site, rng: np.random.Generator) -> Drawn | None:
    """The third stays where it was: the majority lies."""
    drawn = carry(replace(site, poles=site.poles[:2]), anywhere(site, rng))
    if drawn is None:
        return None
    target, source = site.shot(0), drawn.shots[0][1]
    poles = [*source.poles, site.poles[2]]
    return replace(drawn, shots=((target, replace(source, poles=poles)),))
