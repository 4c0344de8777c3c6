"""The command ``retropole site check``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from ..result import ReasonDoc
from .check import EXITS, answer_fields, tolerance_options
from .common import BY_SITE_FILE, in_colour, json_text, listening, show
from .options import CLOUD

if TYPE_CHECKING:
    from ..api.site_checking import CheckedPair, SiteCheck
    from ..base.errors import Reason

SCHEMA = "retropole/site-check/1"

SAID_OF_ANSWERS = ("recordings_of_result", "carrier_moved")
"""Reasons that are said of a pair that is the same or moved, too: what the answer is worth."""


@click.command("check")
@click.argument("result", type=click.Path(path_type=Path))
@click.argument("site", metavar="SITE.toml", type=CLOUD)
@tolerance_options
@click.option("--json", "as_json", is_flag=True, help="Print one line of JSON, and only that.")
@click.option("-q", "--quiet", is_flag=True, help="Print nothing but errors.")
def site_check(
    result: Path,
    site: Path,
    rotation: float | None,
    translation: float | None,
    as_json: bool,
    quiet: bool,
) -> int:
    """Tell which LiDARs of a site still stand as they stood when RESULT was made.

    RESULT is site-result.json, or the folder that holds it. SITE.toml is the site file of new
    recordings, or the folder that holds it; 'retropole site init' writes one. One placement is
    enough, with or without poles, and its LiDARs have the names that they have in RESULT. Each pair
    that shared poles is checked as by 'retropole check'; the site is the same where such pairs join
    all LiDARs.

    \b
    Examples:
      retropole site check retropole-out tonight/site.toml
      retropole site check quay/out tonight --tolerance-deg 0.2
      retropole site check retropole-out tonight --json | jq .moved

    \b
    Exit code:
      0    same
      2    a file or an option is wrong
      3    cannot tell of all LiDARs; the reasons are printed
      4    moved
      130  interrupted
    """
    from ..api.site_checking import check_site

    with listening(quiet, None, BY_SITE_FILE, hidden=as_json) as listener:
        answer = check_site(
            result, site, rotation=rotation, translation=translation, listener=listener
        )
    if as_json:
        show(json_line(answer))
    elif not quiet:
        show(in_colour(in_words(answer), answer.status))
    return EXITS[answer.status]


def json_line(answer: SiteCheck) -> str:
    """Write the answer as one line of JSON."""
    return json_text(
        {
            "schema": SCHEMA,
            "status": answer.status,
            "moved": answer.moved,
            "untold": answer.untold,
            "reasons": answer.reasons,
            "pairs": [
                {"target": target, "source": source, **answer_fields(each)}
                for target, source, each in answer.pairs
            ],
        }
    )


def in_words(answer: SiteCheck) -> str:
    """Write the answer as a person reads it: the LiDARs, a line for each pair, and reasons."""
    from ..base.errors import printable
    from ..report.layout import table, wrapped
    from ..report.text import reason_lines

    lines = [f"verdict: {answer.status.replace('_', ' ')}"]
    said = []
    if answer.moved:
        said.append(f"moved: {', '.join(answer.moved)}; the others stand as they stood")
    elif answer.status == "moved":
        said.append("which of the LiDARs of a pair that moved it was, these pairs do not tell")
    if answer.untold:
        said.append(f"not told whether they moved: {', '.join(answer.untold)}")
    lines += [part for words in said for part in wrapped(f"  {printable(words)}", "    ")]
    if answer.pairs:
        header = ("LiDARs", "answer", "rotated by", "translated by")
        lines.append(table(header, [_row(each) for each in answer.pairs]))
    for reason in answer.reasons:
        lines += reason_lines(ReasonDoc(reason.code, printable(reason.message), {}))
    for reason, pairs in _worth_saying(answer):
        named = printable(f"{'; '.join(pairs)}: {reason.message}")
        lines += reason_lines(ReasonDoc(reason.code, named, {}))
    for target, source, each in answer.pairs:
        if each.status == "cannot_tell":
            lines.append(f"  {printable(f'{target}, {source}')}:")
            for reason in each.reasons:
                lines += reason_lines(ReasonDoc(reason.code, printable(reason.message), {}))
    return "\n".join(lines)


def _worth_saying(answer: SiteCheck) -> list[tuple[Reason, list[str]]]:
    """List what is to be known of pairs that have an answer, and the pairs that it is said of."""
    found: dict[str, tuple[Reason, list[str]]] = {}
    for target, source, each in answer.pairs:
        for reason in each.reasons:
            if each.status != "cannot_tell" and reason.code in SAID_OF_ANSWERS:
                found.setdefault(reason.message, (reason, []))[1].append(f"{target}, {source}")
    return list(found.values())


def _row(pair: CheckedPair) -> tuple[str, ...]:
    from ..base.errors import printable
    from ..base.quantities import UNKNOWN, value_and_error

    answer, turn, shift = pair.answer, pair.answer.rotation, pair.answer.translation
    verdict = answer.status.replace("_", " ")
    if answer.status == "same" and answer.tolerance is not None:
        verdict += f" within {answer.tolerance.in_words}"
    rotated = UNKNOWN if turn is None else value_and_error(turn.length, turn.sigma, "rad")
    translated = UNKNOWN if shift is None else value_and_error(shift.length, shift.sigma)
    return printable(f"{pair.target}, {pair.source}"), verdict, rotated, translated
