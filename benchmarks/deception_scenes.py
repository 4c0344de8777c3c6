"""Recordings that deceive, each kind drawn by a function of its own, for `deception`.

The poles agree with each other and not with the place, or something else is wrong that the poles
do not show; some kinds are honest and only hard. The truth is the pose of the source in the
target's frame while they recorded. An answer is stated for all that was handed over: where a LiDAR
was moved or bumped in between, there are two truths, and only an answer near both is right. Of
clouds that no rigid motion lays on each other (a mirrored one) and of files of two different places
no answer is right. A cloud in other units leaves its pose in metres as the truth.

A kind also gives the lie, where it has one: the pose that the poles have as if they had stood.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from deception_one_pole import (
    another_pole,
    carried_from_post_to_post,
    container_shoved,
    turned_about_foot,
    two_rows_of_posts,
    upright_in_the_middle,
)
from deception_poles import (
    Drawn,
    carried_along,
    carried_elsewhere,
    decoy,
    honest,
    nudged,
    one_pole_moved,
    other_place,
    placements_mixed_up,
    sign,
    swapped_by_hand,
    tape_fallen_off,
    turned_about_upright,
    two_of_three_carried,
    walker_with_band,
)
from deception_sites import (
    DrawPoles,
    Shot,
    Site,
    about_vertical,
    at_right_angles,
    at_times_meeting,
    foot_of,
    leaning_and_band,
    place_of,
    standing,
    upright_and_leaning,
)
from retropole.base import se3
from retropole.base.datatypes import DEFAULT_RADIUS, Array, PointCloud
from retropole.simulation import Box, Cylinder
from retropole.simulation.scenes import (
    METAL,
    SURROUNDINGS,
    Surroundings,
    rotated_by_180,
    symmetric_poles,
)

FEET_IN_METRES = 0.3048
ONE, TWO, THREE = standing(1), standing(2), standing(3)


@dataclass(frozen=True)
class Kind:
    """A row: what it draws of a site whose poles and surroundings are drawn so.

    ``scene`` is None where the scenes come in turn. ``at_once`` says that it needs no time between
    the two recordings: nothing was carried, moved or bumped in between.
    """

    draw: Callable[[Site, np.random.Generator], Drawn | None]
    poles: DrawPoles = TWO
    around: Callable[[str, np.random.Generator], Surroundings] = place_of
    scene: str | None = None
    at_once: bool = False


def lidar_moved(site: Site, rng: np.random.Generator) -> Drawn | None:
    """The source moves by 3 to 60 cm and 0.3 to 10° before the second placement is recorded."""
    poles = TWO(rng, site.clear)
    if poles is None or not site.allows(*(foot_of(pole) for pole in poles)):
        return None
    pose = _bumped(site.poses[1], rng, (0.3, 10.0), (0.03, 0.6))
    first = site.shot(0), site.shot(1)
    second = replace(first[0], poles=poles), replace(first[1], poles=poles, poses=(pose,))
    return Drawn((first, second), (site.truth, se3.inverse(site.poses[0]) @ pose))


def _bumped(
    pose: Array, rng: np.random.Generator, degrees: tuple[float, float], metres: tuple[float, float]
) -> Array:
    """Turn and shift a pose (4, 4) in random directions; sizes evenly on a logarithmic scale."""
    axis, way = (each / np.linalg.norm(each) for each in rng.normal(size=(2, 3)))
    turn, far = (np.exp(rng.uniform(*np.log(each))) for each in (degrees, metres))
    return se3.retract(pose, np.r_[np.radians(turn) * axis, far * way])


def mirrored(site: Site, rng: np.random.Generator) -> Drawn:
    """One cloud has one of its axes reversed: nothing rigid is right."""
    flip = np.ones(3)
    flip[rng.integers(3)] = -1.0
    return _changed(site, int(rng.integers(2)), lambda cloud: replace(cloud, xyz=cloud.xyz * flip))


def scaled(site: Site, rng: np.random.Generator) -> Drawn:
    """One cloud is scaled by 0.9 to 1.1, or in a quarter of the draws in feet."""
    factor = rng.uniform(0.9, 1.1)
    if rng.uniform() < 0.25:
        factor = FEET_IN_METRES ** sign(rng)
    k = int(rng.integers(2))
    drawn = _changed(site, k, lambda cloud: replace(cloud, xyz=cloud.xyz * factor))
    return replace(drawn, truths=(site.truth,))


def _changed(site: Site, k: int, change: Callable[[PointCloud], PointCloud]) -> Drawn:
    shots = [site.shot(0), site.shot(1)]
    shots[k] = replace(shots[k], change=change)
    return Drawn(((shots[0], shots[1]),), ())


def cropped(site: Site, rng: np.random.Generator) -> Drawn:
    return _crop(honest(site, rng), rng)


def cropped_and_carried(site: Site, rng: np.random.Generator) -> Drawn | None:
    drawn = carried_elsewhere(site, rng)
    return None if drawn is None else _crop(drawn, rng)


def _crop(drawn: Drawn, rng: np.random.Generator) -> Drawn:
    """Keep no more than 1.5 to 3 m about the poles' middles, as each LiDAR has them."""
    within = rng.uniform(1.5, 3.0)
    target, source = (
        replace(shot, change=partial(_near, shot=shot, within=within)) for shot in drawn.shots[0]
    )
    return replace(drawn, shots=((target, source),))


