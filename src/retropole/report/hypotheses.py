"""The ways of matching the poles of a pair, and what decides between them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from ..base import se3
from ..base.datatypes import Array
from ..base.quantities import counted
from ..base.reasons import plain
from ..base.uncertainty import SIGMAS
from ..hypotheses.choice import hypothesis_name
from ..hypotheses.prior import PosePrior
from ..result import DEFAULT_CONFIG, HypothesisDoc, ReasonDoc, ResultDoc
from . import listings
from .listings import number, numbers
from .page import EMPTY, Html, fill, fill_each, folded, inline, join, listed, table

LEFT_TO_USER = ("ambiguous", "small_margin", "chosen_by_hand")
"""Reasons that leave the choice to a person."""

SAME_AXIS = math.radians(10.0)
"""Within this of the vertical, or of level, an axis is called so, rad: it is between poses that
the poles alone give, and the normal of the ground that is taken for the vertical is off by some
degrees, too."""

LEAST_TURN = math.radians(1.0)
"""Hypotheses that differ by less are not called turned, rad."""


def undecided(result: ResultDoc) -> list[tuple[str, HypothesisDoc]]:
    """List the hypotheses between which a person may decide, by name; none where it is decided."""
    if not any(reason.code in LEFT_TO_USER for reason in result.reasons):
        return []
    named = [
        (hypothesis_name(k), each)
        for k, each in enumerate(result.hypotheses)
        if each.stands or each.chosen
    ]
    return named if len(named) > 1 else []


def relative_words(result: ResultDoc, hypothesis: HypothesisDoc) -> str:
    """Describe the pose of the source under a hypothesis, relative to the first of all."""
    T = hypothesis.T_target_source
    first = result.hypotheses[0].T_target_source
    turn = se3.log_so3(T[:3, :3] @ first[:3, :3].T)
    angle, shift = float(np.linalg.norm(turn)), float(np.linalg.norm(T[:3, 3] - first[:3, 3]))
    moved = f"moved by {shift:.1f} m"
    if angle < LEAST_TURN:
        return f"source {moved}"
    axis = axis_words(turn / angle, result.vertical)
    return f"source turned by {math.degrees(angle):.0f}° about {axis} and {moved}"


def axis_words(axis: Array, vertical: Array | None) -> str:
    """Name an axis (3,) by the vertical where that is known, else by the target's frame."""
    if vertical is None:
        k = int(np.argmax(np.abs(axis)))
        if abs(axis[k]) >= math.cos(SAME_AXIS):
            return f"the target's {'xyz'[k]} axis"
        axis = axis * np.sign(axis[k])
        return f"the axis ({', '.join(numbers(axis, 2))}) of the target's frame"
    tilt = math.acos(min(1.0, abs(float(axis @ vertical))))
    if tilt <= SAME_AXIS:
        return "the vertical"
    if tilt >= math.pi / 2 - SAME_AXIS:
        return "a horizontal axis"
    return f"an axis {math.degrees(tilt):.0f}° off the vertical"


def deciding(result: ResultDoc, named: Sequence[tuple[str, HypothesisDoc]]) -> Iterator[str]:
    """Name the options that would leave one hypothesis, as marked-up sentences.

    A rotation separates them if none within its reach, 3 σ of the default, is within reach of
    two: whatever it is, it then leaves at most one.
    """
    config, poses = result.config, [each.T_target_source for _, each in named]
    sigma = math.radians(DEFAULT_CONFIG.prior_sigma_deg)
    reach = f"{math.degrees(SIGMAS * sigma):.0f}°"
    if not config.up and config.prior_rpy_deg is None:
        upright = PosePrior(None, sigma)
        left = [name for (name, _), T in zip(named, poses, strict=True) if upright.allows(T)]
        if len(left) == 1:
            yield f"`--up`, if both LiDARs are upright to within {reach}, leaves {left[0]}"
    if config.prior_rpy_deg is None and _least_turn(poses) > 2 * SIGMAS * sigma:
        instead = " instead of `--up`" if config.up else ""
        known = f"if you know the angles to within {reach}"
        yield f"`--prior-rpy-deg R P Y`{instead}, {known}, leaves one"
    if config.hypothesis is None:
        names = " | ".join(name for name, _ in named)
        yield f"`--hypothesis {names}` selects the one that you know is right, with a warning"


def _least_turn(poses: Sequence[Array]) -> float:
    """The least angle between the rotations of any two poses, rad."""
    return min(
        se3.rotation_angle(one[:3, :3] @ other[:3, :3].T)
        for k, one in enumerate(poses)
        for other in poses[:k]
    )


