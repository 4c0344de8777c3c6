"""The command ``retropole check``."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..api.choices import DEFAULT_TOLERANCE, WIDEST_TOLERANCE
from ..result import ReasonDoc
from ..result.options import OPTIONS
from .common import EXIT_MOVED, EXIT_REFUSED, in_colour, json_text, listening, show
from .options import CLOUD, DEGREES, METRES, Command, run_option

if TYPE_CHECKING:
    from ..api.checking import CheckResult, Movement
    from ..base.datatypes import Array

EXITS = {"same": 0, "moved": EXIT_MOVED, "cannot_tell": EXIT_REFUSED}

NOISE_SIGMAS = 2.0
"""A movement of fewer σ than this has no direction worth naming."""

MOSTLY_ALONG = math.cos(math.radians(30.0))
"""A direction within 30° of an axis goes by its name."""


def tolerance_options(command: Command) -> Command:
    """Give a command --tolerance-deg and --tolerance-m."""
    default, widest = DEFAULT_TOLERANCE, WIDEST_TOLERANCE
    more = "or what the data can show, up to"
    rotation = click.option(
        "--tolerance-deg",
        "rotation",
        type=DEGREES,
        help="Smallest rotation that must be found: where it could be missed, the answer is not "
        "'same'.  "
        f"[default: {math.degrees(default.rotation):g}, {more} {math.degrees(widest.rotation):g}]",
    )
    translation = click.option(
        "--tolerance-m",
        "translation",
        type=METRES,
        help="The same of a translation.  "
        f"[default: {default.translation:g}, {more} {widest.translation:g}]",
    )
    return rotation(translation(command))


@click.command()
@click.argument("result", type=click.Path(path_type=Path))
@click.argument("target", type=CLOUD)
@click.argument("source", type=CLOUD)
@run_option(
    "target_topic",
    help=f"{OPTIONS['target_topic'].help}  [default: that of RESULT, where TARGET is a bag]",
)
@run_option("source_topic")
@run_option(
    "unit", default=None, help="Unit of the new recordings' coordinates.  [default: that of RESULT]"
)
@run_option("unit_source", help="The same for SOURCE alone.")
@click.option("--parent", help="Where RESULT is of a site: the name of the LiDAR of TARGET.")
@click.option("--child", help="The same of SOURCE.")
@tolerance_options
@click.option(
    "--sigma-deg",
    "sigma_rotation",
    type=DEGREES,
    help="1 sigma of RESULT's rotation, about each axis.  [default: its covariance]",
)
@click.option(
    "--sigma-m",
    "sigma_translation",
    type=METRES,
    help="1 sigma of RESULT's translation, along each axis.",
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
    """Tell whether the LiDARs still stand as they stood when RESULT was made.

    RESULT is result.json, the folder that holds it, or any file that 'retropole export' writes
    (one without a covariance needs --sigma-deg and --sigma-m). TARGET and SOURCE are new
    recordings of the same two LiDARs. With poles, the poles are used; without, the scene. Radius,
    sensors, thresholds and units are those of RESULT.

    Of a site, RESULT is site-result.json or its folder, and --parent and --child name the two
    LiDARs; radius and sensors are those of the site.

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
      130  interrupted
    """
    from ..api.checking import CheckResult, check_recordings, read_stored
    from ..base.errors import Refusal

    if (sigma_rotation is None) != (sigma_translation is None):
        raise click.UsageError("--sigma-deg and --sigma-m belong together")
    if (parent is None) != (child is None):
        raise click.UsageError("--parent and --child belong together")
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
    if as_json:
        show(json_line(answer))
    elif not quiet:
        show(in_colour(in_words(answer), answer.status))
    return EXITS[answer.status]


def json_line(answer: CheckResult) -> str:
    """Write the answer as one line of JSON; what is not known is null."""
    return json_text(answer_fields(answer))


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
    from ..base.errors import printable
    from ..base.quantities import value_and_error
    from ..report.layout import wrapped
    from ..report.text import reason_lines

    verdict = answer.status.replace("_", " ")
    if answer.status == "same" and answer.tolerance is not None:
        verdict += f" within {answer.tolerance.in_words}"
    lines = [f"verdict: {verdict}"]
    rotation, translation = answer.rotation, answer.translation
    if answer.step is not None and rotation is not None and translation is not None:
        how = "poles and scene" if answer.used == "poles" else "the scene alone"
        lines += [
            f"  rotated by    {value_and_error(rotation.length, rotation.sigma, 'rad')} (1 σ), "
            f"{_direction(answer.step[:3], rotation, 'about', (' (roll)', ' (pitch)', ' (yaw)'))}",
            f"  translated by {value_and_error(translation.length, translation.sigma)} (1 σ), "
            f"{_direction(answer.step[3:], translation, 'along', ('', '', ''))}",
            "  (the source against the target; which of them moved, two LiDARs cannot tell)",
            f"  χ² {answer.chi2:.1f} with 6 degrees of freedom; as much where nothing moved: "
            f"{answer.p_value:.2g} (called moved below {FALSE_ALARM:g})",
            f"  found by {how}",
        ]
    if answer.confirmation is not None:
        words = answer.confirmation.words
        lines.append(f"  scene check under the stored pose: {words}")
    lines = [part for line in lines for part in wrapped(line, "    ")]
    for reason in answer.reasons:
        lines += reason_lines(ReasonDoc(reason.code, printable(reason.message), {}))
    return "\n".join(lines)


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
