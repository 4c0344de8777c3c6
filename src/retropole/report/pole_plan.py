"""A plan of poles for a person: as one page with a card to take along, and as lines of text."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ..base.quantities import UNKNOWN, counted, error, percent
from ..base.uncertainty import ErrorAtRange, predicted_error, source_words
from ..result.pole_plan import PlannedPlacementDoc, PolePlanDoc, PredictedDoc
from .listings import Listing, columns
from .page import (
    EMPTY,
    Html,
    fill,
    fill_each,
    fill_page,
    join,
    listed,
    plus_minus,
    share_styles,
    table,
)
from .pole_plan_picture import WIDTH, PlanPicture, View, drawn, recorded, view_of
from .render import HEADING
from .text import legible, wrapped
from .text import table as text_table
from .verdict import verdict_box

LISTED_SOURCES = 4
"""Number of sources of error that are listed, the largest first."""

CARD_MM = 178.0, 126.0
"""The picture on the card is at most so wide and high: with all else, a sheet of A4 or Letter."""

SYMBOLS = {"ok": "✓", "warn": "!", "refused": "✕"}


def render_pole_plan(document: PolePlanDoc, picture: PlanPicture) -> str:
    """Render a plan as one HTML page, with its style and code, that works from a file.

    Parameters
    ----------
    document
        The plan.
    picture
        What its picture is drawn from.
    """
    view = view_of(document, picture)
    parts = join(
        (
            _place(document, picture, view),
            _poles(document),
            _tape(document),
            _errors(document),
            _limits(document),
            _recordings(document),
        )
    )
    cards = [_card(document, picture, view, p) for p in range(len(document.placements))]
    count = sum(len(each.poles) for each in document.placements)
    made = f"{counted(len(document.lidars), 'LiDAR')}, {counted(count, 'pole')}"
    if len(document.placements) > 1:
        made += f" in {len(document.placements)} placements"
    links = join(fill("a", to=f"#{name}", text=Html(text)) for name, text in HEADING.findall(parts))
    places: dict[str, object] = {
        "title": "Where to set up the poles",
        "heading": "Where to set up the poles",
        "brand": "plan of poles",
        "created": f"{document.created} · {made}",
        "status": _kind(document),
        "certificate": join((recorded(picture, view), *cards)),
        "certificate_button": fill("plan-card-button"),
        "verdict": _verdict(document),
        **{"links": links, "parts": parts},
        "data": "null",
    }
    return fill_page(
        "report.html",
        ("style.css", "pole_plan.css"),
        ("page.js", "pole_plan.js"),
        {name: fill("text", value=value) for name, value in places.items()},
        share_styles(),
    )


def _kind(document: PolePlanDoc) -> str:
    """Style of the verdict: that of the rehearsal, unless the need is hardly fulfilled."""
    kind = "ok" if document.rehearsal is None else document.rehearsal.status
    hardly = document.probability is not None and document.probability < 0.5
    return "warn" if kind == "ok" and hardly else kind


def _verdict(document: PolePlanDoc) -> Html:
    first, *others = document.words or [""]
    kind, need = _kind(document), document.need
    requested = "" if need is None else f"; requested: {need.text}"
    title = f"{error(max(stated(document)))} to expect at {document.range_m:g} m (1 σ){requested}"
    return verdict_box(
        kind,
        SYMBOLS[kind],
        title,
        fill(
            "plan-text",
            first=fill("strong", text=first),
            others=fill("statements", items=fill_each("li", others)) if others else EMPTY,
        ),
    )


def _place(document: PolePlanDoc, picture: PlanPicture, view: View) -> Html:
    """Write the picture, and next to it where each pole is."""
    rows = [
        fill("plan-row", name=pole.name, text=_where(pole.words), kind=p % 4)
        for p, placement in enumerate(document.placements)
        for pole in placement.poles
    ]
    text = (
        f"Seen from above; up is ahead of {document.lidars[0].name}, along its x axis. Arrows: x "
        "axes of the LiDARs. Letters: feet of the poles, with the direction in which each leans."
    )
    if len(document.placements) == 1:
        text += " Lines: lengths to measure."
    if sum(map(len, picture.points)):
        text += " Grey: recorded points, darker above 0.3\u00a0m."
    return fill(
        "plan-section",
        width=f"{WIDTH:g}",
        height=f"{view.height:.0f}",
        marks=drawn(document, picture, view),
        said=text,
        range=f"{document.range_m:g}",
        together=error(max(stated(document))),
        alone=error(max(stated_alone(document))),
        rows=join(rows),
    )


def _where(text: str) -> str:
    """Position of a pole, without its name before it."""
    return text.partition(": ")[2] or text


def _poles(document: PolePlanDoc) -> Html:
    """List the poles, and the returns that each LiDAR will have on them."""
    names = [each.name for each in document.lidars]
    several = len(document.placements) > 1
    rows = []
    for p, placement in enumerate(document.placements, 1):
        for pole in placement.poles:
            seen = {each.lidar: each for each in pole.seen}
            cells = []
            for name in names:
                one = seen.get(name)
                rings = "" if one is None or one.rings is None else f" on {one.rings} rings"
                cells.append(UNKNOWN if one is None else f"{one.returns}{rings}")
            rows.append((pole.name, *([p] if several else []), *cells, _where(pole.words)))
    header = ("pole", *(["placement"] if several else []), *names, "where")
    caption = "Poles of the plan, and the returns that each LiDAR will have of them"
    size = f"{document.length_m:g} m long, {2e3 * document.radius_m:.0f} mm thick"
    return fill(
        "plan-poles", size=size, table=listed(Listing(caption, header, rows, (len(header) - 1,)))
    )


def _lengths(placement: PlannedPlacementDoc, piece: str) -> Html:
    """List what to measure with a tape."""
    return join(
        fill(piece, start=each.start, end=each.end, metres=f"{each.metres:.2f}")
        for each in placement.tape
    )


def _tape(document: PolePlanDoc) -> Html:
    parts = []
    for p, placement in enumerate(document.placements):
        title = f"Placement {p + 1}" if len(document.placements) > 1 else ""
        heading = fill("plan-heading", text=title) if title else EMPTY
        parts.append(
            fill("plan-tape-of", heading=heading, items=_lengths(placement, "plan-length"))
        )
    return fill("plan-tape", parts=join(parts))


def _errors(document: PolePlanDoc) -> Html:
    """List the error to expect by range."""
    several = len(document.predicted) > 1
    rows = [row for each in document.predicted for row in _error_rows(each, several)]
    header = columns("distance; 1 σ; 95 % are below; 1 σ by the poles alone")
    header = ["LiDAR", *header] if several else header
    of = "" if several else f" of {document.predicted[0].lidar}"
    return fill("plan-errors", table=listed(Listing(f"Expected error{of}", header, rows, ())))


def _error_rows(predicted: PredictedDoc, several: bool) -> Iterator[tuple[str, ...]]:
    for each, bound, alone in zip(
        predicted.predicted_error, predicted.bounds_m, predicted.alone, strict=True
    ):
        cells = (
            f"{each.range_m:g} m",
            plus_minus(each.sigma_m),
            error(bound),
            plus_minus(alone.sigma_m),
        )
        yield (predicted.lidar, *cells) if several else cells


def _limits(document: PolePlanDoc) -> Html:
    """State what limits the error, and the gain from more poles or placements."""
    worst = document.predicted[stated(document).index(max(stated(document)))]
    entries = sorted(worst.budget, key=lambda each: -each.share_at_30m)[:LISTED_SOURCES]
    tables = []
    if entries:
        whose = f" of {worst.lidar}" if len(document.predicted) > 1 else ""
        tables.append(
            table(
                f"Main sources of the error{whose}",
                columns("source of error; share of the variance at 30 m"),
                [(source_words(e.name, e.sensor), percent(e.share_at_30m)) for e in entries],
                bars=[("", each.share_at_30m) for each in entries],
            )
        )
    if document.more:
        at = f"{document.range_m:g} m"
        tables.append(
            table(
                "Gain from more poles or placements",
                ("", f"1 σ at {at}", "by the poles alone", "takes away", "worth it"),
                [
                    (
                        f"one {each.what} more",
                        plus_minus(each.error_m),
                        plus_minus(each.alone_m),
                        percent(max(each.gain, 0.0)),
                        "yes" if each.is_worth_it else "no",
                    )
                    for each in document.more
                ],
                (4,),
            )
        )
    return fill("plan-limits", tables=join(tables)) if tables else EMPTY


def _recordings(document: PolePlanDoc) -> Html:
    """Name what the plan was made from."""
    rows = [(each.name, each.sensor, f"{each.height_m:.2f}") for each in document.lidars]
    header = ["LiDAR", "sensor", "height, m"]
    if not any(each.sha256 for each in document.lidars):
        return fill("plan-recordings", table=table("LiDARs", header, rows, (1,)))
    header += ["recording without poles", "SHA-256"]
    files = [(each.path or UNKNOWN, each.sha256) for each in document.lidars]
    whole = [(*row, *file) for row, file in zip(rows, files, strict=True)]
    return fill("plan-recordings", table=table("LiDARs", header, whole, (1, 3, 4)))


def _card(document: PolePlanDoc, picture: PlanPicture, view: View, p: int) -> Html:
    """Write the sheet for one placement: the picture, the poles, and what to measure."""
    placement = document.placements[p]
    several = len(document.placements) > 1
    poles = [
        fill("plan-card-pole", name=pole.name, text=_where(pole.words)) for pole in placement.poles
    ]
    size = f"{document.length_m:g} m long, {2e3 * document.radius_m:.0f} mm thick"
    millimetres = min(CARD_MM[0] / WIDTH, CARD_MM[1] / view.height)
    return fill(
        "plan-card",
        id=f"card-{p + 1}",
        title="Where to set up the poles" + (f": placement {p + 1}" if several else ""),
        size=size,
        created=document.created.partition("T")[0],
        wide=millimetres * WIDTH,
        high=millimetres * view.height,
        width=f"{WIDTH:g}",
        height=f"{view.height:.0f}",
        marks=drawn(document, picture, view, p),
        poles=join(poles),
        first=document.lidars[0].name,
        lengths=_lengths(placement, "plan-card-length"),
        range=f"{document.range_m:g}",
        together=error(max(stated(document))),
    )


def stated(document: PolePlanDoc) -> list[float]:
    """1 σ of each LiDAR but the first at the plan's range, metres."""
    at = (document.range_m,)
    return [predicted_error(np.array(p.covariance), at)[0].sigma_m for p in document.predicted]


