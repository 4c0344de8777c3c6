"""The carried pole in every sweep of a recording.

Each sweep is searched as a separate cloud, since what moves is what is sought. What shines in one
place all the time is no carried pole, and of what is left the longest way that a person can walk
is taken.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from itertools import compress
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from ..base import se3
from ..base.datatypes import DEFAULT_RADIUS, Array, BoolArray, IntArray, PointCloud, every_nth
from ..base.errors import Refusal
from ..base.se3 import lengths
from ..base.sensors import Sensor, Threshold, threshold_for
from ..extraction.line_search import near_box
from ..extraction.lines import LINK, MIN_POLE_POINTS, clusters
from ..extraction.poles import extract_poles
from ..extraction.sensor_pattern import check_sensor
from ..io.beams import elevations, with_beam_origin, with_trusted_rings
from ..io.scan_lines import with_rings
from .expected import FASTEST, JUMP, Box, Expected
from .moving import Returns, follow, joined

STATIC_SHARE = 0.4
"""What is found within `SAME_PLACE` in more than this part of the sweeps is static."""

SAME_PLACE = 0.2
"""Distance of the same pole that stands, in another sweep, metres: what noise moves the middle of
its returns by."""

BESIDE, IN_FRONT = float(np.radians(0.5)), 0.01
"""What is so close to a return, rad, and nearer by this amount, metres, may hide a part of the
pole's width: the widest step of the table of sensors is 0.6°; a hand is a few centimetres thick."""

DIFFUSE = 300
"""So many returns of the whole sweep, evenly taken, stand for it where a pole is alone."""

LONGEST_GAP = 20.0
"""The pole may be out of view for so long, s. With 5 s, half of a tuning walk was left out, and a
jump of the clock in it."""


class Found(NamedTuple):
    """A pole in one sweep: number of the sweep, middle (3,) and direction (3,), and its returns."""

    sweep: int
    time: float
    point: Array
    direction: Array
    xyz: Array
    times: Array
    rings: IntArray
    is_whole: BoolArray


@dataclass(frozen=True, eq=False)
class Track:
    """The carried pole as one LiDAR saw it, about the start of its beams and by its clock.

    Attributes
    ----------
    times, points, directions
        (S,) s, (S, 3) metres and (S, 3) unit vectors that run on from sweep to sweep, of the S
        sweeps in which the pole was found.
    xyz, stamps, rings, sweep
        (N, 3) its returns, their (N,) times, rings (−1 where none are numbered) and the place of
        their sweep among the S.
    is_whole
        (N,) whether nothing is in front of a return and close to it: a hand, or the person.
    sweeps
        How many sweeps were recorded.
    crowded
        Share of the sweeps with a pole in which more than one moves.
    T_recording_beams
        (4, 4) from the frame of the points above, where beams start at the origin and turn about
        the z axis, to that of the recording.
    threshold
        Intensity from which a return counted as retro-reflective.
    """

    times: Array
    points: Array
    directions: Array
    xyz: Array
    stamps: Array
    rings: IntArray
    sweep: IntArray
    is_whole: BoolArray
    sweeps: int
    crowded: float
    T_recording_beams: Array = field(default_factory=lambda: np.eye(4))
    threshold: float | None = None


class Beams(NamedTuple):
    """Where the beams of a recording start and turn, `Track.T_recording_beams`, and its rings.

    ``levels`` are the elevations (K,) of rings that its points alone show, rad, else None;
    ``has_rings`` is whether the numbers of rings in the recording are such.
    """

    T_recording_beams: Array
    levels: Array | None
    has_rings: bool = False

    def numbered(self, cloud: PointCloud) -> PointCloud:
        """Number the rings of points about the start of the beams that have no others."""
        if self.levels is None:
            return cloud
        between = (self.levels[1:] + self.levels[:-1]) / 2
        ring = np.searchsorted(between, elevations(cloud.xyz, np.array([0.0, 0.0, 1.0])))
        return replace(cloud, ring=ring)


class Sweep(NamedTuple):
    """A sweep about the start of its beams, without numbers of rings that its points alone show."""

    number: int
    cloud: PointCloud
    beams: Beams
    threshold: Threshold

    def bright(self) -> tuple[IntArray, Array]:
        """Index (B,) of the returns that shine, and their thresholds."""
        intensity, chosen = self.cloud.intensity, self.threshold
        assert intensity is not None
        # Most are below any: their ranges need not be known.
        least = chosen.value if chosen.least is None else min(chosen.value, chosen.least)
        index = np.flatnonzero(intensity >= least)
        levels = chosen.at(lengths(self.cloud.xyz[index]))
        is_bright = intensity[index] >= levels
        return index[is_bright], levels[is_bright]


