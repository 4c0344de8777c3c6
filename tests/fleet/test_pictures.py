"""The map has north at the top and the scale that it draws; the bars count every site."""

from __future__ import annotations

import math
import re

import msgspec
import numpy as np
import pytest

from retropole.fleet import pictures
from retropole.fleet.overview import Seen
from retropole.fleet.pictures import fleet_map, histogram
from tests.report.made_up import Page


def at(name: str, latitude_deg: float, longitude_deg: float, status: str = "ok") -> Seen:
    site = Seen(name, "pair", "ok", (), (), None, None, 0.0123, "1", "numpy 2")
    return msgspec.structs.replace(
        site,
        status=status,
        latitude_rad=math.radians(latitude_deg),
        longitude_rad=math.radians(longitude_deg),
    )


def places(html: str) -> dict[str, np.ndarray]:
    found = re.findall(r'<path d="M([-\d.]+) ([-\d.]+)[^"]*"><title>(\w+):', html)
    return {name: np.array([float(x), float(y)]) for x, y, name in found}


def units_per_metre(html: str) -> float:
    (bar,) = re.findall(r'class="bar" d="M[\d. ]+v5h([\d.]+)v-5"/><text[^>]*>([\d,]+) (k?)m', html)
    return float(bar[0]) / (float(bar[1].replace(",", "")) * (1000 if bar[2] else 1))


def test_sites_stand_to_the_scale_that_is_drawn_with_north_at_the_top() -> None:
    html = fleet_map([at("a", 52.5, 13.4), at("b", 52.51, 13.4), at("c", 52.5, 13.42)])
    where, scale = places(html), units_per_metre(html)
    north, east = where["b"] - where["a"], where["c"] - where["a"]
    degree = math.radians(1) * 6_371_009
    assert north / scale == pytest.approx([0, -0.01 * degree], abs=2)
    wide = 0.02 * degree * math.cos(math.radians(52.505))
    assert east / scale == pytest.approx([wide, 0], abs=2)
    assert "°" in html


@pytest.mark.parametrize(
    "degrees", [[(0, 179.99), (0, -179.99)], [(-90, 0), (90, 10)], [(5, 5)], [(0, 359), (0, -1)]]
)
def test_every_place_on_earth_is_in_the_picture(degrees: list[tuple[float, float]]) -> None:
    html = fleet_map([at(f"s{k}", *each) for k, each in enumerate(degrees)])
    assert Page(html).open == []
    height = float(re.findall(r'viewBox="0 0 520 (\d+)"', html)[0])
    where = places(html)
    assert len(where) == len(degrees)
    for x, y in where.values():
        assert 0 <= x <= pictures.WIDTH
        assert 0 <= y <= height
    near = [(179.99, -179.99), (359, -1)]
    if tuple(longitude for _, longitude in degrees) in near:
        assert np.linalg.norm(where["s0"] - where["s1"]) / units_per_metre(html) < 3000


def test_statuses_differ_in_shape_and_the_worst_lie_on_top() -> None:
    sites = [
        at(f"s{k}", 1, 1, status) for k, status in enumerate(("error", "ok", "refused", "warn"))
    ]
    html = fleet_map(sites)
    groups = re.findall(r'<g class="site (\w+) size-60"><path d="M[\d.]+ [\d.]+([^"]*)"', html)
    assert [status for status, _ in groups] == ["ok", "warn", "refused", "error"]
    assert len({shape for _, shape in groups}) == 4
    assert "s0: error, 12 mm at 30 m" in Page(html).text


def test_what_is_not_drawn_or_named_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pictures, "MOST_NAMED", 2)
    nowhere = msgspec.structs.replace(at("x", 1, 1), latitude_rad=None, longitude_rad=None)
    html = fleet_map([at("a", 1, 1), at("b", 1, 1.1, "error"), at("c", 1.1, 1.1), nowhere])
    assert set(places(html)) == {"a", "b"}
    assert "3 sites." in html
    assert "1 site not drawn" in html
    assert "2 have their names" in html
    assert len(re.findall(r'<path d="M[\d]+ [\d]+h.01"/>', html)) == 1 + 1  # And of the legend.
    assert "svg" not in fleet_map([nowhere])


@pytest.mark.parametrize(
    "values",
    [[0.01], [0.01] * 5, [1e-3, 2e-3, 0.5], [1e-12, 1e6], list(np.geomspace(0.002, 0.08, 99))],
)
def test_bars_count_every_site(values: list[float]) -> None:
    html = histogram(values)
    assert Page(html).open == []
    counts = re.findall(r"<title>[^<]*: ([\d,]+) sites?</title>", html)
    assert sum(map(int, counts)) == len(values)
    assert len(counts) <= pictures.MOST_BARS
    heights = [float(each) for each in re.findall(r'<path d="M[\d. ]+v(-[\d.]+)h', html)]
    assert np.array(heights) / min(heights) == pytest.approx(
        np.array(counts, dtype=float) / max(map(int, counts)), abs=0.01
    )


def test_without_errors_there_are_no_bars() -> None:
    assert histogram([]) == histogram([0.0]) == ""
