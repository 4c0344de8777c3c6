"""The verdict in words, before all else: how good the poses are, every reason, what to do next."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from ..base.quantities import counted
from ..base.reasons import explain
from ..result import ReasonDoc
from ..result.site_parts import LidarDoc
from .certainty import (
    LIMIT_W,
    group_words,
    largest_error,
    least_likely,
    probability,
    ranked_tests,
    scene_words,
    worst_lidar,
)
from .markup import inline, number, plus_minus
from .page import Html, fill, fill_each, join
from .subject import Subject

VERDICTS = {
    "ok": ("✓", "Calibrated", "The poses below map points of each LiDAR into the frame of {}."),
    "warn": (
        "!",
        "Calibrated, with a warning",
        "There are poses, and a reason to look twice before you use them.",
    ),
    "refused": (
        "✕",
        "Refused: no pose",
        "The data do not support an answer that could be trusted, so none is given.",
    ),
}
"""Symbol, title and meaning of each status."""


def verdict(subject: Subject, notes: Sequence[str] = ()) -> Html:
    """Say ok, warn or refused, how good the poses are, and every reason with what to do.

    Parameters
    ----------
    subject
        What the page is of.
    notes
        What a reader has to know of the page itself before all else.
    """
    site = subject.site
    symbol, title, words = VERDICTS.get(site.status, ("?", site.status, ""))
    if site.status in ("ok", "warn") and subject.pair is None:
        title += f": {counted(len(site.lidars), 'LiDAR')} in one frame"
    paths = tuple(item.path for item in site.inputs)
    items = join(reason_item(reason, paths) for reason in site.reasons)
    said = " ".join((words.format(subject.frame), *_certainty(subject), *_checks(subject)))
    asked = _fitness(site.lidars)
    box = verdict_box(
        site.status if site.status in VERDICTS else "refused",
        symbol,
        title,
        join(
            (
                fill("strong", text=asked) if asked else Html(""),
                fill("p", text=said),
                fill("reasons", items=items) if items else items,
                _next_steps(subject),
            )
        ),
        _tiles(subject),
    )
    return join((fill_each("alert", notes), box))


def verdict_box(kind: str, symbol: str, title: str, body: Html, below: Html = Html("")) -> Html:
    """Set a verdict into a box of the colour of its kind: ok, warn or refused."""
    return fill("verdict", kind=kind, symbol=symbol, title=title, body=body, below=below)


def reason_item(reason: ReasonDoc, paths: tuple[str, ...] = ()) -> Html:
    """Show a reason: what happened here, what its code means, and what to do about it."""
    # A path keeps its small letter, also at the start.
    sentence = "" if reason.message.startswith(paths) else " sentence"
    known = explain(reason.code)
    advice = fill_each("li", map(inline, known.advice)) if known else Html("")
    return fill(
        "reason",
        title=known.title if known else "",
        code=reason.code,
        sentence=sentence,
        message=reason.message,
        meaning=fill("meaning", text=inline(known.help)) if known else Html(""),
        advice=fill("advice", title="What to do", items=advice) if advice else advice,
    )


def _fitness(lidars: Sequence[LidarDoc]) -> str:
    """Answer whether every pose is as accurate as was asked for; nothing where nothing was."""
    asked = [(each.name, each.fitness) for each in lidars if each.fitness is not None]
    if not asked:
        return ""
    first = asked[0][1]
    if len(asked) == 1:
        return f"{first.words[:1].upper()}{first.words[1:]}."
    short = [
        f"{name}: {fitness.words.partition(': ')[2] or fitness.words}"
        for name, fitness in asked
        if fitness.answer != "yes"
    ]
    need = f"Within {100 * first.within_m:g} cm at {first.at_m:g} m"
    return f"{need}: {'not all poses. ' + '; '.join(short) if short else 'yes, all poses'}."


def _certainty(subject: Subject) -> Iterator[str]:
    """Say how far off a point may land and mostly by what, and what the scene says of the pose."""
    site, pair = subject.site, subject.pair
    if site.datum and site.status != "refused":
        yield f"Datum: {site.datum}."
    worst = worst_lidar(site.lidars)
    if worst is not None:
        far = max(worst.predicted_error or [], key=lambda error: error.range_m)
        whose = f"; that is the worst, of {worst.name}" if pair is None else ""
        yield (
            f"A point {far.range_m:g} m away from its LiDAR is expected to land within "
            f"{plus_minus(far.sigma_m)} (1 σ) of its true place{whose}."
        )
        largest = largest_error(worst)
        if largest is not None:
            yield f"Largest source of error, {largest}."
    if pair is not None and pair.weakest is not None:
        yield f"Least certain, at the poles, 1 σ: {pair.weakest.words}."
    scene = None if pair is None else scene_words(pair)
    if scene is not None:
        yield f"What stands in the scene: {scene}."


def _checks(subject: Subject) -> Iterator[str]:
    """Say what the tests and loops showed, or which LiDARs nothing links."""
    site = subject.site
    if site.status == "refused":
        if len(site.groups) > 1:
            yield f"Nothing links these groups of LiDARs to each other: {group_words(site)}."
        return
    tests, high = ranked_tests(site)
    if tests:
        beyond = f"{counted(len(high), 'test')}" if high else "none"
        yield (
            f"{counted(len(tests), 'test')} of what the poses rest on: {beyond} above "
            f"{LIMIT_W:g}, the largest |w| is {number(abs(tests[0].w or 0.0), 1)} "
            f"({tests[0].name})."
        )
    loops = least_likely(site)
    if loops:
        yield (
            f"{counted(len(loops), 'loop')} of pairs closed; the least likely misclosure has a "
            f"probability of {probability(loops[0].probability)}."
        )
    if subject.pair is None and not site.tests and not site.loops:
        yield "Nothing checks these poses: no test and no loop."


def _next_steps(subject: Subject) -> Html:
    """Say what to do with an answer; what to do about a refusal is said with its reasons."""
    status = subject.site.status
    if status == "refused" or subject.site.lidars[-1].T_site_lidar is None:
        return Html("")
    first = "Settle the warning first, as written above. " if status == "warn" else ""
    return fill("next-site" if subject.pair is None else "next-pair", first=first)


def _tiles(subject: Subject) -> Html:
    """Show the predicted error at each range, of the worst LiDAR, and the largest figures."""
    site, pair = subject.site, subject.pair
    worst, (tests, _) = worst_lidar(site.lidars), ranked_tests(site)
    whose = ", worst" if pair is None else ""
    tiles = [
        (plus_minus(each.sigma_m), f"at {each.range_m:g} m, 1 σ{whose}")
        for each in (worst.predicted_error if worst else None) or []
    ]
    if pair is not None and pair.margin is not None:
        tiles.append((number(pair.margin, 3), "margin over the next"))
    if tests:
        tiles.append((number(abs(tests[0].w or 0.0), 1), "largest |w|"))
    cells = join(fill("tile", name=name, value=value) for value, name in tiles)
    return fill("tiles", cells=cells) if cells else cells
