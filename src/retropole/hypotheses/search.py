"""Search for the pose that the poles allow and the scene confirms: match, score, choose.

First with the confirmed poles; if they give no answer, with the candidates too; and if the LiDARs
have too few in common for a pose, with one and the surroundings.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import chain

from ..base.datatypes import Placement, Pole, Scan
from ..base.errors import Refusal
from ..base.timing import Step
from ..extraction.candidates import with_candidates, with_dimmer_candidates
from ..surfaces import visibility
from ..surfaces.scans import why_few_poles
from . import correspondence, icp_refinement
from .absence import without_absent
from .by_place import SET_UP_TWO, choose_by_place, confirmed_by_place, has_rival
from .candidate_confirmation import is_confirmed, poles_agree
from .choice import choose_best
from .evidence import REDUNDANT_POLES
from .one_pole import MOST_POLES
from .placements import (
    Chosen,
    PairedPlacement,
    PlacementHypotheses,
    PlacementMatches,
    Share,
    Tried,
    uses_candidates,
    with_attempts,
)
from .prior import PosePrior, agreeing_with_prior

RESCUED = {
    *("too_few_poles", "parallel_poles", "no_match", "pole_count", "ambiguous", "no_overlap"),
    "prior_contradicted",
}
"""Refusals after which candidate poles are tried: other poles may give an answer."""

FROM_SURROUNDINGS = {"too_few_poles", "parallel_poles", "no_match", "pole_count", "no_overlap"}
"""Refusals after which poles that do not determine the whole pose are matched, and the rest
is determined from the surroundings."""

ENOUGH_CONFIRMED = 2
"""With this many confirmed poles in a cloud its threshold is right, and lower ones are not
tried."""


def choose_with_candidates(
    placements: Sequence[Placement],
    radius: float,
    step: Step,
    *,
    count: int | None = None,
    prior: PosePrior | None = None,
    by_place: bool = True,
) -> Chosen:
    """Choose with the confirmed poles; if they give no answer, with the candidates too.

    If these are not confirmed either, the hypotheses are first refined by the scene. Finally one
    pole is sufficient if the surroundings determine the rest.

    Parameters
    ----------
    placements
        With what was found in each of their clouds.
    radius
        Of the poles, metres.
    step
        Names a step that starts, and times it.
    count, prior
        How many poles both LiDARs see, and what is known of the rotation.
    by_place
        Whether the surroundings may give what one pole does not determine.

    Returns
    -------
    Chosen
        With the first refusal if the candidate poles are not confirmed, and with the counts of
        what was not tried.
    """
    if count == 0:
        return _choose_without_poles(placements, radius, step, prior)
    first = choose(placements, step, count=count, prior=prior)
    if first.refusal is None:
        return first
    attempts = [first]
    last = placements
    if first.refusal.code in RESCUED:
        for last in _looks(placements, radius, step):
            for attempt in _attempts(first, last, step, count, prior):
                attempts.append(attempt)
                if (
                    attempt.refusal is None
                    and is_confirmed(attempt.paired, attempt.hypotheses, radius)
                    and not has_rival(attempt.paired, radius)
                ):
                    return attempt
        # The last refined, and by all poles.
        for confirmed in map(confirmed_by_place, reversed(attempts)):
            if (
                confirmed is not None
                and poles_agree(confirmed.paired, radius)
                and not has_rival(confirmed.paired, radius)
            ):
                return confirmed
    if by_place and first.refusal.code in FROM_SURROUNDINGS:
        looks = (placements,) if last is placements else (placements, last)
        chosen = _first_by_place(looks, radius, step, count, prior)
        # Its refusal is not useful to users whose two poles are well set up.
        if chosen is not None and (
            chosen.refusal is None or first.refusal.code in ("too_few_poles", "parallel_poles")
        ):
            return chosen
    tried = [placement.tried for attempt in attempts for placement in attempt.scored]
    refusal = with_attempts(explained(first.refusal, placements), tried)
    return replace(first, refusal=refusal)


def explained(refusal: Refusal, placements: Sequence[Placement]) -> Refusal:
    """State why a LiDAR sees too few poles, if its recordings show it: then no threshold helps."""
    name = refusal.values.get("lidar")
    if refusal.code != "too_few_poles" or name not in ("target", "source"):
        return refusal
    scans = (each.target if name == "target" else each.source for each in placements)
    why = next(filter(None, map(why_few_poles, scans)), "")
    if not why:
        return refusal
    said = refusal.message.partition("; ")[0]
    return Refusal(refusal.code, f"{said}; {why}", refusal.values)


def _choose_without_poles(
    placements: Sequence[Placement], radius: float, step: Step, prior: PosePrior | None
) -> Chosen:
    chosen = _first_by_place([placements], radius, step, 0, prior)
    if chosen is not None:
        return chosen
    refusal = Refusal(
        "no_overlap",
        "without poles the surroundings must determine the pose, and under no pose do both the "
        f"ground and the objects above it coincide; {SET_UP_TWO}",
        {"poles": 0},
    )
    return Chosen((), (), refusal)


def choose_about_one_pole(
    placements: Sequence[Placement], radius: float, step: Step
) -> Chosen | None:
    """Choose with one pole and the surroundings only: with confirmed poles, then with candidates.

    Parameters
    ----------
    placements
        With what was found in each of their clouds.
    radius
        Of the poles, metres.
    step
        Names a step that starts, and times it.

    Returns
    -------
    Chosen or None
        None if nothing coincides in this way.
    """
    return _first_by_place(
        chain([placements], _looks(placements, radius, step)), radius, step, None, None
    )


def _first_by_place(
    looks: Iterable[Sequence[Placement]],
    radius: float,
    step: Step,
    count: int | None,
    prior: PosePrior | None,
) -> Chosen | None:
    """Choose with the surroundings and the first poles that coincide.

    A candidate pole whose surroundings do not determine the pose causes no refusal: it may be no
    pole.
    """
    before: list[Pole] = []
    for found in looks:
        every = _with_all(found)
        own = [pole for one in every for scan in one.scans for pole in scan.poles[:MOST_POLES]]
        if before and own == before:
            continue
        before = own
        with step("place"):
            chosen = choose_by_place(every, radius, count=count, prior=prior)
        if chosen is not None and (chosen.refusal is None or not _candidate_returns(found)):
            return chosen
    return None


def _looks(
    placements: Sequence[Placement], radius: float, step: Step
) -> Iterator[Sequence[Placement]]:
    """Search for candidate poles, and then for dimmer ones, if that finds more."""
    returns = -1
    for is_dimmer in (False, True):
        with step("doubtful"):
            placements = [
                Placement(
                    _searched(each.target, radius, is_dimmer),
                    _searched(each.source, radius, is_dimmer),
                )
                for each in placements
            ]
        before, returns = returns, _candidate_returns(placements)
        if returns != before:
            yield placements


def _attempts(
    first: Chosen,
    placements: Sequence[Placement],
    step: Step,
    count: int | None,
    prior: PosePrior | None,
) -> Iterator[Chosen]:
    """Choose with the candidate poles too, in several ways, one after the other."""
    # Without any candidate pole the confirmed ones may still converge.
    wider = first
    if _candidate_returns(placements):
        wider = choose(_with_all(placements), step, count=count, prior=prior)
    yield wider
    settled = choose_after_icp(wider, step)
    yield settled
    # A third line that fits by chance turns the pose of two poles, and prevents convergence.
    for fewer in _without_one(placements, settled.paired):
        chosen = choose(_with_all(fewer), step, count=count, prior=prior)
        yield choose_after_icp(chosen, step)


def choose(
    placements: Sequence[Placement],
    step: Step,
    *,
    count: int | None = None,
    prior: PosePrior | None = None,
) -> Chosen:
    """Match the poles of every placement and choose by the scene; a refusal is kept."""
    try:
        with step("match"):
            matched = [match_poles(placement, count, prior) for placement in placements]
        with step("disambiguate"):
            return choose_best([score_hypotheses(each) for each in matched])
    except Refusal as refusal:
        return Chosen((), (), refusal)


def choose_after_icp(chosen: Chosen, step: Step) -> Chosen:
    """Refine the hypotheses of a choice by the scene, if it has any, and choose once more."""
    if not chosen.scored:
        return chosen
    try:
        with step("settle"):
            settled = [refine_by_icp(each) for each in chosen.scored]
            return choose_best([score_hypotheses(each) for each in settled])
    except Refusal as refusal:
        return Chosen((), (), refusal)


def match_poles(
    placement: Placement, count: int | None, prior: PosePrior | None
) -> PlacementMatches:
    """Find the matches of the source poles with the target poles that the prior allows."""
    found, laid = correspondence.every_match(
        placement.target.poles, placement.source.poles, count, part=uses_candidates(placement)
    )
    allowed = agreeing_with_prior(found, prior)
    best = allowed[: correspondence.MAX_HYPOTHESES]
    return PlacementMatches(placement, best, Tried(laid, Share(len(best), len(allowed))))


def score_hypotheses(matched: PlacementMatches) -> PlacementHypotheses:
    """Score every match of a placement by the scene, and by the poles that it leaves out."""
    target, source = matched.placement.target.cloud, matched.placement.source.cloud
    scored = visibility.score_hypotheses(target, source, matched.matches)
    hypotheses = without_absent(matched.placement, scored)
    return PlacementHypotheses(matched.placement, hypotheses, matched.tried)


def refine_by_icp(scored: PlacementHypotheses) -> PlacementMatches:
    """Refine the hypotheses of a placement by the scene, as far as their poles allow."""
    target, source = scored.placement.target, scored.placement.source
    matches = icp_refinement.refine_by_icp(
        target.cloud, source.cloud, scored.hypotheses, target.poles, source.poles
    )
    exact = sum(each.match.exact for each in scored.hypotheses)
    fitting = Share(min(exact, icp_refinement.MOST_REFINED), exact)
    return PlacementMatches(scored.placement, matches, scored.tried._replace(fitting=fitting))


def _without_one(
    placements: Sequence[Placement], paired: Sequence[PairedPlacement]
) -> Iterator[Sequence[Placement]]:
    """A placement without the candidate poles of one pair; unchanged with several placements, since
    chance does not recur."""
    if len(paired) != 1 or len(paired[0].hypothesis.match.pairs) < REDUNDANT_POLES:
        return
    for pair in zip(paired[0].target_poles, paired[0].source_poles, strict=True):
        whole = placements[0]
        fewer = Placement(_without(whole.target, pair[0]), _without(whole.source, pair[1]))
        if fewer.target is not whole.target or fewer.source is not whole.source:
            yield [fewer]


def _without(scan: Scan, pole: Pole) -> Scan:
    """A scan without one of its candidate poles; unchanged if the pole is not a candidate."""
    left = tuple(own for own in scan.candidates if own is not pole)
    if scan.detection is None or len(left) == len(scan.candidates):
        return scan
    return replace(scan, detection=replace(scan.detection, candidates=left))


def _searched(scan: Scan, radius: float, is_dimmer: bool) -> Scan:
    """A scan with its candidate poles; the `is_dimmer` ones only if few are certain."""
    if scan.detection is None or (is_dimmer and len(scan.poles) >= ENOUGH_CONFIRMED):
        return scan
    look = with_dimmer_candidates if is_dimmer else with_candidates
    return replace(scan, detection=look(scan.cloud, scan.detection, radius, scan.sensor))


def _candidate_returns(placements: Sequence[Placement]) -> int:
    """Number of returns on the candidate poles of all clouds: a lower threshold shows more."""
    return sum(
        len(pole.index) for each in placements for scan in each.scans for pole in scan.candidates
    )


def count_candidates(scan: Scan) -> Scan:
    """Add the candidate poles of a scan to its poles, after the confirmed ones."""
    if scan.detection is None:
        return scan
    return replace(scan, detection=replace(scan.detection, poles=(*scan.poles, *scan.candidates)))


def _with_all(placements: Sequence[Placement]) -> list[Placement]:
    return [
        Placement(count_candidates(each.target), count_candidates(each.source))
        for each in placements
    ]
