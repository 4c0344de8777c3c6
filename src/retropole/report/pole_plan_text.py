"""A plan of poles as lines of text."""

from __future__ import annotations

from ..base.quantities import error
from ..result.pole_plan import PolePlanDoc
from .layout import legible, table, wrapped


def describe_plan(document: PolePlanDoc) -> str:
    """Say where the poles should stand and what to expect."""
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
    lines += [table(header, rows), ""] if rows else []
    for sentence in document.words:
        lines += wrapped(sentence, "  ")
    return "\n".join(lines)
