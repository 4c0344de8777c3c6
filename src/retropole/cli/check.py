"""The commands ``retropole check`` and ``retropole site check``."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from ..api.choices import DEFAULT_TOLERANCE, WIDEST_TOLERANCE
from ..result import ReasonDoc
from ..result.options import OPTIONS, PAIRS
from .common import BY_SITE_FILE, EXIT_MOVED, EXIT_REFUSED, in_colour, json_text, listening, show
from .options import CLOUD, DEGREES, METRES, Brief, Command, run_option

if TYPE_CHECKING:
    from ..api.checking import CheckedPair, CheckResult, Movement, SiteCheck
    from ..base.datatypes import Array
    from ..base.errors import Reason

Answer = TypeVar("Answer", "CheckResult", "SiteCheck")

EXITS = {"same": 0, "moved": EXIT_MOVED, "cannot_tell": EXIT_REFUSED}

NOISE_SIGMAS = 2.0
"""A movement of fewer σ than this has no direction worth naming."""

MOSTLY_ALONG = math.cos(math.radians(30.0))
"""A direction within 30° of an axis goes by its name."""

SITE_CHECK_SCHEMA = "retropole/site-check/1"

REPORTED_REASONS = ("recordings_of_result", "carrier_moved")
"""Reasons that are reported of a pair that is the same or moved, too: what the answer is worth."""


def tolerance_options(command: Command) -> Command:
    """Give a command --tolerance-deg and --tolerance-m."""
    default, widest = DEFAULT_TOLERANCE, WIDEST_TOLERANCE
    more = "or what the data can show, up to"
    rotation = click.option(
        "--tolerance-deg",
        "rotation",
        type=DEGREES,
        help="Smallest rotation that must be detected: if it could be missed, the answer is not "
        "'same'.  "
        f"[default: {math.degrees(default.rotation):g}, {more} {math.degrees(widest.rotation):g}]",
    )
    translation = click.option(
        "--tolerance-m",
        "translation",
        type=METRES,
        help="The same for the translation.  "
        f"[default: {default.translation:g}, {more} {widest.translation:g}]",
    )
    return rotation(translation(command))


@click.command(cls=Brief)
@click.argument("result", type=click.Path(path_type=Path))
@click.argument("target", type=CLOUD)
@click.argument("source", type=CLOUD)
@run_option(
    PAIRS["topic"],
    help=f"{OPTIONS['target_topic'].help}  [default: that of RESULT, if it is a bag]",
)
@run_option(
    PAIRS["unit"], help="Unit of the new recordings' coordinates.  [default: that of RESULT]"
)
@run_option(
    PAIRS["intensity"],
    help="Field of the new recordings' intensity.  [default: that of RESULT, if they have it]",
)
@run_option(PAIRS["angles"], help=f"{OPTIONS['angles'].help}  [default: that of RESULT]")
@click.option("--parent", help="If RESULT is of a site: the name of the LiDAR of TARGET.")
@click.option("--child", help="The same for SOURCE.")
@tolerance_options
@click.option(
    "--sigma-deg",
    "sigma_rotation",
    type=DEGREES,
    help="1 sigma of RESULT's rotation, about each axis.  [default: its covariance]",
)
@click.option(
    "--sigma-m", "sigma_translation", type=METRES, help="1 sigma of RESULT's translation."
)
@click.option("--json", "as_json", is_flag=True, help="Print one line of JSON, and only that.")
@click.option("-q", "--quiet", is_flag=True, help="Print nothing but errors.")
def check(
    result: Path,
    target: Path,
    source: Path,
    sigma_rotation: float | None,
    sigma_translation: float | None,
    parent: str | None,
    child: str | None,
    as_json: bool,
    quiet: bool,
    **asked: Any,
) -> int:
    """Determine whether the LiDARs have moved since RESULT was made.

    RESULT is result.json, its folder, or any file that 'retropole export' writes
    (one without a covariance needs --sigma-deg and --sigma-m). TARGET and SOURCE are new
    recordings of the same two LiDARs. With poles, the poles are used; without, the scene. Radius,
    sensors, thresholds, units, fields of the intensity and angles are those of RESULT.

    Of a site, RESULT is site-result.json or its folder, and --parent and --child name the two
    LiDARs; radius, sensors, fields and angles are those of the site.

    \b
    Examples:
      retropole check retropole-out front.pcd rear.pcd
      retropole check retropole-out front/ rear/ --json >> /var/log/site.jsonl
      retropole check retropole-out front.pcd rear.pcd -q || mail -s "LiDAR moved?" me@site
      retropole check site a.pcd b.pcd --parent mast-a --child mast-b
      retropole check calibration.yaml front.pcd rear.pcd --sigma-deg 0.02 --sigma-m 0.003

    \b
    Exit code:
      0    same
      2    a file or an option is wrong
      3    cannot tell; the reason is printed
      4    moved
    """
    from ..api.checking import CheckResult, check_recordings, read_stored
    from ..base.errors import Refusal

    if (sigma_rotation is None) != (sigma_translation is None):
        raise click.UsageError("--sigma-deg and --sigma-m must be given together")
    if (parent is None) != (child is None):
        raise click.UsageError("--parent and --child must be given together")
    lidars = None if parent is None or child is None else (parent, child)
    sigma = (sigma_rotation, sigma_translation) if sigma_rotation and sigma_translation else None
    with listening(quiet, None, hidden=as_json) as listener:
        listener.progress("read")
        try:
            stored = read_stored(result, sigma, lidars)
        except Refusal as refusal:
            answer = CheckResult("cannot_tell", (refusal.reason.prefixed("stored"),))
        else:
            answer = check_recordings(stored, target, source, listener=listener, **asked)
    return _report(answer, answer_fields, in_words, as_json=as_json, quiet=quiet)


def _report(
    answer: Answer,
    fields: Callable[[Answer], dict[str, Any]],
    text_of: Callable[[Answer], str],
    *,
    as_json: bool,
    quiet: bool,
) -> int:
    """Print an answer, as one line of JSON or in words, and give the exit code."""
    if as_json:
        show(json_text(fields(answer)))
    elif not quiet:
        show(in_colour(text_of(answer), answer.status))
    return EXITS[answer.status]


def _verdict(answer: CheckResult) -> str:
    verdict = answer.status.replace("_", " ")
    if answer.status == "same" and answer.tolerance is not None:
        verdict += f" within {answer.tolerance.in_words}"
    return verdict


def _reason_lines(reasons: Sequence[Reason]) -> Iterator[str]:
    """Write reasons, whose words may come from files."""
    from ..base.errors import printable
    from ..report.text import reason_lines

    for reason in reasons:
        yield from reason_lines(ReasonDoc(reason.code, printable(reason.message), {}))


def answer_fields(answer: CheckResult) -> dict[str, Any]:
    """Name all that an answer says; what is not known is None."""
    from ..api.checking import FALSE_ALARM

    rotation, translation = answer.rotation, answer.translation
    tolerance = answer.tolerance
    return {
        "status": answer.status,
        "used": answer.used,
        "moved_deg": rotation and math.degrees(rotation.length),
        "sigma_deg": rotation and math.degrees(rotation.sigma),
        "moved_m": translation and translation.length,
        "sigma_m": translation and translation.sigma,
        "chi2": answer.chi2,
        "p_value": answer.p_value,
        "false_alarm": FALSE_ALARM,
        "power": answer.power,
        "tolerance_deg": tolerance and math.degrees(tolerance.rotation),
        "tolerance_m": tolerance and tolerance.translation,
        "confirmation": answer.confirmation,
        "T_target_source": answer.T_target_source,
        "reasons": answer.reasons,
    }


def in_words(answer: CheckResult) -> str:
    """Write the answer as a person reads it."""
    from ..api.checking import FALSE_ALARM
    from ..base.quantities import value_and_error
    from ..report.text import wrapped

    lines = [f"verdict: {_verdict(answer)}"]
    rotation, translation = answer.rotation, answer.translation
    if answer.step is not None and rotation is not None and translation is not None:
        how = "poles and scene" if answer.used == "poles" else "the scene alone"
        lines += [
            f"  rotated by    {value_and_error(rotation.length, rotation.sigma, 'rad')} (1 σ), "
            f"{_direction(answer.step[:3], rotation, 'about', (' (roll)', ' (pitch)', ' (yaw)'))}",
            f"  translated by {value_and_error(translation.length, translation.sigma)} (1 σ), "
            f"{_direction(answer.step[3:], translation, 'along', ('', '', ''))}",
            "  (the source relative to the target; two LiDARs do not show which of them moved)",
            f"  χ² {answer.chi2:.1f} with 6 degrees of freedom; if nothing moved, as large with "
            f"probability {answer.p_value:.2g} (reported as moved below {FALSE_ALARM:g})",
            f"  found by {how}",
        ]
    if answer.confirmation is not None:
        scene = answer.confirmation.text
        lines.append(f"  scene check under the stored pose: {scene}")
    lines = [part for line in lines for part in wrapped(line, "    ")]
    return "\n".join([*lines, *_reason_lines(answer.reasons)])


def _direction(
    vector: Array, movement: Movement, preposition: str, names: tuple[str, str, str]
) -> str:
    """Name the axis of the target that a vector mostly lies along, if it is more than its noise."""
    if movement.length < NOISE_SIGMAS * movement.sigma:
        return "no more than its noise"
    unit = vector / movement.length
    k = int(abs(unit).argmax())
    if abs(unit[k]) > MOSTLY_ALONG:
        sign = "+" if unit[k] > 0 else "-"
        return f"mostly {preposition} the target's {sign}{'xyz'[k]}{names[k]}"
    return f"{preposition} ({unit[0]:+.2f} {unit[1]:+.2f} {unit[2]:+.2f}) of the target"


@click.command("check", cls=Brief)
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
    """Find which LiDARs of a site have moved since RESULT was computed.

    RESULT is site-result.json, or its folder. SITE.toml is the site file of new
    recordings, or its folder; 'retropole site init' writes one. One placement is
    enough, with or without poles, and its LiDARs have the names that they have in RESULT. Each pair
    that shared poles is checked as by 'retropole check'; the site is the same where such pairs join
    all LiDARs.

    \b
    Examples:
      retropole site check retropole-out tonight/site.toml
      retropole site check retropole-out tonight --json | jq .moved

    \b
    Exit code:
      0    same
      2    a file or an option is wrong
      3    cannot tell of all LiDARs; the reasons are printed
      4    moved
    """
    from ..api.checking import check_site

    with listening(quiet, None, BY_SITE_FILE, hidden=as_json) as listener:
        answer = check_site(
            result, site, rotation=rotation, translation=translation, listener=listener
        )
    return _report(answer, site_fields, site_in_words, as_json=as_json, quiet=quiet)


def site_fields(answer: SiteCheck) -> dict[str, Any]:
    """Name all that the answer of a site says."""
    return {
        "schema": SITE_CHECK_SCHEMA,
        "status": answer.status,
        "moved": answer.moved,
        "untold": answer.untold,
        "reasons": answer.reasons,
        "pairs": [
            {"target": target, "source": source, **answer_fields(each)}
            for target, source, each in answer.pairs
        ],
    }


def site_in_words(answer: SiteCheck) -> str:
    """Write the answer as a person reads it: the LiDARs, a line for each pair, and reasons."""
    from ..base.errors import printable
    from ..report.text import table, wrapped

    lines = [f"verdict: {answer.status.replace('_', ' ')}"]
    text = []
    if answer.moved:
        text.append(f"moved: {', '.join(answer.moved)}; the others have not moved")
    elif answer.status == "moved":
        text.append("these pairs do not show which LiDAR of a moved pair has moved")
    if answer.untold:
        text.append(f"undecided whether moved: {', '.join(answer.untold)}")
    lines += [part for line in text for part in wrapped(f"  {printable(line)}", "    ")]
    if answer.pairs:
        header = ("LiDARs", "answer", "rotated by", "translated by")
        lines.append(table(header, [_pair_row(each) for each in answer.pairs]))
    lines += _reason_lines([*answer.reasons, *_worth_saying(answer)])
    for target, source, each in answer.pairs:
        if each.status == "cannot_tell":
            lines += [f"  {printable(f'{target}, {source}')}:", *_reason_lines(each.reasons)]
    return "\n".join(lines)


def _worth_saying(answer: SiteCheck) -> Iterator[Reason]:
    """List what is to be known of pairs that have an answer, with the pairs that it is reported
    of."""
    found: dict[str, tuple[Reason, list[str]]] = {}
    for target, source, each in answer.pairs:
        for reason in each.reasons:
            if each.status != "cannot_tell" and reason.code in REPORTED_REASONS:
                found.setdefault(reason.message, (reason, []))[1].append(f"{target}, {source}")
    for reason, pairs in found.values():
        yield replace(reason, message=f"{'; '.join(pairs)}: {reason.message}")


def _pair_row(pair: CheckedPair) -> tuple[str, ...]:
    from ..base.errors import printable
    from ..base.quantities import UNKNOWN, value_and_error

    turn, shift = pair.answer.rotation, pair.answer.translation
    rotated = UNKNOWN if turn is None else value_and_error(turn.length, turn.sigma, "rad")
    translated = UNKNOWN if shift is None else value_and_error(shift.length, shift.sigma)
    return printable(f"{pair.target}, {pair.source}"), _verdict(pair.answer), rotated, translated
