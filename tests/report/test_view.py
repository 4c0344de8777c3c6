"""What the page's own code is given: every cloud under its pose, and no way out of it."""

from __future__ import annotations

import json

import numpy as np
import pytest
from msgspec.structs import replace

from retropole.base import se3
from retropole.base.datatypes import Placement, PointCloud, Scan
from retropole.report import view
from retropole.report.plan import Plan, plan_of
from retropole.report.subject import Subject, as_subject
from retropole.report.view import (
    MAX_CONTRADICTING,
    PageView,
    embed_json,
    page_view,
    recordings_view,
)
from retropole.result import ResultDoc
from retropole.simulation import simulate_pair
from retropole.surfaces.consistency import contradicting_points, objects_in
from tests.report.made_up import AS_SHOWN, HOSTILE, T_TRUE, made_up
from tests.report.pages import cloud_of
from tests.report.site.made_up import document_of, made_up_site
from tests.report.test_points import unpacked

SITE = made_up_site(lidars=3, placements=2, count=200)
DOCUMENT = document_of(SITE)


def view_of(subject: Subject, plan: Plan | None = None) -> PageView:
    made = page_view(subject, plan or plan_of(subject.site), 100)
    assert made is not None
    return made


def of_result(result: ResultDoc, *placements: Placement) -> PageView:
    return view_of(as_subject(result, placements or made_up(count=500).placements))


def test_embedded_json_says_the_same_and_no_markup() -> None:
    value = {"a": [HOSTILE, 1.5, None, {"b": (float("nan"), float("-inf"), 2)}]}
    text = embed_json(value)
    assert not set("<>&") & set(text)
    assert json.loads(text) == {"a": [AS_SHOWN, 1.5, None, {"b": [None, None, 2]}]}


def test_ellipsoid_is_the_covariance_of_the_translation() -> None:
    root = 1e-3 * np.random.default_rng(3).standard_normal((6, 6))
    ellipsoid = of_result(replace(made_up(count=500).result, covariance=root @ root.T)).ellipsoid
    assert ellipsoid is not None
    axes = np.array(ellipsoid.axes) / ellipsoid.factor
    assert np.allclose(axes.T @ axes, (root @ root.T)[3:, 3:], atol=1e-12)
    assert np.allclose(ellipsoid.centre, T_TRUE[:3, 3])


def test_every_pose_of_a_pair_has_a_name_of_its_own() -> None:
    result = made_up(count=500).result
    poses = of_result(result).poses
    assert [pose.id for pose in poses] == ["result", "a", "b", "c", "d"]
    transforms = [h.T_target_source for h in result.hypotheses]
    assert [pose.T for pose in poses] == [result.T_target_source, *transforms]
    refused = of_result(made_up("refused", 500).result)
    assert [pose.id for pose in refused.poses] == ["a", "b", "c", "d"]
    assert refused.ellipsoid is None


def test_poles_of_a_pair_are_drawn_from_end_to_end() -> None:
    result = made_up(count=500).result
    made = of_result(result)
    assert made.placements == ["1: front.pcd ← rear.pcd"]
    for cloud, listed in zip(made.clouds, (result.poles.target, result.poles.source), strict=True):
        for line, pole in zip(cloud.poles, listed, strict=True):
            a, b = np.array(line.a), np.array(line.b)
            assert np.allclose((a + b) / 2, pole.point_m)
            assert np.allclose(b - a, pole.length_m * np.array(pole.direction))


