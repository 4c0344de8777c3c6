"""What the view of a site is given: every cloud under its pose, within the size of the page."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from retropole.base import se3
from retropole.report.site import view
from retropole.report.site.plan import Plan, plan_of
from retropole.report.site.view import site_view
from tests.report.site.made_up import document_of, made_up_site

SITE = made_up_site(lidars=3, placements=2, count=200)
DOCUMENT = document_of(SITE)


def test_every_recording_is_there_with_its_pose() -> None:
    made = site_view(DOCUMENT, SITE, plan_of(DOCUMENT))
    assert made is not None
    assert [(c.lidar, c.placement) for c in made.clouds] == [(0, 0), (0, 1), (1, 0), (1, 1), (2, 0)]
    poses = [np.array(each.T) for each in made.lidars]
    assert np.allclose(poses, [np.array(each.T_site_lidar) for each in DOCUMENT.lidars])
    assert [pole.label for pole in made.poles] == ["1.1", "1.2", "2.1", "2.2"]


def test_poles_lie_on_the_returns_of_every_lidar() -> None:
    # In a tilted plan too: what is turned is turned together.
    R = se3.exp_so3(np.array([0.4, -0.2, 0.9]))
    made = site_view(DOCUMENT, SITE, Plan(R, "", None))
    assert made is not None
    pole = made.poles[0]
    scan = SITE.scans[1][0]
    assert scan is not None
    on_pole = se3.apply(np.array(made.lidars[1].T), scan.poles[0].xyz)
    along = np.array(pole.b) - np.array(pole.a)
    away = np.cross(on_pole - np.array(pole.a), along / np.linalg.norm(along))
    assert np.linalg.norm(away, axis=1).max() < 0.05


def test_points_are_shared_among_the_clouds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(view, "MAX_PAGE_POINTS", 500)
    made = site_view(DOCUMENT, SITE, plan_of(DOCUMENT))
    assert made is not None
    assert [cloud.points.shown for cloud in made.clouds] == [100] * 5
    assert "the page holds 500 of" in made.shown


def test_a_refused_site_has_clouds_without_poses() -> None:
    refused = made_up_site("refused", lidars=3, placements=2, count=50)
    document = document_of(refused)
    made = site_view(document, refused, plan_of(document))
    assert made is not None
    assert [each.T for each in made.lidars] == [None] * 3
    assert len(made.clouds[0].poles) == 2


def test_clouds_that_nobody_searched_are_shown_all_the_same() -> None:
    early = replace(made_up_site("refused", lidars=3, placements=2, count=50), scans=())
    document = document_of(early)
    made = site_view(document, early, plan_of(document))
    assert made is not None
    assert len(made.clouds) == 5
    blind = replace(early.site.lidars[0], clouds=(None, None))
    nothing = replace(early, site=replace(early.site, lidars=(blind,) * 3))
    assert site_view(document, nothing, plan_of(document)) is None
