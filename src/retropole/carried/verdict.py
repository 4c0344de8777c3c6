"""When a walk is no answer: what each LiDAR saw, what fits, what the walk does not determine."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..base import se3
from ..base.datatypes import Array
from ..base.errors import Refusal
from ..base.uncertainty import predicted_error
from .adjustment import FEWEST_IN_WINDOW, MAX_STEPS, WINDOW, Adjusted
from .track import Track

MAX_CROWDED = 0.2
"""Share of the sweeps in which more than one pole moves: a wrong pole in a few is left out."""

MAX_LEFT_OUT = 0.05
"""Share of the rows that count less than half. Of walks without mistakes it was 0.004 to 0.009
(tuning seeds 0 to 8, typical errors)."""

MAX_SCALE, MAX_JITTER = 2.5, 0.006
"""Ranges scatter by no more than this multiple of what is stated, and edges by no more than an
angle, rad: with the errors of the field, 1.3 and 0.002."""

MAX_WINDOW_RMS, CLIPPED = 2.0, 6.0
"""Root mean square of the residuals of a LiDAR in a window of 5 s, each clipped, all in σ: of sound
walks 1.23 at most (tuning seeds 0 to 5), of one across a jump of the clock 3.3."""

MAX_MOTION = 3.0, 3.0
"""Largest noise of the acceleration of a place, m²/s³, and of the lean, 1/s³, that a person gives
a pole: people have 0.2 and 0.1, two poles that are taken for one 6 and more."""

MAX_JUMP, JUMP_SIGMAS, STEP_SIGMAS = 0.003, 5.0, 4.2
"""The clocks' offset in a window of 5 s differs by no more, s, or by no more σ; and so does a
lasting step at the time when it is likeliest, by the last. Of steady clocks, 0.1 % of walks have a
larger one by chance: the largest of all times is then that of a Brownian bridge (Andrews 1993)."""

MAX_ERROR, AT = 0.25, 30.0
"""1 σ of where a point lands at a range, metres, beyond which a walk is no answer."""

LITTLE_WALK, NARROW_WALK, LITTLE_LEAN = 0.7, 0.3, float(np.radians(4.0))
"""Root mean squares of the way along its longest direction and across it, metres, and of the
lean, rad, below which the message names them."""

DECIDED = 30.0
"""So much more, in units of a logarithm of odds, must the best explanation fit: rows in their
hundreds are not independent to the last."""

SAME_OFFSET = 0.02
"""Solutions whose clocks and poses agree are one: within this, s, and 5 σ."""

PAIR = "target", "source"
"""What the LiDARs of a pair are called. Of the only pose of a pair no name is needed."""


def check_tracks(tracks: Sequence[Track]) -> None:
    """Refuse tracks in which more than one pole moves.

    Raises
    ------
    Refusal
        ``two_walks``.
    """
    worst = max(track.crowded for track in tracks)
    if worst > MAX_CROWDED:
        raise Refusal(
            "two_walks",
            f"in {worst:.0%} of the sweeps more than one pole moves, no more than "
            f"{MAX_CROWDED:.0%} may: carry one pole alone",
            {"crowded": worst},
        )


def chosen(solutions: Sequence[Adjusted], names: Sequence[str] = PAIR) -> Adjusted:
    """Take the solution that fits best, if it is the only one that fits and the walk suffices.

    Parameters
    ----------
    solutions
        Of every start, at least one.
    names
        Of the LiDARs, for messages.

    Raises
    ------
    Refusal
        ``walk_does_not_fit``, ``clock_jumps``, ``several_walks_fit`` and ``too_little_walk``.
    """
    best = min(solutions, key=lambda each: each.cost)
    _check_fit(best)
    _check_clock(best, names)
    for other in solutions:
        clocks = np.stack([best.clocks[:, 0], other.clocks[:, 0]])
        late = np.abs(clocks[1] - clocks[0])
        apart = _apart(best, other)
        if (late.max() > SAME_OFFSET or apart.max() > 5.0) and other.cost < best.cost + DECIDED:
            k = int(np.argmax(np.maximum(late / SAME_OFFSET, apart / 5.0)))
            first, second = clocks[:, k].tolist()
            off = se3.difference(best.T[k], other.T[k])
            raise Refusal(
                "several_walks_fit",
                f"clock offsets{_of(names, k)} of {first:.3f} s and {second:.3f} s both fit, with "
                f"poses that differ by {np.degrees(off.rotation):.1f}° and "
                f"{off.translation:.2f} m: walk with turns, and lean the pole to all sides",
                {"offset_s": first, "other_offset_s": second},
            )
    _check_geometry(best, names)
    if not best.converged:
        raise Refusal(
            "walk_does_not_fit",
            f"the adjustment came to no rest in {MAX_STEPS} steps, though {1 - best.left_out:.1%} "
            "of the returns fit: record one walk with one pole again",
            {"left_out": best.left_out},
        )
    return best


def _of(names: Sequence[str], k: int, word: str = "of") -> str:
    """Name one LiDAR of several; nothing of the source of a pair."""
    return f" {word} {names[k]}" if len(names) > 2 else ""


def _apart(one: Adjusted, other: Adjusted) -> Array:
    """(L,) distance between two poses of each LiDAR, in σ of both; 0 of the target."""
    found = [0.0]
    for k, (T, T_other) in enumerate(zip(one.T[1:], other.T[1:], strict=True)):
        step, own = se3.local(T, T_other), own_part(k + 1)
        both = (one.covariance + other.covariance)[own, own]
        found.append(float(np.sqrt(step @ np.linalg.solve(both, step))))
    return np.array(found)


def own_part(lidar: int) -> slice:
    """Where the pose of a LiDAR, but for the first, is in `Adjusted.covariance`."""
    return slice(7 * lidar - 7, 7 * lidar - 1)


def _check_fit(best: Adjusted) -> None:
    """Refuse what does not fit one pole that a person carries."""
    motion = (float(best.motion[0]), float(best.motion[2]))
    scale, jitter = (float(each) for each in best.spread.max(axis=0))
    rms = window_rms(best)
    fails = (
        rms > MAX_WINDOW_RMS
        or best.left_out > MAX_LEFT_OUT
        or scale > MAX_SCALE
        or jitter > MAX_JITTER
    )
    if fails or motion[0] > MAX_MOTION[0] or motion[1] > MAX_MOTION[1]:
        raise Refusal(
            "walk_does_not_fit",
            f"{best.left_out:.1%} of the returns are off the pole (no more than "
            f"{MAX_LEFT_OUT:.0%} may be), those of the worst 5 s by {rms:.1f} σ "
            f"({MAX_WINDOW_RMS:g}), ranges scatter {scale:.1f} times as stated "
            f"({MAX_SCALE:g}), edges by {1e3 * jitter:.1f} mrad ({1e3 * MAX_JITTER:g}), and the "
            f"pole accelerates with a noise of {motion[0]:.2g} m²/s³ ({MAX_MOTION[0]:g}) and "
            f"{motion[1]:.2g} /s³ ({MAX_MOTION[1]:g}): record one walk with one pole",
            {"left_out": best.left_out, "scale": scale, "motion": motion[0], "turn": motion[1]},
        )


def window_rms(best: Adjusted) -> float:
    """Largest root mean square of the residuals of a LiDAR in a window, in σ."""
    place = ((best.times - best.times.min()) / WINDOW).astype(np.int64)
    group = len(best.T) * place + best.lidar
    known = best.residuals.any(axis=1)
    count = np.bincount(group[known])
    square = np.minimum(np.abs(best.residuals[known]), CLIPPED) ** 2
    sums = np.stack([np.bincount(group[known], each) for each in square.T])
    enough = count >= FEWEST_IN_WINDOW
    return float(np.sqrt((sums[:, enough] / count[enough]).max(initial=0.0)))


def _check_clock(best: Adjusted, names: Sequence[str]) -> None:
    """Refuse clocks whose offset changes within the walk by more than they drift."""
    jumped = []
    for k, (windows, (_, *step)) in enumerate(
        zip(best.clock_windows, best.clock_steps, strict=True)
    ):
        found, most = windows[:, 1:], JUMP_SIGMAS
        if abs(step[0]) > STEP_SIGMAS * step[1]:
            found, most = np.array([step]), STEP_SIGMAS
        jumps = (np.abs(found[:, 0]) > MAX_JUMP) & (np.abs(found[:, 0]) > most * found[:, 1])
        if jumps.any():
            jump, off = found[int(np.argmax(np.abs(found[:, 0]) * jumps))]
            jumped.append((abs(jump) / off, k, float(jump), float(off)))
    if jumped:
        # A clock that jumps does so against all others, which seem to jump less.
        _, k, jump, off = max(jumped)
        raise Refusal(
            "clock_jumps",
            f"within the walk the clocks' offset{_of(names, k)} changes by {1e3 * jump:+.1f} ± "
            f"{1e3 * off:.1f} ms: let the clocks synchronise first, and record again",
            {"jump_s": jump, "sigma_s": off},
        )


def _check_geometry(best: Adjusted, names: Sequence[str]) -> None:
    """Refuse a walk that does not determine a pose, and name what it lacked."""
    each = range(1, len(best.T))
    parts = [best.covariance[own_part(k), own_part(k)] for k in each]
    errors = [predicted_error(part, (AT,))[0].sigma_m for part in parts]
    error, worst = max(zip(errors, each, strict=True))
    if error <= MAX_ERROR:
        return
    along, across, lean = extent_of(best)
    lacks = [
        fault
        for fault, is_so in (
            (f"the pole hardly moved ({along:.1f} m to either side)", along < LITTLE_WALK),
            (f"it was carried along a line ({across:.1f} m to either side)", across < NARROW_WALK),
            (f"it hardly leaned ({np.degrees(lean):.0f}°)", lean < LITTLE_LEAN),
        )
        if is_so
    ]
    why = ", ".join(lacks) or "the walk was short"
    raise Refusal(
        "too_little_walk",
        f"{AT:g} m away a point{_of(names, worst)} would be off by {error:.2g} m, 1 σ, no more "
        f"than {MAX_ERROR:g} m may be: {why}; walk on, to and fro and across, and lean the pole "
        "to all sides",
        {"sigma_m": error, "along_m": along, "across_m": across, "lean_rad": lean},
    )


def extent_of(best: Adjusted) -> tuple[float, float, float]:
    """Root mean square of the way along and across its longest direction, m, and lean, rad."""
    place, lean = best.axes[:, :2], best.axes[:, 2:]
    spread: Array = np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(place.T)), 0.0))
    return float(spread[1]), float(spread[0]), float(np.sqrt(lean.var(axis=0).sum()))
