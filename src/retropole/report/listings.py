"""Tables of an answer, and how certain it is in words, as page and terminal both show them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from ..adjustment.snooping import POOR
from ..base import se3
from ..base.carried import SiteWalk
from ..base.clocks import NOTICED, is_set, words_of
from ..base.datatypes import Array
from ..base.quantities import UNKNOWN, counted, error, percent, value, value_and_error
from ..base.uncertainty import (
    BUDGET_RANGE,
    ErrorAtRange,
    Uncertainty,
    predicted_error,
    source_words,
)
from ..hypotheses.choice import hypothesis_name
from ..result import HypothesisDoc, InputDoc, PoleDoc, ResultDoc, TestDoc
from ..result.contents import RejectedDoc
from ..result.site import LIDARS, FoundDoc, LidarDoc, LoopDoc, PairDoc, SiteDoc
from .subject import Subject, pair_name

POLE_COLUMNS = "pole; x, m; y, m; z, m; length, m; points; rings; rms, mm"

REJECTED_COLUMNS = "mark; code; reason; points; x, m; y, m; z, m"

DEGREES = 180 / np.pi

UNCHECKED = 0.01
"""Less redundancy than this is none: nothing would show an error there."""

NAMED = 3
"""Number of conspicuous observations that are named; the page lists them all."""


class Listing(NamedTuple):
    """A table: its caption, names of its columns, its rows, and which columns are text."""

    caption: str
    header: Sequence[str]
    rows: Sequence[Sequence[object]]
    text_columns: Sequence[int] = ()

    def only(self, *columns: int) -> Listing:
        """Keep some columns."""
        rows = [[row[k] for k in columns] for row in self.rows]
        return Listing(self.caption, [self.header[k] for k in columns], rows)


def columns(names: str) -> list[str]:
    """Split names of columns in one line, between semicolons."""
    return names.split("; ")


def pole_row(name: str, pole: PoleDoc) -> list[str]:
    """Write the figures of a pole, in the order of `POLE_COLUMNS`."""
    size = (number(pole.length_m, 2), str(pole.points), str(pole.rings))
    return [name, *numbers(pole.point_m, 3), *size, number(pole.rms_m, 1, 1000)]


def rejected_row(mark: str, cluster: RejectedDoc) -> list[str]:
    """Write why a cluster was rejected, in the order of `REJECTED_COLUMNS`."""
    text = (cluster.code, cluster.reason, str(cluster.points))
    return [mark, *text, *numbers(cluster.centre_m, 2)]


def numbers(values: Array, digits: int) -> list[str]:
    """Write several numbers with the same digits."""
    return [number(value, digits) for value in values]


def poles(subject: Subject, k: int) -> Listing:
    """List the poles that a LiDAR sees, of several placements with the one of each."""
    rows = [
        [*place, *pole_row(subject.pole(k, i), pole)]
        for place, each in _recorded(subject, k)
        for i, pole in enumerate(each.poles)
    ]
    return _of_placements(f"Poles in the frame of {subject.called(k)}", POLE_COLUMNS, rows, 1)


def rejected(subject: Subject, k: int) -> Listing:
    """List the rejected clusters of a LiDAR, each with its mark in the view and its reason."""
    rows = [
        [*place, *rejected_row(rejected_mark(k, i), cluster)]
        for place, each in _recorded(subject, k)
        for i, cluster in enumerate(each.rejected)
    ]
    return _of_placements(f"Rejected clusters of {subject.called(k)}", REJECTED_COLUMNS, rows, 3)


def _recorded(subject: Subject, k: int) -> Iterator[tuple[list[str], FoundDoc]]:
    """Give the poles and clusters found in each recording of a LiDAR, with its placement if there
    are several."""
    placements = subject.placements
    for place, each in zip(placements, subject.site.found[k], strict=True):
        if each is not None:
            yield [place] if len(placements) > 1 else [], each


def _of_placements(
    caption: str, names: str, rows: Sequence[Sequence[object]], text_columns: int
) -> Listing:
    several = bool(rows) and len(rows[0]) > len(columns(names))
    header = columns(("placement; " if several else "") + names)
    return Listing(caption, header, rows, range(1, text_columns + several))


def rejected_mark(lidar: int, k: int) -> str:
    """Write how the view marks the k-th rejected cluster of a LiDAR: ``× 3``, ``+ 0``."""
    return f"{'+' if lidar % 2 else '×'} {k}"


def found(subject: Subject) -> Listing:
    """Count what each LiDAR sees in each placement."""
    rows = [
        [lidar.name, *("not recorded" if each is None else _found(each) for each in of_lidar)]
        for lidar, of_lidar in zip(subject.site.lidars, subject.site.found, strict=True)
    ]
    header = ["LiDAR", *subject.placements]
    return Listing("Poles found in each placement", header, rows, range(1, len(header)))


def _found(each: FoundDoc) -> str:
    text = counted(len(each.poles), "pole")
    if each.rejected:
        text += f", {len(each.rejected)} rejected"
    return text if each.refusal is None else f"{text} ({each.refusal.code})"


def hypotheses(result: ResultDoc) -> Listing:
    """List the ways of matching the poles of a pair, the best first."""
    rows = [
        [
            name_of(k, each),
            " ".join(map(pair_name, each.pairs)),
            "yes" if each.exact else "no",
            number(each.pole_rms_m, 1, 1000),
            number(each.icp_rotation_rad, 4),
            number(each.icp_translation_m, 4),
            number(each.overlap, 1, 100, " %"),
            number(each.free_space_violation, 1, 100, " %"),
            number(each.score, 3),
        ]
        for k, each in enumerate(result.hypotheses)
    ]
    names = "hypothesis; pairs; exact; pole rms, mm; e_r, rad; e_t, m; overlap; "
    header = columns(names + "free-space violation; score")
    return Listing("Hypotheses, best first", header, rows, (1,))


def name_of(k: int, hypothesis: HypothesisDoc) -> str:
    """Name the k-th hypothesis, and mark it if it is chosen."""
    return hypothesis_name(k) + (" · chosen" if hypothesis.chosen else "")


class PoseRow(NamedTuple):
    """Where a LiDAR is, in words; `sigma` is that of a point 30 m away, metres, None for none."""

    name: str
    x: str
    y: str
    z: str
    roll: str
    pitch: str
    yaw: str
    sigma: float | None


def pose_rows(site: SiteDoc) -> list[PoseRow]:
    """Write each pose in the coordinates of the frame, degrees; none where refused."""
    rows = []
    for lidar in site.lidars:
        if lidar.T_site_lidar is not None:
            R, t = lidar.T_site_lidar[:3, :3], lidar.T_site_lidar[:3, 3]
            x, y, z = numbers(t + site.frame.offset, 3)
            roll, pitch, yaw = numbers(np.degrees(se3.rpy_from_rotation(R)), 2)
            rows.append(PoseRow(lidar.name, x, y, z, roll, pitch, yaw, far_error(lidar)))
    return rows


def poses(site: SiteDoc) -> Listing:
    """List where the LiDARs are in the coordinates of the frame, each with its certainty."""
    requested = any(lidar.fitness is not None for lidar in site.lidars)
    rows = []
    for row, lidar in zip(pose_rows(site), site.lidars, strict=False):
        sigma = np.sqrt(np.maximum(np.diag(np.asarray(lidar.covariance))[3:], 0.0)).tolist()
        at = ", ".join(map(error, sigma)) if any(sigma) else UNKNOWN
        answer = [lidar.fitness.answer if lidar.fitness else UNKNOWN] if requested else []
        far = f"± {error(row.sigma)}" if row.sigma else UNKNOWN
        rows.append([*row[:7], far, at, *answer])
    names = "LiDAR; x, m; y, m; z, m; roll, °; pitch, °; yaw, °; 1 σ at 30 m; 1 σ of x, y, z"
    header = columns(names + "; good enough" * requested)
    return Listing(f"Poses of the LiDARs; frame: {site.frame.name}", header, rows)


def pairs(site: SiteDoc) -> Listing:
    """List the pairs, those with the largest w first."""
    refused = site.status == "refused"
    rows = [
        [
            " – ".join(site.lidars[k].name for k in pair.lidars),
            *(_size(pair.w, POOR, 1), pair.shared_poles, pair.patches or UNKNOWN),
            pair_words(pair, refused)
            + ("" if pair.refusal is None else f": {pair.refusal.message}"),
        ]
        for pair in sorted(site.pairs, key=lambda each: (-abs(each.w or 0.0), each.lidars))
    ]
    caption = "Pairs" if refused else "Pairs, the largest |w| first"
    header = columns("pair; |w|; shared poles; patches; the pair alone")
    return Listing(caption, header, rows, (4,))


def pair_words(pair: PairDoc, refused: bool) -> str:
    """Give the answer of a pair alone on its pose."""
    if pair.standing == 1:
        return "decides by itself"
    if pair.standing > 1:
        ways = counted(pair.standing, "way")
        return f"leaves {ways}" if refused else f"leaves {ways}, decided by others"
    return "no separate answer" if refused else "linked through others"


def loops(site: SiteDoc) -> Listing:
    """List by how much the pairwise poses around each loop fail to close."""
    rows = [
        [
            around(site, loop),
            number(loop.rotation, 3, DEGREES),
            number(loop.translation, 1, 1000),
            *(number(loop.chi2, 1), loop.freedom, probability(loop.probability)),
        ]
        for loop in sorted(
            site.loops, key=lambda each: 1.0 if each.probability is None else each.probability
        )
    ]
    header = columns("loop; rotation, deg; translation, mm; χ²; freedom; probability")
    return Listing("Misclosures, the least likely first", header, rows)


def tests(site: SiteDoc) -> Listing:
    """List the tests, the largest w first."""
    rows = [
        [
            *(test.name, test.kind, _size(test.w, test.allowed, 2), number(test.allowed, 1)),
            *(number(test.chi2, 1), test.freedom),
            number(test.redundancy, 0, 100, " %"),
            *(error(test.minimal_detectable), error(test.external)),
        ]
        for test in sorted(site.tests, key=lambda each: -abs(each.w or 0.0))
    ]
    names = (
        "observation; kind; |w|; limit; χ²; freedom; redundancy; smallest error found; "
        "effect at 30 m"
    )
    return Listing("Tests, the largest |w| first", columns(names), rows, (1,))


def _size(w: float | None, allowed: float | None, digits: int) -> str:
    text = number(None if w is None else abs(w), digits)
    return text + (" stands out" if _is_large(w, allowed) else "")


def _is_large(w: float | None, allowed: float | None) -> bool:
    return w is not None and allowed is not None and abs(w) > allowed


def changes(subject: Subject) -> Listing:
    """List the changes of the poses without each placement."""
    site, pair = subject.site, subject.pair
    rows = [
        [
            subject.placement(each.placement),
            *([] if pair is None else [_both(pair, each.placement)]),
            number(each.rotation, 3, DEGREES),
            number(each.translation, 1, 1000),
            UNKNOWN if each.lidar is None else site.lidars[each.lidar].name,
        ]
        for each in site.without
    ]
    poles = "" if pair is None else "poles, target + source; "
    header = columns(f"without placement; {poles}rotation, deg; translation, mm; of LiDAR")
    caption = f"Change of the {'poses' if pair is None else 'pose'} without each placement"
    return Listing(caption, header, rows, (len(header) - 1,))


def _both(pair: ResultDoc, placement: int) -> str:
    each = pair.placements[placement]
    return f"{each.poles_target} + {each.poles_source}"


def left_out_words(document: InputDoc) -> str:
    """State how many points and frames of too many were left out; nothing if none were."""
    parts = [
        counted(count, what)
        for count, what in ((document.thinned, "point"), (document.frames_left_out, "frame"))
        if count
    ]
    return f"{' and '.join(parts)} left out as too many" if parts else ""


Stated = ResultDoc | LidarDoc
"""What states how certain a pose is: the result of a pair, or one LiDAR of a site."""


def number(value: float | None, digits: int, scale: float = 1.0, unit: str = "") -> str:
    """Write a number with fixed digits, without a negative zero; a dash where there is none."""
    if value is None or not math.isfinite(value):
        return UNKNOWN
    return f"{round(float(value) * scale, digits) + 0.0:.{digits}f}{unit}"


class ErrorParts(NamedTuple):
    """Predicted error at a range, metres, and its two parts; squared, they add up."""

    range_m: float
    together: float
    random: float
    systematic: float


def error_parts(
    stated: Sequence[ErrorAtRange] | None, parts: Uncertainty | None
) -> list[ErrorParts]:
    """Part the predicted error at each range; empty if its parts are not stated."""
    if not stated or parts is None:
        return []
    ranges = tuple(each.range_m for each in stated)
    random, systematic = (
        predicted_error(part, ranges) for part in (parts.random, parts.systematic)
    )
    return [
        ErrorParts(each.range_m, each.sigma_m, of_random.sigma_m, of_systematic.sigma_m)
        for each, of_random, of_systematic in zip(stated, random, systematic, strict=True)
    ]


def far_error(stated: Stated) -> float | None:
    """Predicted error of a point at `BUDGET_RANGE`, 1 σ, metres; None if none is stated."""
    errors = stated.predicted_error or []
    return next((each.sigma_m for each in errors if each.range_m == BUDGET_RANGE), None)


def worst_lidar(lidars: Sequence[LidarDoc]) -> LidarDoc | None:
    """Find the LiDAR with the largest predicted error; None if none is stated."""
    stated = [each for each in lidars if each.predicted_error]
    return max(stated, key=lambda each: far_error(each) or 0.0, default=None)


def largest_error(stated: Stated) -> str | None:
    """Name the main source of error, and its share of the variance; None without a budget."""
    if not stated.budget:
        return None
    entry = max(stated.budget, key=lambda each: each.share_at_30m)
    return f"{source_words(entry.name, entry.sensor)} ({percent(entry.share_at_30m)})"


def radius_words(result: ResultDoc) -> str | None:
    """State the radius as given and as estimated; None if it was not estimated."""
    radius = result.radius
    if radius is None:
        return None
    given = value(radius.given, radius.sigma)
    return f"{given} given, {value_and_error(radius.estimated, radius.sigma)} estimated"


def clock_words(subject: Subject, lidar: int) -> str:
    """State the difference of the clock of a LiDAR from the reference's, for a carried pole."""
    assert subject.site.walk is not None
    own, names = subject.site.walk.lidars[lidar], walk_names(subject)
    shift = f"{'+' if own.clock_offset_s >= 0 else '−'} {abs(own.clock_offset_s):.6f} s"
    sigma = f"1 sigma {1e3 * own.clock_sigma_s:.2g} ms"
    return f"t_{names[subject.site.reference]} = t_{names[lidar]} {shift}, {sigma}"