def stated_alone(document: PolePlanDoc) -> list[float]:
    """The same by the poles alone."""
    return [_at_range(each.alone, document.range_m) for each in document.predicted]


def _at_range(errors: Sequence[ErrorAtRange], at: float) -> float:
    """1 σ at a range, of that at others: its square grows with the square of the range."""
    squares = np.array([[each.range_m**2, each.sigma_m**2] for each in errors])
    growth, own = np.polyfit(squares[:, 0], squares[:, 1], 1, w=1 / squares[:, 1])
    return float(np.sqrt(max(growth * at**2 + own, 0.0)))


def describe_plan(document: PolePlanDoc) -> str:
    """Describe the positions of the poles and what to expect."""
    document = legible(document)
    lines: list[str] = []
    several = len(document.placements) > 1
    for k, placement in enumerate(document.placements, 1):
        if several:
            lines.append(f"placement {k}")
        for pole in placement.poles:
            lines += wrapped(f"{pole.words[0].upper()}{pole.words[1:]}", "    ")
            seen = ", ".join(
                f"{each.lidar} {each.returns} returns"
                + ("" if each.rings is None else f" on {each.rings} rings")
                for each in pole.seen
            )
            lines += wrapped(f"    seen by {seen}", "    ")
        tape = "; ".join(f"{t.start} to {t.end} {t.metres:.2f} m" for t in placement.tape)
        lines += wrapped(f"Tape measure: {tape}", "    ")
    lines.append("")
    # Of a plan whose poles were moved by hand the words alone have an error.
    ranges = [each.range_m for one in document.predicted[:1] for each in one.predicted_error]
    header = ["error to expect, 1 σ", *(f"{each:g} m" for each in ranges)]
    rows = []
    for each in document.predicted:
        rows.append([each.lidar, *(error(one.sigma_m) for one in each.predicted_error)])
        rows.append(["  95 % below", *(error(b).removeprefix("± ") for b in each.bounds_m)])
        rows.append(["  by the poles alone", *(error(one.sigma_m) for one in each.alone)])
    lines += [text_table(header, rows), ""] if rows else []
    for sentence in document.words:
        lines += wrapped(sentence, "  ")
    return "\n".join(lines)