def find_track(
    sweeps: Iterable[PointCloud],
    sensor: Sensor | None = None,
    *,
    threshold: float | None = None,
    radius: float = DEFAULT_RADIUS,
) -> Track:
    """Find the carried pole in a recording.

    Parameters
    ----------
    sweeps
        One after the other, in the LiDAR's frame, with intensity and with a time for each point.
    sensor
        What recorded them; None if it is not known.
    threshold
        Intensity from which a return is treated as retro-reflective; None for the sensor's, or that
        of the first sweep.
    radius
        Of the pole, metres.

    Raises
    ------
    Refusal
        ``no_times`` where points have no times, ``wrong_sensor``, and ``no_walk`` where no pole
        that moves is seen in `MIN_SWEEPS`.
    """
    search = Search(sensor, threshold=threshold, radius=radius)
    for cloud in sweeps:
        search.add(cloud)
    return search.track()


class Search:
    """The search for the carried pole in a recording that grows: each sweep is searched once.

    Parameters
    ----------
    sensor, threshold, radius
        As `find_track` takes them.

    Attributes
    ----------
    sweeps
        How many were searched.
    """

    def __init__(
        self,
        sensor: Sensor | None = None,
        *,
        threshold: float | None = None,
        radius: float = DEFAULT_RADIUS,
    ) -> None:
        self.sweeps = 0
        self._sensor, self._threshold, self._radius = sensor, threshold, radius
        self._found: list[Found] = []
        self._expected = Expected()
        self._bright: list[Returns] = []
        self._chosen: Threshold | None = None
        self._beams: Beams | None = None

    def add(self, cloud: PointCloud) -> list[Found]:
        """Search the next sweep, and give what may be the pole in it.

        Raises
        ------
        Refusal
            ``no_times``, ``wrong_sensor``.
        """
        if cloud.time is None or cloud.intensity is None:
            missing = "times" if cloud.time is None else "intensities"
            raise Refusal(
                "no_times",
                f"the points of {cloud.source or 'a sweep'} have no {missing}: of a pole that "
                "moves, each return must say when; record with a time for each point",
                {"points": len(cloud)},
            )
        self._beams = self._beams or beams_of(cloud, self._sensor)
        cloud = about_beams(cloud, self._beams)
        assert cloud.intensity is not None
        if self._chosen is None:
            ranges = lengths(cloud.xyz)
            self._chosen = threshold_for(cloud.intensity, ranges, self._sensor, self._threshold)
        seen = Sweep(self.sweeps, cloud, self._beams, self._chosen)
        found = _poles_in(seen, self._sensor, self._radius, self._expected)
        if takes_its_time(self._sensor):
            self._bright.append(_bright_in(seen))
        self.sweeps += 1
        self._found += found
        return found

    def track(self) -> Track:
        """Find the carried pole in all sweeps so far.

        Raises
        ------
        Refusal
            ``no_walk``.
        """
        moving = _moving(self._found, self.sweeps)
        if moving and self._bright:
            bright = joined(self._bright)
            moving, bright = _moving_alone(moving, bright, self.sweeps)
            chain = _followed(_longest_way(moving), bright)
        else:
            chain = _longest_way(moving)
        if len(chain) < MIN_SWEEPS:
            raise Refusal(
                "no_walk",
                f"a pole that moves was found in {len(chain)} of {self.sweeps} sweeps, "
                f"{MIN_SWEEPS} are needed: carry the pole 3 to 8 m from the LiDARs, where both see "
                "most of it",
                {
                    "sweeps": self.sweeps,
                    "found": len(chain),
                    "standing": len(self._found) - len(moving),
                },
            )
        per_sweep = np.bincount([each.sweep for each in moving])
        assert self._beams is not None
        assert self._chosen is not None
        crowded = float(np.mean(per_sweep[per_sweep > 0] > 1))
        track = _track_of(chain, self.sweeps, crowded, self._beams.T_recording_beams)
        return replace(track, threshold=self._chosen.value)


