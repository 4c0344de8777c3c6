"""The page of a fleet: whole, offline, small enough, and text stays text."""

from __future__ import annotations

import hashlib
import math
import re
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from retropole.api import explain
from retropole.api.pages import inline
from retropole.base.errors import ReadError
from retropole.fleet import report
from retropole.fleet.dataset import Row, write_partition
from retropole.fleet.history.store import append
from retropole.fleet.overview import Overview, Seen, overview_of
from retropole.fleet.report import (
    CHANGED,
    MOST_FAILED,
    OUTDATED,
    WORST,
    fleet_map,
    render_fleet,
    write_fleet_report,
)
from retropole.fleet.report import MOVED as MOVED_ADVICE
from tests.fleet.history.checks import MOVED, SIGMA
from tests.fleet.history.checks import row as check_row
from tests.fleet.made_up import made_up_row, names_in_first, write_city, write_made_up
from tests.report.made_up import HOSTILE, Page

MOST_BYTES = 3e6
"""Of a page of 10,000 sites (chosen: opens at once from a mail)."""


@pytest.fixture(scope="module")
def city(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_city(tmp_path_factory.mktemp("city") / "fleet", 120)


@pytest.fixture(scope="module")
def overview(city: Path) -> Overview:
    return overview_of(str(city))


def seen(name: str, **changes: object) -> Seen:
    """Make what is taken of one row."""
    site = Seen(name, "pair", "ok", (), (), None, None, 0.01, "1", "numpy 2")
    return msgspec.structs.replace(site, **changes)


def of_sites(*sites: Seen) -> Overview:
    return Overview("/city", sites, {"retropole 1": len(sites)}, [], None, None, {})


def rows_of(page: str, caption: str) -> list[list[str]]:
    """Give the cells of a table by its caption, as text."""
    (body,) = re.findall(f"<caption>{caption}.*?<tbody>(.*?)</tbody>", page)
    rows = re.findall(r"<tr>(.*?)</tr>", body)
    return [
        [re.sub("<[^>]*>", "", cell) for cell in re.findall(r"<t[hd].*?</t[hd]>", row)]
        for row in rows
    ]


def test_every_part_that_there_is_can_be_reached(overview: Overview) -> None:
    page = Page(render_fleet(overview))
    assert page.open == []
    ids = [attributes["id"] for _, attributes in page.tags if "id" in attributes]
    assert len(ids) == len(set(ids))
    links = [str(a["href"])[1:] for tag, a in page.tags if tag == "a"]
    assert {"map", "far", "worst", "reasons", "errors", "run"} <= set(links) <= set(ids)


def test_the_page_asks_for_nothing_from_anywhere(overview: Overview) -> None:
    html = render_fleet(overview)
    assert not re.findall(r"https?://[^\s\"'`)]+", html)
    (policy,) = (a for tag, a in Page(html).tags if tag == "meta" and "http-equiv" in a)
    assert str(policy["content"]).startswith("default-src 'none'; script-src 'sha256-")
    assert "unsafe" not in str(policy["content"])
    assert not re.findall(r"<[^>]* style=", html.split("<script")[0])


def test_it_counts_what_the_dataset_has(city: Path, overview: Overview) -> None:
    assert len(overview.sites) == sum(overview.statuses.values()) == 120
    html = render_fleet(overview)
    text = Page(html).text
    for status, count in overview.statuses.items():
        assert f"{status}{count:,} (" in text
    found = {cells[0]: int(cells[4]) for cells in rows_of(html, "Sites by reason")}
    codes = [code for site in overview.sites for code in site.codes]
    assert found == {code: codes.count(code) for code in set(codes)}
    for caption, status in (("Sites that were", "refused"), ("Sites that ended", "error")):
        assert [row[:3] for row in rows_of(html, caption)] == [
            [site.id, site.codes[0], site.messages[0]]
            for site in overview.sites
            if site.status == status
        ]
    quantiles = dict(rows_of(html, "Predicted error"))
    errors = 1000 * np.array(overview.errors_at_range)
    found_mm = {name: float(each.removesuffix(" mm")) for name, each in quantiles.items()}
    assert found_mm["least"] == pytest.approx(errors.min(), rel=0.05)
    assert found_mm["largest"] == pytest.approx(errors.max(), rel=0.05)
    for name, sigma in found_mm.items():
        if "%" in name:
            level = float(name.split()[0]) / 100
            below = np.mean(errors <= sigma * 1.05)
            assert below >= level - 0.01
            assert np.mean(errors < sigma * 0.95) < level + 0.01
    assert "2026-03-01 12:00 to 2026-03-08 12:00 UTC" in text


def test_the_worst_stand_first(overview: Overview) -> None:
    stated = {site.id: site.sigma_30m_m for site in overview.sites if site.sigma_30m_m is not None}
    names = [cells[0] for cells in rows_of(render_fleet(overview), f"The {WORST} largest")]
    assert names == sorted(stated, key=lambda name: -stated[name])[:WORST]


def test_the_worst_lead_to_their_own_reports(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    rows = [made_up_row(name, rng) for name in ("a b#1", "q:1/x", "plain")]
    poses = next(row.lidars for row in rows if row.lidars)
    made = [
        msgspec.structs.replace(row, status="ok", lidars=poses, sigma_30m_m=0.03 - 0.01 * k)
        for k, row in enumerate(rows)
    ]
    made[2] = msgspec.structs.replace(made[2], kind="site")
    refused = {"status": "refused", "codes": ["ambiguous"], "lidars": [], "sigma_30m_m": None}
    made += [msgspec.structs.replace(rows[0], id=name, **refused) for name in ("no", "not")]
    out = write_made_up(tmp_path / "out", made)
    for name in ("a b#1/report.html", "q:1/x/report.html", "no/report.html"):
        (tmp_path / "reports" / name).parent.mkdir(parents=True)
        (tmp_path / "reports" / name).touch()
    page = tmp_path / "pages/fleet.html"
    write_fleet_report(str(page), overview_of(str(out)), str(tmp_path / "reports"))
    links = [str(a["href"]) for tag, a in Page(page.read_text()).tags if tag == "a"]
    assert [link for link in links if not link.startswith("#")] == [
        # What needs action comes first, in its list and on the map.
        "./../reports/no/report.html",
        "./../reports/no/report.html",
        "./../reports/a%20b%231/report.html",
        "./../reports/q%3A1/x/report.html",
    ]
    assert "Reports of single sites" not in page.read_text()


def test_what_needs_action_comes_first_with_what_to_do_next(overview: Overview) -> None:
    sites = (
        seen("fine"),
        seen("doubtful", status="warn", codes=("not_confirmed",)),
        seen("torn", status="error", codes=("unreadable",), messages=("torn.pcd: cut",)),
        seen("none", status="refused", codes=("ambiguous",), messages=("two fit",)),
    )
    html = render_fleet(of_sites(*sites))
    text = Page(html).text
    assert "3 sites need action. Start with Refused." in text
    order = [html.index(f'id="{part}"') for part in ("refused", "errors", "warned", "map")]
    assert order == sorted(order)
    for caption, code in (("Sites that were", "ambiguous"), ("Sites with a", "not_confirmed")):
        known = explain(code)
        assert known is not None
        ((*_, to_do),) = rows_of(html, caption)
        assert to_do == re.sub("<[^>]*>", "", inline(known.advice[0]))
    assert "needs action" not in Page(render_fleet(of_sites(seen("fine")))).text


def write_history(folder: Path, names: dict[str, str], weeks: int = 40) -> None:
    """Write weekly checks of sites; all but `still` move in week 30. The values are documents."""
    rng = np.random.default_rng(0)
    append(
        str(folder),
        [
            check_row(
                k,
                name,
                step=SIGMA * rng.normal(size=6) + MOVED * (k >= 30 and name != "still"),
                stored_sha256=hashlib.sha256(document.encode()).hexdigest(),
            )
            for k in range(weeks)
            for name, document in names.items()
        ],
    )


@pytest.fixture
def watched(tmp_path: Path) -> Path:
    """A dataset of sites that were all calibrated, one with a warning, and one of many LiDARs."""
    names = ("still", "lamp", "quay/4", "again")
    rows = [made_up_row(name, np.random.default_rng(1)) for name in names]
    rows = [msgspec.structs.replace(row, document="{}") for row in rows]
    assert rows[0].status == "ok"
    rows[1] = msgspec.structs.replace(rows[1], status="warn", codes=["not_confirmed"])
    rows[2] = msgspec.structs.replace(rows[2], kind="site")
    write_made_up(tmp_path / "fleet", rows)
    reports = tmp_path / "reports" / "quay/4"
    reports.mkdir(parents=True)
    (reports / "site-report.html").touch()
    return tmp_path / "fleet"


OWN = dict.fromkeys(("still", "lamp", "quay/4/a/b/c", "gone"), "{}")
HISTORY = {**OWN, "again": "{ }"}


def test_what_changed_since_its_calibration_comes_before_all(watched: Path) -> None:
    before = render_fleet(overview_of(str(watched)))
    assert "1 site needs action. Start with With a warning." in Page(before).text
    write_history(watched / "history", HISTORY)
    overview = overview_of(str(watched))
    assert overview.damaged == ()
    page = watched.parent / "fleet.html"
    write_fleet_report(str(page), overview, str(watched.parent / "reports"))
    html = page.read_text()
    # The one with a warning changed too, and counts once.
    assert "3 sites need action. Start with Changed since the calibration." in Page(html).text
    assert html.index('id="changed"') < html.index('id="warned"')
    rows = {name: cells for name, *cells in rows_of(html, CHANGED[2])}
    assert list(rows) == ["again", "lamp", "quay/4/a/b/c"]
    for name, (kind, words, to_do) in rows.items():
        assert kind == "step"
        assert words.startswith("step since 2026-08-03: rotation ")
        assert to_do == re.sub("<[^>]*>", "", inline(OUTDATED if name == "again" else MOVED_ADVICE))
    assert html.count('href="./reports/quay/4/site-report.html"') == 2


def test_without_a_history_nothing_changes(watched: Path, tmp_path: Path) -> None:
    before = render_fleet(overview_of(str(watched)))
    write_history(tmp_path / "elsewhere", {"still": "{}", "gone": "{}"})
    assert render_fleet(overview_of(str(watched), str(tmp_path / "elsewhere"))) == before
    write_history(tmp_path / "moved", HISTORY)
    assert render_fleet(overview_of(str(watched))) == before
    assert len(overview_of(str(watched), str(tmp_path / "moved")).changed) == 3
    with pytest.raises(ReadError, match="none: is not a history of 'retropole fleet check'"):
        overview_of(str(watched), str(tmp_path / "none"))


def test_what_is_damaged_of_a_history_is_named(watched: Path) -> None:
    write_history(watched / "history", HISTORY)
    (watched / "history" / "month=2026-01" / "damaged.parquet").write_bytes(b"PAR1")
    overview = overview_of(str(watched))
    assert len(overview.changed) == 3
    assert len(overview.damaged) == 1
    assert "damaged.parquet" in overview.damaged[0]


def test_the_map_leads_from_what_needs_action_to_its_report() -> None:
    here = {"latitude_rad": 0.9, "longitude_rad": 0.2}
    sites = (seen("fine", **here), seen("no", status="refused", codes=("ambiguous",), **here))
    html = render_fleet(of_sites(*sites), lambda site: f"{site.id}.html")
    (drawn,) = re.findall(r"<svg viewBox.*?</svg>", html[html.index('id="map"') :])[:1]
    assert re.findall(r'<a href="(.*?)" aria-label="(.*?)">', drawn) == [
        ("no.html", "no: refused, 10 mm at 30 m")
    ]


def test_each_reason_says_what_to_do(overview: Overview) -> None:
    known = {code: cells for code, *cells in rows_of(render_fleet(overview), "Sites by reason")}
    advice = explain("ambiguous")
    assert advice is not None
    assert known["ambiguous"][1] == re.sub("<[^>]*>", "", inline(" ".join(advice.advice)))
    assert "--retry --time-limit" in known["time_limit"][1]


def test_a_dataset_its_reports_and_its_page_may_be_urls(city: Path) -> None:
    import fsspec

    memory = fsspec.filesystem("memory")
    memory.put(f"{city}/", "/drawn/fleet", recursive=True)
    overview = overview_of("memory://drawn/fleet")
    assert msgspec.to_builtins(overview.sites) == msgspec.to_builtins(overview_of(str(city)).sites)
    first = overview.worst(1)[0].id
    memory.pipe_file(f"/drawn/reports/{first}/report.html", b"")
    write_fleet_report("memory://drawn/fleet.html", overview, "memory://drawn/reports")
    page = memory.cat_file("/drawn/fleet.html").decode()
    assert f'href="./reports/{first}/report.html"' in page
    write_fleet_report("memory://drawn/fleet.html", overview, "memory://elsewhere/reports")
    assert "/report.html" not in memory.cat_file("/drawn/fleet.html").decode()


def test_the_same_dataset_gives_the_same_page(city: Path, overview: Overview) -> None:
    assert render_fleet(overview_of(str(city))) == render_fleet(overview)


def test_what_others_wrote_stays_text() -> None:
    sites = [
        seen(HOSTILE, status="error", codes=(HOSTILE,), messages=(HOSTILE,), sigma_30m_m=None),
        seen(f"{HOSTILE}2", codes=(HOSTILE,), latitude_rad=0.1, longitude_rad=0.1),
    ]
    hostile = replace(
        of_sites(*sites), place=f"/{HOSTILE}", made_by={HOSTILE: 2}, hosts={HOSTILE: 1}
    )
    html = render_fleet(hostile, lambda site: HOSTILE)
    assert "\u2028" not in html
    page = Page(html)
    assert page.open == []
    assert [tag for tag, _ in page.tags].count("script") == 2
    # What steers a terminal or a line is escaped as text besides.
    assert page.text.count("</script><script>window.injected=1</script>") > 5


def test_without_answers_or_places_it_reports_it() -> None:
    page = Page(render_fleet(of_sites(seen("a", status="refused", sigma_30m_m=None))))
    assert "No site has a position" in page.text
    assert "No site has an answer" in page.text
    assert "all are ok" not in page.text.replace("No site has a reason: all are ok.", "")
    assert not [tag for tag, _ in page.tags if tag == "svg"]


@pytest.mark.full
def test_ten_thousand_sites_stay_small() -> None:
    rng = np.random.default_rng(1)
    sites = [
        seen(
            f"district-{k % 23}/post-{k:05d}",
            status="error" if k % 3 else "warn",
            codes=("unreadable",),
            messages=("x" * 300,) if k % 3 else (),
            latitude_rad=float(rng.uniform(0.9, 0.901)),
            longitude_rad=float(rng.uniform(0.2, 0.201)),
            sigma_30m_m=None if k % 3 else float(rng.uniform(0, 0.1)),
        )
        for k in range(10_000)
    ]
    html = render_fleet(of_sites(*sites))
    assert len(html.encode()) < MOST_BYTES
    assert html.count("<title>") == 1 + 10_000
    failed = sum(site.status == "error" for site in sites)
    assert f"{failed - MOST_FAILED:,} more are in the dataset" in html


def test_what_is_no_dataset_is_an_error(city: Path, tmp_path: Path) -> None:
    with pytest.raises(ReadError, match="is not a dataset of a fleet"):
        overview_of(str(tmp_path))
    row = made_up_row(names_in_first(1)[0], np.random.default_rng(0))
    for changes in (
        {"latitude_rad": 9.0},
        {"sigma_30m_m": float("nan")},
        {"status": "fine", "lidars": []},
    ):
        wrong: Row = msgspec.structs.replace(row, **changes)
        write_partition(str(tmp_path / "out"), "part-00.parquet", [wrong], [])
        with pytest.raises(ReadError, match=r"part-00\.parquet: damaged"):
            overview_of(str(tmp_path / "out"))


# --- the map ---


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
        assert 0 <= x <= report.WIDTH
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


def test_what_is_not_drawn_or_named_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report, "MOST_NAMED", 2)
    nowhere = msgspec.structs.replace(at("x", 1, 1), latitude_rad=None, longitude_rad=None)
    html = fleet_map([at("a", 1, 1), at("b", 1, 1.1, "error"), at("c", 1.1, 1.1), nowhere])
    assert set(places(html)) == {"a", "b"}
    assert "3 sites." in html
    assert "1 site of unknown position not drawn" in html
    assert "2 show their names" in html
    assert len(re.findall(r'<path d="M[\d]+ [\d]+h.01"/>', html)) == 1 + 1  # And of the legend.
    assert "svg" not in fleet_map([nowhere])
