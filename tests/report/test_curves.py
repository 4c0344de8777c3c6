"""The error over the distance: what the covariance says, what was asked for, and no more."""

from __future__ import annotations

import math
import re

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace

from retropole.base.systematic import Sway, stated_sway
from retropole.base.uncertainty import predicted_error
from retropole.base.uncertainty.confirmation import Confirmation
from retropole.base.uncertainty.purpose import Fitness, displacement_bound, displacement_bounds
from retropole.report import render_report
from retropole.report.curves import RANGES, curve_figure, curve_sentence, error_curve
from retropole.report.subject import as_subject
from retropole.report.text import describe_result
from retropole.result import SwayDoc
from tests.report.made_up import Page, made_up

RESULT = made_up("ok", 300).result
NOWHERE = {"T_target_source": None, "covariance": None}


def curve_of(**fields: object):  # type: ignore[no-untyped-def]
    return error_curve(as_subject(replace(RESULT, **fields), ()))


def corners(html: str) -> list[np.ndarray]:
    """The corners of every curve, in the picture's units."""
    paths = re.findall(r'class="line (?:one-sigma|bound)" d="M([^"]*)"', html)
    return [np.array([each.split() for each in p.split("L")], float) for p in paths]


@pytest.mark.full
def test_the_curves_are_those_of_the_covariance() -> None:
    curve = curve_of()
    C = np.asarray(RESULT.covariance)
    np.testing.assert_allclose(curve.sigmas, [e.sigma_m for e in predicted_error(C, RANGES)])
    for distance, bound in zip(RANGES, curve.bounds, strict=True):
        assert bound == pytest.approx(displacement_bound(C, distance))
    sigma, bound = corners(curve_figure(curve))
    assert len(sigma) == len(bound) == len(RANGES)
    # Down is up in a picture: a larger error is nearer to its top, by one scale for both.
    scale = np.polyfit([*curve.sigmas, *curve.bounds], [*sigma[:, 1], *bound[:, 1]], 1)[0]
    assert scale < 0
    np.testing.assert_allclose(np.diff(sigma[:, 1]), scale * np.diff(curve.sigmas), atol=0.2)


def test_bounds_at_many_distances_are_those_at_each() -> None:
    C = np.asarray(RESULT.covariance)
    together = displacement_bounds(C, (1.0, 30.0), 0.9)
    np.testing.assert_allclose(together, [displacement_bound(C, r, 0.9) for r in (1.0, 30.0)])
    assert np.all(np.diff(displacement_bounds(C, RANGES)) > 0)


def test_a_need_is_a_line_where_it_is_near_and_words_where_it_is_not() -> None:
    assert "line needed" not in curve_figure(curve_of())
    for within, is_drawn in ((0.02, True), (10.0, False)):
        asked = Fitness(within, 30.0, "yes", 0.98, 0.018, "")
        html = curve_figure(curve_of(fitness=asked))
        assert ("line needed" in html) is is_drawn
        assert f"Needed: within {100 * within:g} cm at 30 m" in html


def test_no_95_percent_line_where_the_pose_may_be_another_one() -> None:
    doubted = Confirmation(agreeing=10, contradicting=30, z_margin=-2.0)
    assert (doubted.probability_wrong or 0.0) > 0.05
    curve = curve_of(confirmation=doubted)
    assert curve.bounds is None
    assert curve_sentence(curve) == ""
    assert len(corners(curve_figure(curve))) == 1
    assert "the pose itself is wrong with a probability of" in Page(curve_figure(curve)).text
    trusted = curve_of(confirmation=replace(doubted, trusted=True))
    assert trusted.bounds == curve_of().bounds


def test_nothing_is_drawn_where_nothing_is_stated() -> None:
    for fields in ({"covariance": None}, NOWHERE):
        assert curve_figure(curve_of(**fields)) == ""
        assert curve_sentence(curve_of(**fields)) == ""


@pytest.mark.parametrize("scale", [1e-12, 1e-6, 1.0, 1e6])
def test_whatever_the_size_everything_is_in_the_picture(scale: float) -> None:
    html = curve_figure(curve_of(covariance=scale * np.asarray(RESULT.covariance)))
    width, height = map(float, re.findall(r'viewBox="0 0 (\S+) (\S+)"', html)[0])
    for line in corners(html):
        assert np.all((line >= 0) & (line <= [width, height]))
    levels = re.findall(r'text-anchor="end">([^<]*)<', html)
    assert 3 <= len(levels) <= 7
    assert len(set(levels)) == len(levels)


def test_what_swayed_is_drawn_and_reported() -> None:
    run = made_up()
    times = np.arange(20) / 10
    angles = 0.001 * np.sin(2 * np.pi * 0.5 * times)
    seen = Sway(
        0.0007, 0.5, 2.0, np.diag([1e-8] * 6), tuple(times.tolist()), tuple(angles.tolist())
    )
    found = [SwayDoc(0, 0, seen), SwayDoc(1, 0, stated_sway(math.radians(0.05)))]
    document = msgspec.structs.replace(run.result, sways=found)
    page = render_report(document, run.placements)
    assert 'id="sway"' in page
    assert "The target: ± 0.04° at 0.5 Hz" in page
    assert "The source: ± 0.05° as stated" in page
    assert page.count('aria-labelledby="sway-') == 1
    # The terminal has one line: of the one whose rest is known the least.
    text = " ".join(describe_result(document, ()).split())
    assert "swayed while recorded: the source ± 0.05° as stated" in text
    assert "swayed" not in describe_result(run.result, ())
    assert 'id="sway"' not in render_report(run.result, run.placements)
    Page(page)