def beams_of(cloud: PointCloud, sensor: Sensor | None) -> Beams:
    """Look once how the beams of a recording run: in every part of every sweep it takes its time.

    Parameters
    ----------
    cloud
        One sweep.
    sensor
        What recorded it; None if it is not known.

    Raises
    ------
    Refusal
        ``wrong_sensor``.
    """
    cloud = with_beam_origin(with_trusted_rings(cloud))
    check_sensor(cloud, sensor)
    levels, has_rings = None, cloud.ring is not None
    if cloud.ring is None:
        cloud = with_rings(cloud, sensor)
        if cloud.ring is not None:
            elevation = elevations(cloud.xyz - cloud.origin, cloud.axis)
            levels = np.array(
                [np.median(elevation[cloud.ring == k]) for k in np.unique(cloud.ring)]
            )
    turn = Rotation.align_vectors(cloud.axis[None], [[0.0, 0.0, 1.0]])[0].as_matrix()
    R = np.eye(3) if np.allclose(cloud.axis, [0, 0, 1], atol=1e-12) else turn
    return Beams(se3.from_rt(R, cloud.origin), levels, has_rings)


def about_beams(cloud: PointCloud, beams: Beams) -> PointCloud:
    """Express a sweep about the start of its beams."""
    T = beams.T_recording_beams
    ring = cloud.ring if beams.has_rings else with_trusted_rings(cloud).ring
    if np.any(np.eye(4) != T):
        cloud = cloud.transformed(se3.inverse(T))
    return replace(cloud, origin=np.zeros(3), axis=np.array([0.0, 0.0, 1.0]), ring=ring)


MIN_SWEEPS = 40
"""In fewer sweeps a pole is no walk: 4 s at 10 Hz (chosen; of 20 s walks, 150 and more are)."""


def _poles_in(seen: Sweep, sensor: Sensor | None, radius: float, expected: Expected) -> list[Found]:
    """Search what is about the bright clusters that may be poles: most of a sweep is far from any.

    What is found, and what is barren, is added to ``expected``.
    """
    cloud, (bright, thresholds) = seen.cloud, seen.bright()
    assert cloud.intensity is not None
    assert cloud.time is not None
    groups = [group for group in clusters(cloud.xyz[bright], LINK) if len(group) >= MIN_POLE_POINTS]
    boxes = [Box.of(cloud.xyz[own], cloud.time[own]) for own in (bright[each] for each in groups)]
    found: list[Found] = []
    for turn in expected.in_order(seen.number, boxes):
        for k in [] if found else turn:
            some = np.sort(near_box(cloud.xyz.T, bright[groups[k]]))
            if np.ptp(cloud.intensity[some]) == 0:
                # Nothing else is near: a few diffuse returns still say that there are such.
                some = np.union1d(some, every_nth(np.arange(len(cloud)), DIFFUSE))
            part = seen.beams.numbered(cloud.select(some))
            level = float(thresholds[groups[k]].min())
            poles = _poles_of(part, seen.number, sensor, level, radius)
            expected.add(seen.number, boxes[k], [Box.of(each.xyz, each.times) for each in poles])
            found += poles
    return found


def _poles_of(
    part: PointCloud, sweep: int, sensor: Sensor | None, threshold: float, radius: float
) -> list[Found]:
    """Search a part of a sweep."""
    assert part.time is not None
    found = extract_poles(part, sensor=sensor, threshold=threshold, radius=radius, is_part=True)
    rings = np.full(len(part), -1) if part.ring is None else part.ring
    return [
        Found(
            sweep,
            float(part.time[pole.index].mean()),
            pole.point,
            pole.direction,
            pole.xyz,
            part.time[pole.index],
            rings[pole.index],
            _is_whole(part, pole.index),
        )
        for pole in found.poles
    ]


def takes_its_time(sensor: Sensor | None) -> bool:
    """Whether the beams meet a pole again and again within a sweep."""
    return sensor is not None and sensor.pattern == "rosette"


def _bright_in(seen: Sweep) -> Returns:
    """Take all returns of a sweep that shine."""
    cloud, (index, _) = seen.cloud, seen.bright()
    assert cloud.time is not None
    own = seen.beams.numbered(cloud.select(index))
    rings = np.full(len(index), -1) if own.ring is None else own.ring
    of_sweep = np.full(len(index), seen.number)
    whole = _is_whole(cloud, index) if len(index) else np.zeros(0, dtype=bool)
    return Returns(own.xyz, cloud.time[index], of_sweep, rings, whole)


