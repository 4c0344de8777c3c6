"""Poles, residuals, covariance and options are told as the result and the clouds have them."""

from __future__ import annotations

import re

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace

from retropole.base import se3
from retropole.report.evidence import placements, poles, provenance
from retropole.result import PlacementDoc, RunConfig
from tests.report.made_up import Page, made_up


def test_poles_and_rejected_clusters_of_both_are_listed() -> None:
    result, (placement,) = made_up(count=500)
    text = Page(poles(result, placement)).text
    for name in ("target T0", "target T1", "source S0", "source S1"):
        assert name in text
    assert text.count("too_wide") == 2
    assert "× 0" in text
    assert "+ 0" in text


def test_residuals_are_those_of_the_points_from_the_lines() -> None:
    result, (placement,) = made_up(count=500)
    assert result.T_target_source is not None
    ours, theirs = placement.target.poles[0], placement.source.poles[0]
    away = se3.apply(np.array(result.T_target_source), theirs.xyz) - ours.point
    distances = np.linalg.norm(np.cross(away, ours.direction), axis=1)
    html = poles(result, placement)
    (row,) = re.findall(r'<tr><th scope="row">T0–S0</th>(.*?)</tr>', html)
    figures = [float(cell) for cell in re.findall(r"<td>([\d.]+)</td>", row)]
    assert figures[2] == pytest.approx(1000 * np.sqrt(np.mean(distances**2)), abs=0.05)
    assert figures[3] == pytest.approx(1000 * distances.max(), abs=0.05)


def test_the_radius_is_told_as_given_and_as_estimated() -> None:
    result, (placement,) = made_up(count=500)
    said = "Radius of the poles: 20.00 mm given, 20.31 ± 0.42 mm estimated (1 σ)."
    assert said in Page(poles(result, placement)).text
    assert "estimated" not in Page(poles(replace(result, radius=None), placement)).text


def test_change_without_each_placement_is_told_in_degrees_and_millimetres() -> None:
    listed = [PlacementDoc(2, 3, 0.001, 0.004), PlacementDoc(2, 2, None, None)]
    result = made_up(count=500).result
    text = Page(placements(replace(result, placements=listed))).text
    assert "placement 12 + 30.0574.0" in text
    assert "placement 22 + 2––" in text
    assert placements(replace(result, placements=listed[:1])) == ""


def test_every_option_of_the_run_is_listed() -> None:
    config = RunConfig(up=True, prior_rpy_deg=(1.0, 2.0, 3.0), poles=3, frames=(None, 20, None))
    text = Page(provenance(replace(made_up(count=500).result, config=config))).text
    for field in msgspec.structs.fields(RunConfig):
        assert field.name in text
    for said in ("upyes", "prior_rpy_deg1.0, 2.0, 3.0", "poles3", "frames:20", "seed0"):
        assert said in text
    assert "threshold_targetdefault" in text


def test_inputs_are_listed_with_their_hash() -> None:
    result = made_up(count=500).result
    text = Page(provenance(replace(result, inputs=2 * result.inputs))).text
    for item in result.inputs:
        assert text.count(item.sha256) == 2
    for name in ("target 1", "source 1", "target 2", "source 2"):
        assert name in text
