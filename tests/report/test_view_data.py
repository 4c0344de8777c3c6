"""What the page's own code is given: no content leads out of it, and it is the result's."""

from __future__ import annotations

import json

import numpy as np
from msgspec.structs import replace

from retropole.base import se3
from retropole.base.datatypes import Placement, Scan
from retropole.report.view_data import MAX_CONTRADICTING, embed_json, page_view
from retropole.scene.consistency import contradicting_points, standing_in
from retropole.simulation import simulate_pair
from tests.report.made_up import HOSTILE, T_TRUE, made_up
from tests.report.test_points import unpacked

NAMES = ("front.pcd", "rear.pcd")


def test_embedded_json_says_the_same_and_no_markup() -> None:
    value = {"a": [HOSTILE, 1.5, None, {"b": (float("nan"), float("-inf"), 2)}]}
    text = embed_json(value)
    assert not set("<>&") & set(text)
    assert json.loads(text) == {"a": [HOSTILE, 1.5, None, {"b": [None, None, 2]}]}


def test_ellipsoid_is_the_covariance_of_the_translation() -> None:
    result, placements = made_up(count=500)
    root = 1e-3 * np.random.default_rng(3).standard_normal((6, 6))
    result = replace(result, covariance=root @ root.T)
    ellipsoid = page_view(result, placements, NAMES, 100).ellipsoid
    assert ellipsoid is not None
    axes = np.array(ellipsoid.axes) / ellipsoid.factor
    assert np.allclose(axes.T @ axes, (root @ root.T)[3:, 3:], atol=1e-12)
    assert np.allclose(ellipsoid.centre, T_TRUE[:3, 3])


def test_every_pose_has_a_name_of_its_own() -> None:
    result, placements = made_up(count=500)
    poses = page_view(result, placements, NAMES, 100).poses
    assert [pose.id for pose in poses] == ["result", "a", "b", "c", "d"]
    transforms = [h.T_target_source for h in result.hypotheses]
    assert [pose.T for pose in poses] == [result.T_target_source, *transforms]
    refused = page_view(*made_up("refused", 500), NAMES, 100)
    assert [pose.id for pose in refused.poses] == ["a", "b", "c", "d"]
    assert refused.ellipsoid is None


def test_poles_are_drawn_from_end_to_end() -> None:
    result, placements = made_up(count=500)
    view = page_view(result, placements, NAMES, 100).placements[0]
    assert view.files == "front.pcd ← rear.pcd"
    for lines, listed in zip(view.poles, (result.poles.target, result.poles.source), strict=True):
        for line, pole in zip(lines, listed, strict=True):
            a, b = np.array(line.a), np.array(line.b)
            assert np.allclose((a + b) / 2, pole.point_m)
            assert np.allclose(b - a, pole.length_m * np.array(pole.direction))


def test_every_pose_brings_the_points_that_contradict_it() -> None:
    pair = simulate_pair("street", np.random.default_rng(3))
    placement = Placement(Scan(pair.target), Scan(pair.source))
    right, wrong = pair.T_target_source, se3.retract(pair.T_target_source, np.full(6, 0.3))
    result = made_up(count=500).result
    result = replace(
        result,
        T_target_source=right,
        hypotheses=[replace(result.hypotheses[0], T_target_source=wrong)],
    )
    marked = page_view(result, [placement], NAMES, 100).placements[0].contradicting
    assert set(marked) == {"result", "a"}
    rng = np.random.default_rng(0)
    target, source = standing_in(pair.target, rng), standing_in(pair.source, rng)
    for name, T in (("result", right), ("a", wrong)):
        for packed, points in zip(
            marked[name], contradicting_points(target, source, T), strict=True
        ):
            seen = unpacked(packed)
            assert min(len(points), MAX_CONTRADICTING // 2) <= len(seen) <= MAX_CONTRADICTING
            kept = points[:: 1 + len(points) // MAX_CONTRADICTING]
            np.testing.assert_allclose(seen, kept, atol=2e-3)
    assert sum(len(unpacked(each)) for each in marked["a"]) > 100


def test_marked_points_of_many_placements_stay_few() -> None:
    result, (placement,) = made_up(count=500)
    views = page_view(result, [placement] * 50, NAMES * 50, 100).placements
    for points in zip(*(view.contradicting["c"] for view in views), strict=True):
        assert sum(len(unpacked(each)) for each in points) <= MAX_CONTRADICTING