def _near(cloud: PointCloud, shot: Shot, within: float) -> PointCloud:
    middles = se3.apply(se3.inverse(shot.poses[0]), np.stack([pole.centre for pole in shot.poles]))
    away = np.linalg.norm(cloud.xyz[:, None] - middles, axis=2).min(axis=1)
    return cloud.select(away < within)


def bumped_while_recording(site: Site, rng: np.random.Generator) -> Drawn:
    """Both record two sweeps; between them one LiDAR is turned by 0.5 to 6° and up to 5 cm."""
    k = int(rng.integers(2))
    shots = [replace(site.shot(i), poses=(site.poses[i],) * 2) for i in range(2)]
    bumped = _bumped(site.poses[k], rng, (0.5, 6.0), (0.005, 0.05))
    shots[k] = replace(shots[k], poses=(site.poses[k], bumped))
    after = tuple(bumped if i == k else pose for i, pose in enumerate(site.poses))
    truths = site.truth, se3.inverse(after[0]) @ after[1]
    return Drawn(((shots[0], shots[1]),), truths)


def symmetric_place(scene: str, rng: np.random.Generator) -> Surroundings:
    """A place that a half turn maps onto itself; of a corridor, without what stands in it."""
    place = SURROUNDINGS[scene](rng)
    surfaces = place.surfaces[:6] if scene == "corridor" else place.surfaces
    return replace(place, surfaces=[*surfaces, *rotated_by_180(surfaces)])


def symmetric_with_a_box(site: Site, rng: np.random.Generator) -> Drawn | None:
    """Only a box of 0.2 to 0.8 m tells a half turn."""
    half = rng.uniform(0.1, 0.4, 3)
    at = np.r_[rng.uniform(-1, 1, 2) * site.clear, half[2]]
    feet = [foot_of(pole) for pole in site.poles]
    if not site.allows(at) or min(float(np.linalg.norm((at - foot)[:2])) for foot in feet) < 0.8:
        return None
    thing = Box(at, about_vertical(rng.uniform(0, 3), at, np.zeros(2))[:3, :3], half, METAL)
    shots = site.shot(0).with_things(thing), site.shot(1).with_things(thing)
    lie = se3.inverse(site.poses[0]) @ about_vertical(np.pi, np.zeros(3), np.zeros(2))
    return Drawn((shots,), (site.truth,), lie @ site.poses[1])


def truck_between(site: Site, rng: np.random.Generator) -> Drawn | None:
    """A truck, in a corridor a cart, stands there in one of the recordings only."""
    indoors = site.scene == "corridor"
    half = np.array([0.6, 0.4, 0.8] if indoors else [4.0, 1.25, 1.6])
    reach = np.asarray(site.clear) if indoors else np.array([12.0, 7.0])
    at = np.r_[rng.uniform(-1, 1, 2) * reach, half[2]]
    near = [foot_of(pole) for pole in site.poles] + [pose[:3, 3] for pose in site.poses]
    truck = Box(at, about_vertical(rng.normal() * 0.1, at, np.zeros(2))[:3, :3], half, METAL)
    if any(np.all(np.abs((each - at) @ truck.axes)[:2] < half[:2] + 0.9) for each in near):
        return None
    shots = [site.shot(0), site.shot(1)]
    k = int(rng.integers(2))
    shots[k] = shots[k].with_things(truck)
    return Drawn(((shots[0], shots[1]),), (site.truth,))