def _followed(chain: list[Found], returns: Returns) -> list[Found]:
    """Follow the pole from the sweeps in which it was found as a line at rest."""
    if not chain:
        return []
    found = _track_of(chain, 0, 0.0, np.eye(4))
    lines = follow(found.times, found.points, found.directions, returns)
    of_lines = [(line, returns.select(line.returns)) for line in lines]
    return [
        Found(
            int(own.sweep[0]), line.time, line.point, line.direction,
            own.xyz, own.times, own.rings, own.is_whole,
        )
        for line, own in of_lines
    ]  # fmt: skip


def _is_whole(cloud: PointCloud, index: IntArray) -> BoolArray:
    """Whether nothing is in front of and close to each of some returns (M,) of a pole."""
    ranges = lengths(cloud.xyz - cloud.origin)
    rays = (cloud.xyz - cloud.origin) / ranges[:, None]
    # Most others are too far aside in some coordinate.
    low, high = rays[index].min(axis=0) - BESIDE, rays[index].max(axis=0) + BESIDE
    others = ranges < ranges[index].max() - IN_FRONT
    for column, least, most in zip(rays.T, low, high, strict=True):
        others &= (column >= least) & (column <= most)
    others[index] = False
    beside = rays[index] @ rays[others].T > np.cos(BESIDE)
    hides = beside & (ranges[others] < ranges[index, None] - IN_FRONT)
    return np.asarray(~hides.any(axis=1))


def _moving(found: list[Found], sweeps: int) -> list[Found]:
    """Leave out the poles that are in one place in many of the sweeps."""
    if not found:
        return []
    tree = KDTree([each.point for each in found])
    near = tree.query_ball_point(tree.data, SAME_PLACE)
    of = np.array([each.sweep for each in found])
    return [
        each
        for each, there in zip(found, near, strict=True)
        if len(np.unique(of[there])) <= STATIC_SHARE * sweeps
    ]


def _moving_alone(found: list[Found], bright: Returns, sweeps: int) -> tuple[list[Found], Returns]:
    """Leave out poles and returns where something shines in many of the sweeps.

    Of a static reflector too, a line is found in some sweeps alone, but returns are in all.
    """
    xyz = np.concatenate([bright.xyz, [each.point for each in found]])
    cell = np.floor(xyz / (2 * SAME_PLACE)).astype(np.int64)
    of = np.unique(cell, axis=0, return_inverse=True)[1].ravel()
    count = len(bright.xyz)
    in_sweeps = np.unique(np.stack([of[:count], bright.sweep], axis=1), axis=0)[:, 0]
    moves = np.bincount(in_sweeps, minlength=of.max() + 1)[of] <= STATIC_SHARE * sweeps
    return list(compress(found, moves[count:])), bright.select(moves[:count])


def _longest_way(found: list[Found]) -> list[Found]:
    """The longest chain of poles, one a sweep, that a person can walk."""
    if not found:
        return []
    time, sweep = (np.array([getattr(f, name) for f in found]) for name in ("time", "sweep"))
    point = np.array([each.point for each in found])
    length, before = np.zeros(len(found)), np.full(len(found), -1)
    for k in range(len(found)):
        back = np.flatnonzero((sweep[:k] < sweep[k]) & (time[:k] > time[k] - LONGEST_GAP))
        step = lengths(point[back] - point[k])
        allowed = step < FASTEST * (time[k] - time[back]) + JUMP
        length[k] = 1.0
        if allowed.any():
            # Of chains as long, the one with the shorter way.
            gain = np.where(allowed, length[back] - 0.5 * step, -np.inf)
            best = int(np.argmax(gain))
            length[k] += max(gain[best], 0.0)
            before[k] = back[best] if gain[best] > 0 else -1
    chain, k = [], int(np.argmax(length))
    while k >= 0:
        chain.append(found[k])
        k = int(before[k])
    return chain[::-1]


def _track_of(chain: list[Found], sweeps: int, crowded: float, T: Array) -> Track:
    directions = [chain[0].direction]
    for each in chain[1:]:
        sign = 1.0 if each.direction @ directions[-1] >= 0 else -1.0
        directions.append(sign * each.direction)
    return Track(
        times=np.array([each.time for each in chain]),
        points=np.array([each.point for each in chain]),
        directions=np.array(directions),
        xyz=np.concatenate([each.xyz for each in chain]),
        stamps=np.concatenate([each.times for each in chain]),
        rings=np.concatenate([each.rings for each in chain]),
        is_whole=np.concatenate([each.is_whole for each in chain]),
        sweep=np.repeat(np.arange(len(chain)), [len(each.xyz) for each in chain]),
        sweeps=sweeps,
        crowded=crowded,
        T_recording_beams=T,
    )