def pose_numbers(hypothesis: HypothesisDoc) -> list[str]:
    """Write roll, pitch and yaw in degrees and the translation in metres."""
    T = hypothesis.T_target_source
    angles = np.degrees(se3.rpy_from_rotation(T[:3, :3]))
    return [*numbers(angles, 1), *numbers(T[:3, 3], 2)]


def describe_undecided(result: ResultDoc) -> list[str]:
    """Write the hypotheses that are not ruled out, for a terminal; none where it is decided."""
    named = undecided(result)
    if not named:
        return []
    lines = ["hypotheses not ruled out, roll pitch yaw in deg, x y z in m"]
    widths = [max(len(pose_numbers(each)[k]) for _, each in named) for k in range(6)]
    for name, each in named:
        cells = [value.rjust(widths[k]) for k, value in enumerate(pose_numbers(each))]
        mark = " *" if each.chosen else "  "
        lines.append(f"  {name}{mark} {'  '.join(cells[:3])}    {'  '.join(cells[3:])}")
        if each is not result.hypotheses[0]:
            lines.append(f"       versus a: {relative_words(result, each)}")
    lines += [f"  {plain(line)}" for line in deciding(result, named)]
    return lines


def hypotheses(result: ResultDoc | None) -> Html:
    """Show all hypotheses of a pair as panels (drawn by the page's code) and as a table."""
    if result is None or not result.hypotheses:
        return EMPTY
    compared = fill(
        "hypotheses-compared",
        standing=_undecided(result),
        panels=join(_panel(k, each) for k, each in enumerate(result.hypotheses)),
        table=listed(listings.hypotheses(result)),
    )
    is_clear, decided = result.status == "ok", margin_words(result) or tried_words(result.reasons)
    count = counted(len(result.hypotheses), "hypothesis", "hypotheses")
    has_poles = any(each.pairs for each in result.hypotheses)
    return fill(
        "hypotheses",
        open=fill("poles-leave-open" if has_poles else "without-poles"),
        decided=f" {decided}." if decided else "",
        body=folded(f"Compare {count}", compared) if is_clear else compared,
    )


def margin_words(result: ResultDoc) -> str:
    """Give the chosen hypothesis and its margin; empty if there is no other."""
    chosen = [hypothesis_name(k) for k, each in enumerate(result.hypotheses) if each.chosen]
    if not chosen or result.margin is None:
        return ""
    return f"Hypothesis {chosen[0]} is chosen: its score is {result.margin:.2f} above the next best"


TRIED = {
    (
        "pairs",
        "pairs_laid",
    ): "the {} most similar of {} pairs of possible poles were matched",
    ("ways", "ways_tried"): "the best {} of {} ways of pairing possible poles were tried",
    ("fitting", "fitting_registered"): "the best {} of {} that fit were registered",
}
"""What a refusal counts of what was left out: how many there are, how many were tried."""


def tried_words(reasons: Sequence[ReasonDoc]) -> str:
    """State what a refusal left out to bound the time; empty if it tried all."""
    text = [
        template.format(reason.values[tried], reason.values[found])
        for reason in reasons
        for (found, tried), template in TRIED.items()
        if found in reason.values and tried in reason.values
    ]
    return f"To bound the time, {', '.join(text)}" if text else ""


def _undecided(result: ResultDoc) -> Html:
    """List the hypotheses between which a person may decide, and the options that would."""
    named = undecided(result)
    if not named:
        return EMPTY
    rows = [
        (
            name + (" · chosen" if each.chosen else ""),
            *pose_numbers(each),
            "" if each is result.hypotheses[0] else relative_words(result, each),
        )
        for name, each in named
    ]
    names = "hypothesis; roll, deg; pitch, deg; yaw, deg; x, m; y, m; z, m; versus a"
    items = fill_each("li", map(inline, deciding(result, named)))
    return fill(
        "standing",
        table=table("Hypotheses not ruled out", listings.columns(names), rows, (7,)),
        options=fill("advice", title="What decides", items=items) if items else items,
    )


def _panel(k: int, hypothesis: HypothesisDoc) -> Html:
    return fill(
        "panel",
        name=hypothesis_name(k),
        key=fill("key", key=k + 1) if k < 9 else "",
        kind=" chosen" if hypothesis.chosen else "",
        chosen=" · chosen" if hypothesis.chosen else "",
        overlap=number(hypothesis.overlap, 0, 100, " %"),
        score=number(hypothesis.score, 3),
    )