def half_outliers(site: Site, rng: np.random.Generator) -> Drawn:
    """To every return of both clouds comes one anywhere before it, as bright as any."""
    (seeds,) = rng.spawn(1)
    shots = [
        replace(site.shot(k), change=partial(_with_outliers, rng=own))
        for k, own in enumerate(seeds.spawn(2))
    ]
    return Drawn(((shots[0], shots[1]),), (site.truth,))


def _with_outliers(cloud: PointCloud, rng: np.random.Generator) -> PointCloud:
    number = np.arange(len(cloud))
    both = cloud.select(np.concatenate([number, number]))
    share = np.concatenate([np.ones(len(cloud)), rng.uniform(0.1, 1.0, len(cloud))])
    assert cloud.intensity is not None
    intensity = np.concatenate([cloud.intensity, rng.permutation(cloud.intensity)])
    return replace(both, xyz=both.xyz * share[:, None], intensity=intensity)


def _symmetric_poles(rng: np.random.Generator, clear: tuple[float, float]) -> list[Cylinder]:
    return symmetric_poles(rng, DEFAULT_RADIUS)


HONEST = {
    f"nothing wrong, {scene}": Kind(honest, scene=scene, at_once=True) for scene in SURROUNDINGS
}
ONE_POLE: dict[str, Kind] = {
    "one pole, nothing wrong": Kind(honest, ONE, at_once=True),
    "one pole, carried elsewhere": Kind(carried_elsewhere, ONE),
    "one pole, carried along the place": Kind(carried_along, ONE),
    "one pole, nudged": Kind(nudged, ONE),
    "one pole, leaning another way": Kind(turned_about_foot, ONE),
    "one pole, another one": Kind(another_pole, ONE),
    "one pole, files of two places": Kind(other_place, ONE),
    "one pole, one cloud mirrored": Kind(mirrored, ONE, at_once=True),
    "one pole amid a symmetric place": Kind(
        honest, upright_in_the_middle, symmetric_place, at_once=True
    ),
    "one pole amid a symmetric place with a box": Kind(
        symmetric_with_a_box, upright_in_the_middle, symmetric_place, at_once=True
    ),
    "one pole between rows of posts": Kind(honest, ONE, two_rows_of_posts, at_once=True),
    "one pole, carried from post to post": Kind(carried_from_post_to_post, ONE, two_rows_of_posts),
    "one pole, a container shoved": Kind(container_shoved, ONE),
    "one pole, 50 % outliers": Kind(half_outliers, ONE, at_once=True),
    "one pole, LiDAR bumped while recording": Kind(bumped_while_recording, ONE),
}
KINDS: dict[str, Kind] = {
    "both poles carried elsewhere together": Kind(carried_elsewhere),
    "leaning pole turned about the upright one": Kind(turned_about_upright, upright_and_leaning),
    "walker's band taken for a pole": Kind(walker_with_band, leaning_and_band, at_once=True),
    "one pole moved or leaned": Kind(one_pole_moved),
    "LiDAR moved between two placements": Kind(lidar_moved),
    "one cloud mirrored": Kind(mirrored, at_times_meeting, at_once=True),
    "one cloud scaled": Kind(scaled, at_once=True),
    "poles at 90° that nearly meet": Kind(honest, at_right_angles, at_once=True),
    "clouds cropped": Kind(cropped, at_once=True),
    "files of two places": Kind(other_place),
    "second pole hidden from each, a decoy": Kind(decoy, upright_and_leaning, at_once=True),
    "poles swapped by hand": Kind(swapped_by_hand, at_times_meeting),
    "one tape of three fallen off": Kind(tape_fallen_off, THREE),
    "LiDAR bumped while recording": Kind(bumped_while_recording),
    "symmetric place with a box": Kind(
        symmetric_with_a_box, _symmetric_poles, symmetric_place, at_once=True
    ),
    "a truck between the recordings": Kind(truck_between),
    "50 % outliers": Kind(half_outliers, at_once=True),
    "two of three poles carried": Kind(two_of_three_carried, THREE),
    "poles carried along the place": Kind(carried_along),
    "poles nudged together": Kind(nudged),
    "two placements mixed up": Kind(placements_mixed_up),
    "cropped, and poles carried": Kind(cropped_and_carried),
    "two poles, carried from post to post": Kind(
        carried_from_post_to_post, around=two_rows_of_posts
    ),
    **HONEST,
    **ONE_POLE,
}
"""Rows of the table by name: kinds of the same name draw the same."""
