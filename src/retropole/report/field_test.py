"""The field test of two LiDARs in words: as text for a terminal and as a section of a page."""

from __future__ import annotations

from collections.abc import Sequence

from ..base.quantities import UNKNOWN, counted, percent
from ..checking.certification import DistanceTest, Verdict
from ..checking.distances import SpreadTest
from ..result.certification import FieldTestDoc, PairTestDoc
from ..result.site import LIDARS
from .listings import Listing, columns
from .page import EMPTY, Html, fill, fill_each, join, table
from .render import render_page
from .text import legible, reason_lines, wrapped
from .text import table as text_table
from .verdict import reason_item, verdict_box

LISTED = 16
"""Number of distances that are printed, those nearest to their limits, and of pairs of a
site."""

VERDICTS: dict[Verdict, tuple[str, str, str]] = {
    "pass": ("ok", "✓", "Pass: the LiDARs measure as stated"),
    "partial": ("warn", "!", "Partial: some LiDARs could not be tested"),
    "fail": ("refused", "✕", "Fail: distances differ by more than the LiDARs' data sheets state"),
    "refused": ("refused", "✕", "Refused: too few data"),
}
"""Style, symbol and title of each verdict."""

DISTANCES = "distance; target, m; source, m; difference, mm; limit, mm; within it"


def describe_field_test(document: FieldTestDoc) -> str:
    """Write the test as a person reads it, on one screen."""
    document = legible(document)
    lines = [f"verdict: {document.status}"]
    if len(document.pairs) > 1:
        listing = _pairs(document)
        lines += [f"  {_tested(document)}", *wrapped(f"  {_untested(document)}".rstrip(), "    ")]
        lines.append(text_table(listing.header, listing.rows[:LISTED]))
        if len(listing.rows) > LISTED:
            lines.append(f"  {counted(len(listing.rows) - LISTED, 'more pair')}; --json lists all")
        return "\n".join(lines)
    (pair,) = document.pairs
    lines += [line for reason in pair.reasons for line in reason_lines(reason)]
    if pair.distances:
        worst = sorted(pair.distances, key=lambda each: -_ratio(each))[:LISTED]
        listing = _distances(pair, sorted(worst, key=lambda each: (each.placement, each.poles)))
        lines.append(text_table(listing.header, listing.rows))
        if len(pair.distances) > LISTED:
            rest = counted(len(pair.distances) - LISTED, "more distance")
            lines.append(f"  {rest}, farther from their limits; --json lists all")
    text = [f"  {sentence}" for sentence in sentences(pair, document.alpha)]
    if document.status != "refused" and (pair.target, pair.source) == LIDARS:
        text.append(_unnamed(document))
    return "\n".join([*lines, *(part for sentence in text for part in wrapped(sentence, "    "))])


def _unnamed(document: FieldTestDoc) -> str:
    """Report whose sensor is not given; empty if both are."""
    inputs = zip(LIDARS, document.inputs, strict=False)
    auto = [lidar for lidar, given in inputs if given.sensor == "auto"]
    if not auto:
        return ""
    return (
        f"  the sensor of the {' and of the '.join(auto)} is not given: large errors are assumed "
        "for it, which few LiDARs exceed"
    )


def _tested(document: FieldTestDoc) -> str:
    """Count the pairs that could be tested, and those that failed: the others give no
    information."""
    tested = sum(pair.status != "refused" for pair in document.pairs)
    failed = sum(pair.status == "fail" for pair in document.pairs)
    text = f"{tested} of {counted(len(document.pairs), 'pair')} tested"
    return f"{text}, {failed} failed" if tested else text


def _untested(document: FieldTestDoc) -> str:
    """Name the LiDARs that are in no pair that was tested; nothing if none was."""
    if len(document.untested) == 0 or document.status == "refused":
        return ""
    rest = len(document.untested) - LISTED
    more = f" and {rest} more" if rest > 0 else ""
    return f"in no pair that was tested: {', '.join(document.untested[:LISTED])}{more}"


def _pairs(document: FieldTestDoc) -> Listing:
    """List the pairs, each with its largest difference; what failed comes first."""
    rows = [
        (
            f"{pair.target}, {pair.source}",
            # Next to the name: on a phone the last columns are out of sight.
            pair.status if not pair.reasons else f"{pair.status}: {pair.reasons[0].code}",
            len(pair.distances),
            f"{_largest(pair):.2f}" if pair.distances else UNKNOWN,
        )
        for pair in _in_order(document)
    ]
    header = columns("LiDARs; verdict; distances; largest / limit")
    return Listing("Pairs, those that failed first", header, rows, (1,))


