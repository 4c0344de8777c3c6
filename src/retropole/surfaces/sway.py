"""A mast that sways: its returns are brought to rest, and how far off that may be is stated.

The motion comes from the sweeps (`sweeps`), and the position of rest from how masts move.

That is a set of hypotheses of an oscillation about rest, weighed by the returns. All sweeps of a
recording show the same surfaces; how they lie relative to each other shows how the LiDAR moved
(`sweeps`), but for what all have in common: where it rests. That follows from how a mast moves. It
oscillates about rest, at a frequency and with a size that are not known beforehand::

    ξ(t) = Σ_j  a_j cos(2π f_j t) + b_j sin(2π f_j t),    a_j, b_j ~ N(0, σ² S),

ξ the turn and shift of the LiDAR, the f_j next to one frequency, one with faster modes, or spread
over all, S any way or the one that was seen. Each combination of frequencies, σ and S is a
hypothesis with the evidence of the returns; what is stated is the mean over all hypotheses. A
recording that is shorter than a period sees a drift: hypotheses of few and of many degrees then say
the same about it, and other things of where it rests. What they differ by is the uncertainty
(MacKay 2003, Information theory, inference, and learning algorithms, ch. 28).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ..alignment.certainty import root_of
from ..base.datatypes import Array, PointCloud
from ..base.systematic import Sway, stated_sway
from ..base.uncertainty import MAD_TO_SIGMA
from .static import MAX_TURN, MIN_FRAMES, turned_by
from .sweeps import Observed, Timed, numbered, observe, timed, without

LOWEST, HIGHEST = 0.2, 3.0
"""Of the frequencies of masts, Hz; within, each period is as probable."""

SPACING, RESOLVED = 0.15, 0.7
"""From one frequency that is tried to the next: as a part of its value, and in the resolution of a
recording, which is one over its length."""

FREQUENCY_SPREAD = 0.1
"""A mast does not keep its frequency exactly: within this share, it moves as well."""

BROAD = 10
"""Frequencies of the hypothesis that a mast moves at all frequencies."""

FASTER, PART_OF_FASTER = np.array([2.0, 4.0, 8.0]), 0.3
"""A mast bends in faster modes as well: frequencies by that of the first, and all their size by its
size. In a third of a period of the first they may look like all there is: of 24 such recordings
(benchmarks/sway.py, --modes, 0.3 Hz, 10 sweeps, seeds 210 to 215) the rest of 22 is within the
region of 95 %, of 8 without this hypothesis."""

SIZES = np.radians([0.005, 0.01, 0.02, 0.04, 0.08, 0.16])
"""1 σ of the turn of a mast, rad, each as probable as it is large: a third of a period about a
turning point would else be taken for a whole one of less."""

LEVERS = 0.3, 2.0, 8.0
"""Shift of the LiDAR by its turn, m/rad: about itself, and at the end of what bends."""

ASIDE = 0.25
"""Part of the turn that a mast moves aside of the way that was seen, 1 σ."""

SHIFTS = np.array([0.002, 0.01, 0.05])
"""1 σ of the shift of a LiDAR that does not turn, metres: a vehicle that creeps does not sway. In
half a second that of PandaSet 002, said to be still, moves by 3.6 cm and turns by less than
0.03°."""

SHIFT_ALONE = np.eye(6)[:, 3:]
"""Root of the covariance of such a shift, of one metre."""

SEEN, LEAST_SWAY = 3.0, float(np.radians(0.003))
"""Logarithm of how much more probable the returns are with sway than without, or with a shift
alone, from which it is seen, 20 times; and its least angle, rad, 1.5 mm at 30 m."""

COUNTED = 1 / 3
"""Part of the evidence that hypotheses are weighed by, a caution: no mast moves quite as one of
them. Of the same 24 recordings it is 14 where all counts; of those at one frequency all, either
way."""

NEGLIGIBLE = 1e-4
"""Hypotheses of less probability are left out."""


@dataclass(frozen=True, eq=False)
class Motion:
    """The motion as the returns have it.

    Attributes
    ----------
    evidence, total
        Logarithm of how much more probable they are with it than without, or with shifts alone;
        and than without.
    motion
        (B, 6) turn and shift from rest of each part.
    covariance
        (6, 6) of their mean over the recording.
    frequency
        Hz, its geometric mean.
    best
        Features (B, F) of the most probable hypothesis, and its coefficients (F, 6).
    """

    evidence: float
    total: float
    motion: Array
    covariance: Array
    frequency: float
    best: tuple[Array, Array]

    @property
    def is_seen(self) -> bool:
        """Whether it is sway, and large enough to count."""
        return self.evidence > SEEN and self.angle > LEAST_SWAY

    @property
    def angle(self) -> float:
        """Root mean square of the angle from rest, rad."""
        return angle_of(self.motion)


def angle_of(motion: Array) -> float:
    """Root mean square of the angle from rest of a motion (B, 6), rad."""
    return float(np.sqrt(np.mean(np.sum(motion[:, :3] ** 2, axis=1))))


class Likelihood(NamedTuple):
    """A frequency, Hz, how probable it is, its features (B, F), and what the returns show of their
    coefficients: information (6 F, 6 F) and gradient (6 F,)."""

    frequency: float
    share: float
    features: Array
    left: Array
    pull: Array


class Axes(NamedTuple):
    """What returns show of coefficients along the axes (6 F, K) of a prior: values and gradients
    (K,)."""

    way: Array
    value: Array
    along: Array


def axes_of(likelihoods: Likelihood, root: Array) -> Axes:
    """Find the axes in which both the information of the returns and a prior are diagonal.

    `root` (6, R) is of the covariance of each six coefficients, over turn and shift, rad and m,
    where the size is one.
    """
    count, rank = len(likelihoods.pull) // 6, root.shape[1]
    blocks = root.T @ likelihoods.left.reshape(count, 6, count, 6).transpose(0, 2, 1, 3) @ root
    value, way = np.linalg.eigh(blocks.transpose(0, 2, 1, 3).reshape(count * rank, -1))
    way = (root @ way.reshape(count, rank, -1)).reshape(6 * count, -1)
    return Axes(way, np.maximum(value, 0.0), way.T @ likelihoods.pull)


def evidence_of(axes: Axes, variance: Array, noise: float) -> Array:
    """(S,) logarithm of the evidence of priors of some variances (S,)."""
    narrowed = 1 + np.multiply.outer(variance, axes.value / noise)
    gained = np.multiply.outer(variance, (axes.along / noise) ** 2) / narrowed
    return np.asarray(0.5 * np.sum(gained - np.log(narrowed), axis=1))


def axes_along(
    likelihoods: Sequence[Likelihood], ways: Sequence[tuple[float, Array]]
) -> list[list[Axes]]:
    """Find the axes of every hypothesis, for each of the ways and for a shift alone."""
    roots = [*(root for _, root in ways), SHIFT_ALONE]
    return [[axes_of(each, root) for root in roots] for each in likelihoods]


def infer(
    likelihoods: Sequence[Likelihood],
    axes: Sequence[Sequence[Axes]],
    sizes: Array,
    ways: Sequence[tuple[float, Array]],
    noise: float = 1.0,
) -> Motion:
    """Weigh all hypotheses of the motion by the returns.

    Parameters
    ----------
    likelihoods, axes
        At least one, and the result of `axes_along` for them.
    sizes
        1 σ of the turn, rad, each as probable as it is large.
    ways
        See `ways_of`.
    noise
        Ratio of the variance of the returns to the one that they state themselves.
    """
    share = np.array([each.share for each in likelihoods])
    prior = np.einsum("a,w,s->aws", share, [of_way for of_way, _ in ways], sizes / sizes.sum())
    evidence = np.array([[evidence_of(own, sizes**2, noise) for own in each[:-1]] for each in axes])
    shifted = np.array([evidence_of(each[-1], SHIFTS**2, noise) for each in axes])
    shifted += np.log(share / len(SHIFTS))[:, None]
    total = float(np.logaddexp.reduce(evidence + np.log(prior), axis=None))
    weighed = COUNTED * evidence + np.log(prior)
    probability = np.exp(weighed - np.logaddexp.reduce(weighed, axis=None))
    motion, mean = np.zeros((len(likelihoods[0].features), 6)), np.zeros(6)
    square = np.zeros((6, 6))
    best = np.unravel_index(int(np.argmax(probability)), probability.shape)
    for a, w, s in zip(*np.nonzero(probability > NEGLIGIBLE), strict=True):
        features, own, p = likelihoods[a].features, axes[a][w], float(probability[a, w, s])
        variance = sizes[s] ** 2 / (1 + sizes[s] ** 2 * own.value / noise)
        coefficients = (own.way @ (variance * own.along / noise)).reshape(-1, 6)
        middle = features.mean(axis=0)
        here = middle @ coefficients
        spread = np.einsum("i,ixk->xk", middle, own.way.reshape(len(middle), 6, -1))
        motion += p * (features @ coefficients)
        mean += p * here
        square += p * ((spread * variance) @ spread.T + np.outer(here, here))
        if (a, w, s) == best:
            likeliest = features, coefficients
    frequencies = np.log([each.frequency for each in likelihoods])
    return Motion(
        total - float(np.logaddexp.reduce(np.append(shifted, 0.0))),
        total,
        motion,
        square - np.outer(mean, mean),
        float(np.exp(probability.sum(axis=(1, 2)) @ frequencies)),
        likeliest,
    )


def ways_of(motion: Array) -> list[tuple[float, Array]]:
    """List ways to move: how probable each is, and a root (6, 6) of its covariance for 1 rad.

    Half of them go any way, with turn and shift in several proportions. The others go the way that
    was seen: a mast that moves to and fro in one plane would else be taken for one that moves less,
    since it moves in no other.

    Parameters
    ----------
    motion
        (B, 6) as it is known; zero if it is not.
    """
    found = [(0.5 / len(LEVERS), np.diag(np.repeat([1.0, lever], 3))) for lever in LEVERS]
    apart = motion - motion.mean(axis=0)
    spread = apart.T @ apart / len(apart)
    turn = float(np.trace(spread[:3, :3]))
    if turn > 0:
        own = spread / turn + np.diag(np.repeat([ASIDE, LEVERS[1] * ASIDE], 3) ** 2)
        found.append((0.5, root_of(own)))
    return found


def hypotheses(times: Array) -> Iterator[tuple[float, float, Array]]:
    """Yield frequencies that a mast may have, how probable each is, and its features (B, F)."""
    length = length_of(times)
    tried = [LOWEST]
    while tried[-1] < HIGHEST:
        tried.append(tried[-1] + min(SPACING * tried[-1], RESOLVED / length))
    middles = np.array(tried)
    shares = np.gradient(middles) / middles**2
    for f, share in zip(middles.tolist(), (shares / shares.sum()).tolist(), strict=True):
        beside = min(FREQUENCY_SPREAD * f, 0.5 / length)
        yield f, share / 3, waves(times, f + beside * np.array([-1.0, 0.0, 1.0]))
        first = waves(times, f + beside * np.array([-1.0, 1.0]))
        faster = waves(times, f * FASTER)
        yield f, share / 3, np.concatenate([first, PART_OF_FASTER * faster], axis=1)
    every = np.geomspace(LOWEST, HIGHEST, BROAD)
    yield float(np.sqrt(LOWEST * HIGHEST)), 1 / 3, waves(times, every)


def length_of(times: Array) -> float:
    """How long a recording is, s, by the middles of its parts (B,)."""
    return float(np.ptp(times)) + float(np.median(np.diff(times)))


def waves(times: Array, frequencies: Array) -> Array:
    """(B, 2 F) cosines and sines of some frequencies, Hz, whose squares sum to one."""
    angle = 2 * np.pi * times[:, None] * frequencies
    both = np.concatenate([np.cos(angle), np.sin(angle)], axis=1)
    return np.asarray(both / np.sqrt(len(frequencies)))


PASSES, AT_REST = 8, float(np.radians(2e-4))
"""The cells of the returns are made without the motion as it is known, and the motion estimated
anew, up to this number of times, or until it changes by less, rad."""

GROUPS = 50
"""Of sweeps, by which the noise of the motion is judged."""

STORED = 200
"""Values of the motion that are kept to be drawn."""


class Steadied(NamedTuple):
    """A cloud at rest; how it swayed, or None; and the motion (B, 6) that was removed, or None:
    turn and shift from rest of each part of the recording."""

    cloud: PointCloud
    sway: Sway | None = None
    motion: Array | None = None


def steadied(cloud: PointCloud, stated: float | None = None) -> Steadied:
    """Bring the returns of all sweeps to where the LiDAR rests.

    Parameters
    ----------
    cloud
        Without what moved in the scene.
    stated
        1 σ of the angle that the mast is said to sway by, rad; None if nothing is said: then
        only what is seen counts.

    Returns
    -------
    Steadied
        The same cloud and no motion where it is not seen to sway, or moved otherwise.
    """
    as_it_is = Steadied(cloud, None if stated is None else stated_sway(stated))
    if cloud.frame is None or len(numbered(cloud.frame)[0]) < MIN_FRAMES:
        return as_it_is
    when = timed(cloud)
    sizes = SIZES if stated is None else stated * np.array([0.5, 1.0, 2.0])
    found = motion_of(cloud, when, sizes)
    if found is None or (stated is None and not found.is_seen) or turned_by(cloud) > MAX_TURN:
        # What turned by more is refused: a LiDAR that was bumped does not sway.
        return as_it_is
    still = without(cloud.xyz, cloud.origin, found.motion, when.of_all)
    return Steadied(replace(cloud, xyz=still), _stated(found, when), found.motion)


def motion_of(cloud: PointCloud, when: Timed, sizes: Array) -> Motion | None:
    """Estimate the motion, from cells that are made anew without it until it rests.

    None if the returns lie on no flat cell.
    """
    xyz = cloud.xyz[when.index]
    found = None
    motion, noise = np.zeros((len(when.times), 6)), 1.0
    tried = list(hypotheses(when.times))
    for _ in range(PASSES):
        observed = observe(xyz, cloud.origin, when, motion)
        if not len(observed.plane):
            return None
        found, noise = judged(observed, list(ask(observed, tried)), sizes, motion, noise)
        change = float(np.abs(found.motion - motion)[:, :3].max())
        motion = found.motion
        if not found.is_seen or change < AT_REST:
            break
    return found


def ask(observed: Observed, tried: Iterable[tuple[float, float, Array]]) -> Iterator[Likelihood]:
    """Ask the returns about the features of some `hypotheses`."""
    for frequency, share, features in tried:
        yield Likelihood(frequency, share, features, *observed.about(features))


def judged(
    observed: Observed,
    likelihoods: Sequence[Likelihood],
    sizes: Array,
    motion: Array,
    noise: float = 1.0,
) -> tuple[Motion, float]:
    """Weigh all hypotheses by their likelihoods, and by the noise that results.

    Parameters
    ----------
    observed, likelihoods
        What the returns show, and the likelihoods of the hypotheses.
    sizes
        As of `sway.infer`.
    motion, noise
        (B, 6) the motion, and the noise, as they are known.
    """
    ways = ways_of(motion)
    axes = axes_along(likelihoods, ways)
    found = infer(likelihoods, axes, sizes, ways, noise)
    after = noise_of(observed, *found.best)
    return (found if after == noise else infer(likelihoods, axes, sizes, ways, after)), after


def noise_of(observed: Observed, features: Array, coefficients: Array) -> float:
    """How many times the variance that the returns state what the motion leaves has; 1 at least.

    Returns of one wall err together; the sweeps then scatter by more than each one's returns let
    expect. The motion is given by features (B, F) and their coefficients (F, 6).
    """
    parts = len(features)
    group = np.arange(parts) * min(GROUPS, parts) // parts
    own = (group[:, None] == np.arange(group[-1] + 1)).astype(np.float64)
    left, pull = observed.about(np.concatenate([own, features], axis=1))
    size = 6 * own.shape[1]
    rest = pull[:size] - left[:size, size:] @ coefficients.reshape(-1)
    value, way = np.linalg.eigh(left[:size, :size])
    is_known = value > 1e-6 * value[-1]
    square = (way.T @ rest)[is_known] ** 2 / value[is_known]
    return max(1.0, MAD_TO_SIGMA**2 * float(np.median(square)))


class Velocity(NamedTuple):
    """What the sweeps show of a steady motion: (6, 6) information and (6,) gradient at rest of its
    turn and shift per second, rad/s and m/s in the LiDAR's frame, the shift that of the beams'
    origin."""

    information: Array
    pull: Array


def velocity_of(cloud: PointCloud, prior: Array) -> Velocity | None:
    """Estimate the steady motion of a LiDAR from its sweeps; None if they do not determine it.

    Parameters
    ----------
    cloud
        Without what moved in the scene.
    prior
        (6, 6) covariance of the turn and shift per second that there may be.
    """
    if cloud.frame is None or len(numbered(cloud.frame)[0]) < 2:
        return None
    when = timed(cloud)
    features = (when.times - when.times.mean())[:, None]
    xyz, most, noise = cloud.xyz[when.index], np.asarray(np.linalg.inv(prior)), 1.0
    rate: Array = np.zeros((1, 6))
    found = None
    for _ in range(PASSES):
        observed = observe(xyz, cloud.origin, when, features @ rate)
        if not len(observed.plane):
            return None
        left, pull = observed.about(features)
        after = np.asarray(np.linalg.solve(left / noise + most, pull / noise)[None])
        change = float(np.abs(features @ (after - rate))[:, :3].max())
        rate, noise = after, noise_of(observed, features, after)
        found = Velocity(left / noise, pull / noise)
        if change < AT_REST:
            break
    return found


def without_velocity(cloud: PointCloud, rate: Array, later: float) -> PointCloud:
    """Bring the returns of a LiDAR that moves on steadily to where they were at one moment.

    Parameters
    ----------
    cloud
        The recording.
    rate
        (6,) turn and shift per second, as of `velocity_of`.
    later
        Seconds from the moment to the middle of the recording.
    """
    if cloud.frame is None:
        after = np.full(len(cloud), later)
    else:
        when = timed(cloud)
        after = (when.times - when.times.mean() + later)[when.of_all]
    part = np.arange(len(cloud))
    still = without(cloud.xyz, cloud.origin, after[:, None] * rate, part)
    return replace(cloud, xyz=still)


def _stated(found: Motion, when: Timed) -> Sway:
    """State the motion: its size, its frequency, and how it went."""
    return Sway(
        found.angle,
        found.frequency,
        length_of(when.times),
        found.covariance,
        drawn(when.times),
        drawn(main_angles(found.motion)),
    )


def main_angles(motion: Array) -> Array:
    """(B,) angle of a motion (B, 6) in its main direction, rad."""
    turn = motion[:, :3]
    return np.asarray(turn @ np.linalg.svd(turn, full_matrices=False)[2][0])


def drawn(values: Array) -> tuple[float, ...]:
    """Those of many values (B,) that are kept to be drawn."""
    return tuple(values[:: max(1, -(-len(values) // STORED))].tolist())