def walk_names(subject: Subject) -> Sequence[str]:
    """Name the LiDARs before which a pole was carried: those of a pair target and source."""
    return LIDARS if subject.pair else [each.name for each in subject.site.lidars]


def carried_words(found: SiteWalk) -> str:
    """Describe how the pole was carried."""
    return (
        f"{found.seconds:.0f} s, {found.along_m:.1f} m to either side along and "
        f"{found.across_m:.1f} m across, leaning by {DEGREES * found.lean_rad:.0f}° (all rms)"
    )


def scene_words(result: ResultDoc) -> str | None:
    """State how many patches agree or contradict the pose; None if the scene was not used."""
    return None if result.confirmation is None else result.confirmation.text


def statements(subject: Subject, *, verbose: bool = False) -> Iterator[str]:
    """State how certain an answer is and how it was checked, a sentence each.

    Parameters
    ----------
    subject
        The answer, or the refusal.
    verbose
        Whether the kinds of error and the radius are reported as well.
    """
    site, pair = subject.site, subject.pair
    if subject.answered and pair is None:
        yield f"frame: {site.frame.name}; datum: {site.datum}"
    worst = worst_lidar(site.lidars)
    if worst is not None:
        errors = worst.predicted_error or []
        at = ", ".join(f"± {error(each.sigma_m)} at {each.range_m:g} m" for each in errors)
        yield f"predicted error, 1 sigma{'' if pair else f', {worst.name} being the worst'}: {at}"
        parts = error_parts(errors, pair.uncertainty if pair and verbose else None)
        for each in parts:
            if each.range_m == BUDGET_RANGE:
                kinds = f"random ± {error(each.random)}, systematic ± {error(each.systematic)}"
                yield f"at {BUDGET_RANGE:g} m: {kinds}"
        largest = largest_error(worst)
        if largest is not None:
            yield f"main error source at {BUDGET_RANGE:g} m: {largest}"
    if site.sways:
        found = max(site.sways, key=lambda each: each.sway.left_rad)
        yield f"swayed while recorded: {subject.called(found.lidar)} {found.sway.text}"
    yield from clocks(subject)
    if site.walk is not None:
        others = (k for k in range(len(site.lidars)) if k != site.reference)
        yield f"clocks: {'; '.join(clock_words(subject, k) for k in others)}"
        yield f"walk: {carried_words(site.walk)}"
    if pair is not None:
        yield from _of_pair(pair, verbose)
        if verbose and subject.answered and site.tests:
            yield from _checks(site)
    else:
        yield from _of_site(site, subject.answered)
    moved = [each for each in site.without if each.translation is not None]
    if moved:
        most = max(moved, key=lambda each: each.translation or 0.0)
        whose = "" if most.lidar is None else f"{subject.called(most.lidar)}, "
        change = f"{error(most.translation)} and {error(most.rotation, 'rad')}"
        without = f"({whose}without placement {subject.placement(most.placement)})"
        yield f"leaving out one placement: the pose changes by at most {change} {without}"