def _distances(pair: PairTestDoc, distances: Sequence[DistanceTest]) -> Listing:
    """List distances as both LiDARs measure them."""
    rows = [
        (
            (f"{each.placement + 1}: " if len(pair.poles) > 1 else "")
            + f"T{each.poles[0]}–T{each.poles[1]}",
            *(f"{each.target_m:.4f}", f"{each.source_m:.4f}"),
            *(f"{1e3 * each.difference_m:+.1f}", f"{1e3 * each.limit_m:.1f}"),
            "yes" if each.passed else "BEYOND",
        )
        for each in distances
    ]
    caption = f"Distances, {pair.target} and {pair.source}"
    return Listing(caption, columns(DISTANCES), rows, (5,))


def _in_order(document: FieldTestDoc) -> list[PairTestDoc]:
    """Sort the pairs: what failed first, what could not be tested last."""
    order: dict[Verdict, int] = {"fail": 0, "pass": 1, "partial": 1, "refused": 2}
    return sorted(document.pairs, key=lambda pair: (order[pair.status], -_largest(pair)))


def sentences(pair: PairTestDoc, alpha: float) -> list[str]:
    """Describe the test, and its meaning."""
    if not pair.distances:
        return []
    out = [each for each in pair.distances if not each.passed]
    found = (
        f"{counted(len(out), 'difference')} of {len(pair.distances)} beyond the limit"
        if out
        else f"all {len(pair.distances)} differences within their limits"
    )
    comments = [
        f"{found}; LiDARs that measure as specified keep all limits with a probability of "
        f"at least {percent(1 - alpha)} (z = {pair.z or 0.0:.2f} for each)"
    ]
    if pair.variances is None:
        comments.append("variances were not compared: 3 sweeps or more of each LiDAR are needed")
    else:
        comments.append(_variances(pair.variances))
    alone = sum(
        seen.target + seen.source - 2 * seen.compared for seen in pair.poles if seen.compared
    )
    if alone:
        comments.append(f"{counted(alone, 'pole')} seen by one LiDAR only: not compared")
    if pair.status == "fail":
        comments.append(
            "what to do: record again; if it fails again, a pole moved between the recordings, or "
            "one of the LiDARs measures worse than specified"
        )
    return comments


def _variances(test: SpreadTest) -> str:
    verdict = "may be equal" if test.passed else "differ"
    return (
        f"one sweep repeats a distance within {1e3 * test.target.sigma:.1f} mm (target) and "
        f"{1e3 * test.source.sigma:.1f} mm (source), 1 σ; compared with what their returns allow, "
        f"the variances {verdict}: F = {test.ratio:.2f}, passes from {test.low:.2f} to "
        f"{test.high:.2f}"
    )


def render_field_test(document: FieldTestDoc) -> str:
    """Render the test as one HTML page, with its style and code, that works from a file."""
    kind, symbol, title = VERDICTS[document.status]
    pairs = EMPTY
    if len(document.pairs) > 1:
        untested = _untested(document)
        title = f"{title.partition(':')[0]}: {_tested(document)}{untested and '; '}{untested}"
        pairs = table(*_pairs(document))
    return render_page(
        "field test of LiDARs",
        f"Field test: {document.site}" if document.site else "Field test",
        f"{document.created} · {counted(len(document.pairs), 'pair')} of LiDARs",
        document.status,
        verdict_box(kind, symbol, title, fill("field-test", pairs=pairs)),
        [field_test_section(document), _inputs(document)],
    )


def _inputs(document: FieldTestDoc) -> Html:
    """List serial numbers and recordings: the identification of the tested LiDARs."""
    rows = [(each.path, each.sensor, each.points, each.sha256) for each in document.inputs]
    header = ("recording", "sensor", "points", "SHA-256")
    listed = table("What was tested", header, rows, (1, 3))
    if document.serials:
        serials = table("LiDARs", ("LiDAR", "serial number"), [*document.serials.items()], (1,))
        listed = fill("stack", body=join((serials, listed)))
    return fill("recordings", table=listed) if rows else EMPTY


def field_test_section(document: FieldTestDoc) -> Html:
    """Write every pair as a section of an HTML page; all content of the document is escaped."""
    parts = []
    for pair in _in_order(document):
        reasons = fill_each("said", (f"{each.message}." for each in pair.reasons))
        if len(document.pairs) == 1 and pair.reasons:
            reasons = fill("reasons", items=join(map(reason_item, pair.reasons)))
        listed = table(*_distances(pair, pair.distances)) if pair.distances else EMPTY
        text = fill_each("said", (f"{sentence}." for sentence in sentences(pair, document.alpha)))
        title = f"{pair.target}, {pair.source}: {pair.status}"
        parts.append(fill("tested", title=title, reasons=reasons, table=listed, said=text))
    return fill("distances", parts=join(parts))


def _ratio(each: DistanceTest) -> float:
    return abs(each.difference_m) / max(each.limit_m, 1e-12)


def _largest(pair: PairTestDoc) -> float:
    return max(map(_ratio, pair.distances), default=0.0)