def test_every_pose_brings_the_points_that_contradict_it() -> None:
    pair = simulate_pair("street", np.random.default_rng(3))
    placement = Placement(Scan(pair.target), Scan(pair.source))
    right, wrong = pair.T_target_source, se3.retract(pair.T_target_source, np.full(6, 0.3))
    made = made_up(count=500).result
    hypotheses = [replace(made.hypotheses[0], T_target_source=wrong)]
    result = replace(made, T_target_source=right, hypotheses=hypotheses)
    clouds = of_result(result, placement).clouds
    rng = np.random.default_rng(0)
    target, source = objects_in(pair.target, rng), objects_in(pair.source, rng)
    for name, T in (("result", right), ("a", wrong)):
        for cloud, points in zip(clouds, contradicting_points(target, source, T), strict=True):
            assert set(cloud.contradicting) == {"result", "a"}
            seen = unpacked(cloud.contradicting[name])
            assert min(len(points), MAX_CONTRADICTING // 2) <= len(seen) <= MAX_CONTRADICTING
            kept = points[:: 1 + len(points) // MAX_CONTRADICTING]
            np.testing.assert_allclose(seen, kept, atol=2e-3)
    assert sum(len(unpacked(cloud.contradicting["a"])) for cloud in clouds) > 100


@pytest.mark.full
def test_marked_points_of_many_placements_stay_few() -> None:
    result, (placement,) = made_up(count=500)
    clouds = of_result(result, *[placement] * 50).clouds
    for k in range(2):
        marked = (unpacked(c.contradicting["c"]) for c in clouds if c.lidar == k)
        assert sum(map(len, marked)) <= MAX_CONTRADICTING


def test_every_recording_of_a_site_is_there_with_its_pose() -> None:
    made = view_of(as_subject(DOCUMENT, SITE.scans))
    assert [(c.lidar, c.placement) for c in made.clouds] == [(0, 0), (0, 1), (1, 0), (1, 1), (2, 0)]
    poses = [np.array(each.T) for each in made.lidars]
    assert np.allclose(poses, [np.array(each.T_site_lidar) for each in DOCUMENT.lidars])
    assert [pole.label for pole in made.poles] == ["1.1", "1.2", "2.1", "2.2"]


def test_poles_of_a_site_lie_on_the_returns_of_every_lidar() -> None:
    # In a tilted plan too: what is turned is turned together.
    R = se3.exp_so3(np.array([0.4, -0.2, 0.9]))
    made, scan = view_of(as_subject(DOCUMENT, SITE.scans), Plan(R, "", None)), SITE.scans[1][0]
    assert scan is not None
    pole, on_pole = made.poles[0], se3.apply(np.array(made.lidars[1].T), scan.poles[0].xyz)
    along = np.array(pole.b) - np.array(pole.a)
    away = np.cross(on_pole - np.array(pole.a), along / np.linalg.norm(along))
    assert np.linalg.norm(away, axis=1).max() < 0.05


def test_points_are_shared_among_the_clouds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(view, "MAX_SITE_POINTS", 250)
    made = view_of(as_subject(DOCUMENT, SITE.scans))
    assert [cloud.points.shown for cloud in made.clouds] == [50] * 5
    assert "the page shows 250 of" in made.shown


def test_a_refused_site_has_clouds_without_poses() -> None:
    refused = made_up_site("refused", lidars=3, placements=2, count=50)
    document = document_of(refused)
    made = view_of(as_subject(document, refused.scans))
    assert made.kind == "alone"
    assert [each.T for each in made.lidars] == [None] * 3
    assert len(made.clouds[0].poles) == 2
    assert page_view(as_subject(document), plan_of(document)) is None


def test_recordings_begin_with_the_threshold_of_the_search_or_of_the_cloud() -> None:
    searched = made_up().placements[0].target
    assert searched.detection is not None
    alike = PointCloud(np.eye(3), np.ones(3))
    scans = [searched, Scan(cloud_of(500)), Scan(alike), Scan(PointCloud(np.eye(3)))]
    view = recordings_view(["a", "b", "c", "d"], scans)
    first, second, *others = [cloud.points.levels for cloud in view.clouds]
    assert first is not None
    assert second is not None
    assert first.threshold == searched.detection.threshold
    assert 0.4 < second.threshold <= 0.9
    assert others == [None, None]
    assert [pole.label for pole in view.clouds[0].poles] == ["pole 0", "pole 1"]
    assert view.clouds[0].rejected
