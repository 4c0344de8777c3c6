"""Seen along a pole: the circle is where the returns have it, and a poor fit is said to be one."""

from __future__ import annotations

import numpy as np
import pytest

from retropole.base.datatypes import Placement, Scan
from retropole.report import crosssections
from retropole.report.crosssections import across, fit_circle
from retropole.report.crosssections import cross_sections as cross_sections_of
from retropole.report.subject import of_pair
from retropole.result import ResultDoc
from tests.report.made_up import Page, made_up


def cross_sections(result: ResultDoc, placement: Placement) -> str:
    return cross_sections_of(of_pair(result, [placement]))


def test_circle_of_known_radius_is_found_from_one_side() -> None:
    rng = np.random.default_rng(2)
    angle = rng.uniform(-1.2, 1.2, 200)
    radius = 0.02 + 0.002 * rng.standard_normal(200)
    flat = np.c_[radius * np.cos(angle), radius * np.sin(angle)] + [3.0, -1.0]
    circle = fit_circle(flat, 0.02, flat.mean(axis=0) - [0.01, 0.0])
    assert circle.converged
    assert np.allclose(circle.point, [3.0, -1.0], atol=1e-3)


@pytest.mark.parametrize("seed", range(20))
def test_converged_circle_is_where_its_weighted_residuals_balance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    angle = rng.uniform(-1.5, 0.5, 80)
    radius = 0.02 + 0.005 * rng.standard_normal(80)
    flat = np.c_[radius * np.cos(angle), radius * np.sin(angle)]
    circle = fit_circle(flat, 0.02, flat.mean(axis=0) - [0.008, 0.0])
    away = flat - circle.point
    distance = np.linalg.norm(away, axis=1)
    residual = distance - 0.02
    weight = 1 / np.sqrt(1 + (residual / crosssections.RESIDUAL_SCALE) ** 2)
    force = np.abs(((weight * residual / distance)[:, None] * away).sum(axis=0)).max()
    assert circle.converged
    assert force / len(flat) < 10 * crosssections.CIRCLE_STEP_TOLERANCE


def test_across_a_pole_is_at_right_angles_to_it() -> None:
    pole = made_up(count=500).placements[0].target.poles[0]
    centre, axes = across(pole.xyz)
    assert np.allclose(axes @ axes.T, np.eye(2), atol=1e-12)
    assert np.abs(axes @ pole.direction).max() < 0.02
    assert np.allclose(centre, pole.point)


def test_cross_sections_only_where_there_is_an_answer() -> None:
    result, (placement,) = made_up(count=500)
    html = cross_sections(result, placement)
    assert Page(html).open == []
    assert html.count("<figure>") == 2
    unsearched = Placement(Scan(placement.target.cloud), placement.source)
    assert cross_sections(result, unsearched) == ""
    refused, (placement,) = made_up("refused", 500)
    assert cross_sections(refused, placement) == ""


def test_a_circle_that_did_not_converge_is_said_to_be_none(monkeypatch: pytest.MonkeyPatch) -> None:
    result, (placement,) = made_up(count=500)
    assert "did not converge" not in cross_sections(result, placement)
    monkeypatch.setattr(crosssections, "MAX_CIRCLE_ITERATIONS", 1)
    html = cross_sections(result, placement)
    assert Page(html).text.count("did not converge") == 2
    assert html.count('aria-label="T0–S0') == 1
    assert html.count("unconverged") == 2