def clocks(subject: Subject) -> Iterator[str]:
    """Report clocks of LiDARs that differ, as far as recordings have them.

    Those of two LiDARs are compared in one recording alone: two recorders may differ themselves.
    """
    found = [each for each in subject.site.inputs if each.clock_offset_s is not None]
    alone = {each.lidar: each for each in reversed(found)}
    compared: dict[tuple[int, int], str] = {}
    for one, other in combinations(found, 2):
        shift = (other.clock_offset_s or 0.0) - (one.clock_offset_s or 0.0)
        both = is_set(one.clock_offset_s or 0.0) and is_set(other.clock_offset_s or 0.0)
        if one.sha256 == other.sha256 and both and abs(shift) >= NOTICED:
            ahead = words_of(shift, f"that of {subject.called(one.lidar)}")
            compared.setdefault((one.lidar, other.lidar), f"{subject.called(other.lidar)} {ahead}")
    text = list(compared.values())
    for k, each in alone.items():
        shift = each.clock_offset_s or 0.0
        if abs(shift) >= NOTICED and not any(k in lidars for lidars in compared):
            text.append(f"{subject.called(k)} {words_of(shift)}")
    yield from (f"the clock of {which}; no time was changed" for which in text[:NAMED])


def _of_pair(pair: ResultDoc, verbose: bool) -> Iterator[str]:
    """State what only a pair has: its weakest direction, the radius, the scene check."""
    if pair.weakest is not None:
        yield f"weakest direction, 1 sigma: {pair.weakest.words}"
    radius, scene = radius_words(pair), scene_words(pair)
    if verbose and radius is not None:
        yield f"radius of the poles: {radius}"
    if scene is not None:
        yield f"scene check: {scene}"


