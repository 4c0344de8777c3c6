"""Advice on the next action: until both LiDARs see poles that suit a calibration, and after an
answer whether to stop, keep still for longer, or move the poles."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, permutations, product

import numpy as np

from ..alignment.certainty import SWAY
from ..base.datatypes import Pole
from ..base.quantities import at_most, counted
from ..base.reasons import explain, plain
from ..base.uncertainty import floor
from ..base.uncertainty.purpose import USABLE, Need, displacement_bound, fitness
from ..extraction.acceptance_shape import MIN_POLE_RINGS
from ..result import ResultDoc
from ..verdict import FEW_POINTS, WEAK_ANGLE
from .live_poles import Looked, View, angle_between, hidden_by, is_same_pair, present

BEST_REACH = 6.0
"""Recommended distance for a pole that is too far away, metres, if the rings do not show it:
docs/poles.md recommends 3 to 7 m."""

NEAREST = 3.0
"""No pole is to be moved nearer, metres."""

SPOILT = {"moving_pole", "moving_lidar", "no_match", "placements_disagree", "poor_fit"}
SPOILT |= {"poles_inconsistent", "poles_scene_contradict", "scene_contradicts"}
"""Refusals after which the newest placement is left out: it would spoil the others too."""


ENOUGH = 0.99
"""Probability that the need is fulfilled, from which a watch stops. More than `purpose.CONFIDENCE`,
by which one answer is judged: a watch stops at the first of several that is good enough, which
favours answers that are good by chance. By 0.95 the need was fulfilled in 48 of 50 stops
(benchmarks/watch.py, good, seeds 1000 to 1055)."""


@dataclass(frozen=True)
class Advice:
    """What to do next.

    Attributes
    ----------
    code
        A name that stays the same: ``parallel``.
    text
        For the people at the poles, one or two sentences.
    is_good
        Nothing is to be done except to keep still.
    """

    code: str
    text: str
    is_good: bool = False


GOOD = Advice("good", "Good: keep still.", True)


def advise(views: Sequence[View], now: float, *, needs_poles: bool = True) -> Advice:
    """Choose the first action: obstacles to any answer come before weaknesses of the answer."""
    unseen = chain.from_iterable(_unseen(view, now) for view in views)
    if not needs_poles:
        return next(unseen, GOOD)
    steps = chain(
        unseen,
        _in_front(views, now),
        _missing(views, now),
        *(_moving(view, now) for view in views),
        _parallel(views, now),
        *(_edge(view, now) for view in views),
        *(_weak(view, now) for view in views),
    )
    return next(steps, GOOD)


def remedy_of(code: str) -> str:
    """The best action for a reason; empty if none is known."""
    explained = explain(code)
    return plain(explained.advice[0]) if explained and explained.advice else ""


def _unseen(view: View, now: float) -> Iterator[Advice]:
    looked = view.looked
    if view.fault:
        yield Advice("unreadable", f"{view.name}: {view.fault}")
    elif looked is None or now - looked.at > 3.0:
        why = view.silent or "its latest sweep is old"
        yield Advice("silent", f"{view.name} sends no sweeps: {why}")
    elif looked.refusal is not None:
        explained = explain(looked.refusal.code)
        remedy = plain(explained.advice[0]) if explained and explained.advice else ""
        yield Advice(
            looked.refusal.code, f"{view.name}: {looked.refusal.message}. {remedy}".strip()
        )


def _in_front(views: Sequence[View], now: float) -> Iterator[Advice]:
    for view in views:
        if view.looked is None:
            continue
        here = present(view.tracks, now)
        if len(here) > 1:
            continue
        for lost in (track for track in view.tracks if track not in here):
            before = hidden_by(view.looked.cloud, lost.pole)
            if before is not None:
                yield _step_aside(view.name, before, lost.distance)


def _step_aside(name: str, before: float, away: float) -> Advice:
    where = f"{before:.1f} m" if before else "right"
    return Advice(
        "in_front",
        f"Step aside: something {where} in front of {name} hides the pole that it saw {away:.1f} m "
        "away.",
    )


def _missing(views: Sequence[View], now: float) -> Iterator[Advice]:
    """For the LiDAR that sees the fewest poles, if fewer than two: advise on the missing one."""
    counts = [len(present(view.tracks, now)) for view in views]
    k = int(np.argmin(counts))
    if counts[k] > 1:
        return
    view, seen = views[k], counts[k]
    looked = view.looked
    assert looked is not None
    others = list(chain.from_iterable(_pairs(o, now) for o in views if o is not view))
    fitting = [
        pair[1] for pair in _pairs(view, now) if any(is_same_pair(pair, each) for each in others)
    ]
    sees = f"{view.name} sees {'no pole' if not seen else 'one pole'}"
    if fitting:
        yield _doubtful(sees, view.name, _best(fitting), looked)
    elif max(counts) > seen:
        other = views[int(np.argmax(counts))].name
        yield Advice(
            "hidden",
            f"{sees}, {other} sees {max(counts)}. The other pole is hidden from {view.name} or too "
            f"far away: move it to where {view.name} sees it, within {BEST_REACH:g} m"
            f"{_ahead(view)}.",
        )
    elif seen:
        where = f"{present(view.tracks, now)[0].distance:.1f} m from {view.name}"
        yield Advice(
            "missing",
            f"Only one pole is seen, {where}. Place another 1 to 4 m next to it, leaning by 15° "
            "or more against it.",
        )
    else:
        yield Advice(
            "no_poles",
            f"No LiDAR sees a pole. Place two, {NEAREST:g} to {BEST_REACH + 1:g} m from both "
            f"LiDARs{''.join(map(_ahead, views))}, with retro-reflective tape all around.",
        )


def _ahead(view: View) -> str:
    """Describe the field of view of a LiDAR if it is limited."""
    if view.sensor is None or view.sensor.sees_all_around:
        return ""
    return f", inside the {math.degrees(view.sensor.turn):.0f}° that {view.name} sees"


def _pairs(view: View, now: float) -> Iterator[tuple[Pole, Pole]]:
    """Any two poles of a LiDAR; if it sees fewer than two, the one with a possible second."""
    poles = [track.pole for track in present(view.tracks, now)]
    if len(poles) > 1:
        yield from permutations(poles, 2)
    elif view.looked is not None:
        may_be = (*view.looked.doubtful, *view.looked.dim)
        yield from product(poles, may_be) if poles else permutations(may_be, 2)


def _best(poles: Sequence[Pole]) -> Pole:
    return max(poles, key=lambda each: len(each.xyz))


def _doubtful(sees: str, name: str, pole: Pole, looked: Looked) -> Advice:
    """Explain the fault of a line that fits a pole of the other LiDAR."""
    away = float(np.linalg.norm(pole.point))
    if any(pole is each for each in looked.dim):
        return Advice(
            "dim",
            f"{sees}. The tape of the other, {away:.1f} m away, is too dim for it: put on new "
            "tape, all around, or place it nearer. It would need a threshold below "
            f"{looked.threshold:.3g}.",
        )
    what = f"{sees}. The other, {away:.1f} m away, has {counted(len(pole.xyz), 'return')} on "
    what += counted(pole.rings, "ring")
    if len(pole.xyz) < FEW_POINTS or pole.rings <= MIN_POLE_RINGS:
        return Advice("too_far", f"{what}: place it {_nearer(pole, name)}.")
    why = next(w for each, w in zip(looked.doubtful, looked.why, strict=True) if each is pole)
    return Advice(
        "doubtful",
        f"{what}, but {why}. Place it 0.5 m from everything else; is --radius right?",
    )


def _nearer(pole: Pole, name: str) -> str:
    """How much nearer a pole has to be for enough rings and returns."""
    away = float(np.linalg.norm(pole.point))
    share = min(pole.rings / (MIN_POLE_RINGS + 2), math.sqrt(len(pole.xyz) / (1.5 * FEW_POINTS)))
    to = max(min(away * share, max(BEST_REACH, 0.7 * away)), min(NEAREST, 0.7 * away))
    return f"{away - to:.1f} m nearer to {name}"


def _moving(view: View, now: float) -> Iterator[Advice]:
    restless = [t for t in present(view.tracks, now) if not t.is_still(now)]
    moving = [track for track in restless if track.has_moved]
    which = " and ".join(f"{track.distance:.1f} m" for track in moving or restless)
    if moving:
        yield Advice(
            "moving", f"Keep the poles still: {view.name} sees one that moves, {which} away."
        )
    elif restless:
        yield Advice("settling", f"Wait a moment: {view.name} watches the pole {which} away.")


def _parallel(views: Sequence[View], now: float) -> Iterator[Advice]:
    angles = [angle_between([t.pole for t in present(view.tracks, now)]) for view in views]
    known = [each for each in angles if each is not None]
    if known and np.mean(known) < WEAK_ANGLE:
        degrees = math.degrees(float(np.mean(known)))
        yield Advice(
            "parallel",
            f"The angle between the poles is {degrees:.0f}°: lean one by "
            f"{math.degrees(WEAK_ANGLE):.0f}° or more, 20° is good.",
        )


def _edge(view: View, now: float) -> Iterator[Advice]:
    for track in present(view.tracks, now):
        if view.is_at_edge(track.pole):
            yield Advice(
                "at_edge",
                f"The pole {track.distance:.1f} m from {view.name} is at the edge of its field "
                "of view: move it a metre inward.",
            )


def _weak(view: View, now: float) -> Iterator[Advice]:
    """Advise on the second best pole, since two determine a pose."""
    here = list(present(view.tracks, now))
    here.sort(key=lambda track: (track.pole.rings, len(track.pole.xyz)), reverse=True)
    if len(here) < 2:
        return
    pole = here[1].pole
    if len(pole.xyz) < FEW_POINTS or pole.rings <= MIN_POLE_RINGS:
        assert view.looked is not None
        before = hidden_by(view.looked.cloud, here[1].rest)
        if before:
            yield _step_aside(view.name, before, here[1].distance)
        away = float(np.linalg.norm(pole.point))
        have = f"{counted(len(pole.xyz), 'return')} on {counted(pole.rings, 'ring')}"
        yield Advice(
            "nearer",
            f"{view.name} has {have} of the pole {away:.1f} m away: place it "
            f"{_nearer(pole, view.name)}.",
        )


@dataclass(frozen=True, eq=False)
class Outcome:
    """An answer, and its consequences for the next action.

    Attributes
    ----------
    document
        The answer.
    need
        The required accuracy.
    probability, bound
        That the need is fulfilled; and the error bound of all points up to that range, with 95 %
        probability, metres. None if it was refused.
    """

    document: ResultDoc
    need: Need
    probability: float | None
    bound: float | None

    @property
    def is_enough(self) -> bool:
        """Whether to stop: the verdict is ok, and the need is fulfilled."""
        is_certain = self.probability is not None and self.probability >= ENOUGH
        return self.document.status == "ok" and is_certain

    @property
    def is_spoilt(self) -> bool:
        """Whether the newest placement cannot be combined with others."""
        codes = {reason.code for reason in self.document.reasons}
        return self.document.status == "refused" and bool(codes & SPOILT)

    @property
    def seconds_more(self) -> float:
        """How much longer to record, if the need is not fulfilled because masts sway."""
        budget = self.document.budget or []
        if self.is_enough or not budget or budget[0].name != SWAY:
            return 0.0
        return max((each.sway.seconds_more for each in self.document.sways), default=0.0)


def outcome_of(document: ResultDoc, need: Need | None) -> Outcome:
    """Judge an answer by the given need, or by the default need."""
    requested = need or USABLE
    if document.covariance is None:
        return Outcome(document, requested, None, None)
    # That of the document includes the possibility of an entirely wrong pose.
    fit = document.fitness or fitness(document.covariance, requested)
    return Outcome(document, requested, fit.probability, fit.bound_m)


def advice_after(outcome: Outcome, again: str) -> Advice:
    """Advise on the next action after an answer.

    Parameters
    ----------
    outcome
        Of all that was recorded.
    again
        What to record if that is not enough.
    """
    document = outcome.document
    if outcome.is_enough:
        return Advice("done", f"Done: {_so_far(outcome)}.", True)
    if all(reason.code == "not_fit_for_purpose" for reason in document.reasons):
        least = displacement_bound(floor(), outcome.need.at)
        if least > outcome.need.within:
            return Advice(
                "need_too_small",
                f"No recording can show less than {at_most(least)}: stop here, or require less "
                f"with --need-cm. {_so_far(outcome).capitalize()}.",
            )
        return Advice(
            "need_not_met",
            f"{again} So far {_so_far(outcome)}; needed is {outcome.need.text}, "
            f"{100 * ENOUGH:g} % sure.",
        )
    reason = next(r for r in document.reasons if r.code != "not_fit_for_purpose")
    if reason.code == "radius_differs" and document.radius is not None:
        millimetres = 1e3 * document.radius.estimated
        return Advice(
            reason.code,
            f"The poles seem to have a radius of {millimetres:.0f} mm, not "
            f"{1e3 * document.config.radius_m:.0f}: measure one, and start again with --radius.",
        )
    explained = explain(reason.code)
    title = explained.title if explained else reason.message
    verdict = "Refused" if document.status == "refused" else "A warning"
    return Advice(reason.code, f"{verdict}: {title.lower()}. {remedy_of(reason.code)}".strip())


def another(placements: int) -> str:
    """Recommend what to record after a number of placements of poles that are set up."""
    return f"Placement {placements + 1}: set up the poles at other positions, on another side."


def _so_far(outcome: Outcome) -> str:
    at = f"up to {outcome.need.at:g} m away"
    if outcome.bound is None:
        return f"no error bound {at} is certain"
    return f"no point {at} is off by more than {at_most(outcome.bound)}, 95 % sure"


def keep_still(captured: int, wanted: int, seconds: float) -> Advice:
    """Report that all is good, and how much remains."""
    left = f", {math.ceil(seconds)} s more" if seconds > 1 and captured >= wanted else ""
    return Advice(
        "good", f"Good: keep still, {captured} of {counted(wanted, 'sweep')}{left}.", True
    )