def _of_site(site: SiteDoc, answered: bool) -> Iterator[str]:
    """State the results of pairs, loops and tests, or which LiDARs no observation links."""
    if len(site.groups) > 1:
        groups = (", ".join(site.lidars[k].name for k in group) for group in site.groups)
        yield f"not linked with each other: {' | '.join(groups)}"
    if answered and site.walk is None:
        yield from checks_of_site(site)


def checks_of_site(site: SiteDoc) -> Iterator[str]:
    """State the results of pairs, loops and consistency checks of an answer."""
    possible = [min(pair.standing, 2) for pair in site.pairs]
    counts = (
        (possible.count(1), "unambiguous"),
        (possible.count(2), "ambiguous and decided by others"),
        (possible.count(0), "linked through others"),
    )
    if possible:
        yield f"pairs: {', '.join(f'{n} {what}' for n, what in counts if n)}"
    loops = [loop for loop in site.loops if loop.probability is not None]
    if loops:
        worst = min(loops, key=lambda loop: loop.probability or 0.0)
        which = f"{len(loops)} loops; the worst," if loops[1:] else "loop"
        misses = f"{error(worst.translation)} and {error(worst.rotation, 'rad')}"
        by_chance = f"by chance: {probability(worst.probability)}"
        yield f"{which} {around(site, worst)}: misses by {misses} ({by_chance})"
    elif len(site.lidars) > 2:
        yield "no closed loop: there is no third LiDAR to check a pair"
    yield from _checks(site)


def _checks(site: SiteDoc) -> Iterator[str]:
    """State the results of the consistency checks of an answer."""
    tests = ranked_tests(site)
    if not tests:
        yield "no consistency checks: there is no verification of these poses"
        return
    high = [each for each in tests if _is_large(each.w, each.allowed)]
    checks = counted(len(tests), "consistency check")
    named = [
        f"{each.name} (w {abs(each.w or 0.0):.1f}, {each.allowed or 0.0:.2g} expected at most)"
        for each in (high or tests)[:NAMED]
    ]
    if high:
        rest = f" and {len(high) - NAMED} more" if len(high) > NAMED else ""
        yield f"{checks}, {len(high)} suspicious: {', '.join(named)}{rest}"
    else:
        yield f"{checks}, none suspicious; the largest: {named[0]}"
    blind = unchecked(site)
    if blind:
        yield f"{counted(blind, 'observation')} without a check: errors there stay undetected"


def fitness_words(subject: Subject) -> str:
    """Answer whether every pose is as accurate as was requested; empty if nothing was."""
    requested = [(each.name, each.fitness) for each in subject.site.lidars if each.fitness]
    if not requested:
        return ""
    first = requested[0][1]
    if subject.pair is not None:
        return first.words
    short = [
        f"{name}: {fitness.words.partition(': ')[2] or fitness.words}"
        for name, fitness in requested
        if fitness.answer != "yes"
    ]
    need = f"within {100 * first.within_m:g} cm at {first.at_m:g} m"
    return f"{need}: {'not every LiDAR; ' + '; '.join(short) if short else 'yes, every LiDAR'}"


def ranked_tests(site: SiteDoc) -> list[TestDoc]:
    """Give the tests that have a w, the largest first."""
    tests = [each for each in site.tests if each.w is not None]
    return sorted(tests, key=lambda each: -abs(each.w or 0.0))


def unchecked(site: SiteDoc) -> int:
    """Count the tests that would not show an error."""
    return sum(each.redundancy is not None and each.redundancy < UNCHECKED for each in site.tests)


def around(site: SiteDoc, loop: LoopDoc) -> str:
    """Name the LiDARs around a loop, back to the first."""
    names = (site.lidars[k].name for k in (*loop.lidars, *loop.lidars[:1]))
    return " → ".join(names) or UNKNOWN


def probability(p: float | None) -> str:
    """Write a probability; what is very small as a bound."""
    if p is None:
        return UNKNOWN
    return "< 0.1 %" if p < 0.001 else f"{100 * p:.1f} %" if p < 0.1 else percent(p)
