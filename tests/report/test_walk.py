"""The walk with a carried pole on the page: its way, its clocks, and nothing where poles stood."""

import numpy as np
from msgspec.structs import replace

from retropole.base.carried import CarriedWalk
from retropole.base.datatypes import Placement, PointCloud, Scan
from retropole.report import render_report
from retropole.report.text import describe_result
from retropole.result import ResultDoc, encode
from retropole.result.decoding import decode
from tests.report.site.made_up import document_of, made_up_site
from tests.results import result_of

NOTHING = Placement(*2 * (Scan(PointCloud(np.ones((1, 3)), np.ones(1))),))


def document() -> ResultDoc:
    around = np.linspace(0, 6, 50)
    path = np.stack([around, 4 + np.cos(around), np.sin(around), 0 * around], axis=1)
    found = CarriedWalk(
        clock_offset_s=-0.25, clock_sigma_s=2e-4, clock_drift=0.0, middle_s=3.0, seconds=6.0,
        sweeps=(60, 60), found=(58, 60), along_m=1.0, across_m=0.7, lean_rad=0.2, left_out=0.01,
        range_scale=(1.0, 1.2), edge_jitter_rad=(0.0, 1e-3),
        clock_windows=[[1.0, 1e-3, 5e-4], [5.0, -1e-3, 5e-4]], up=np.array([0.0, 0.0, 1.0]),
        path=path.tolist(),
    )  # fmt: skip
    return replace(result_of("ok", [], np.eye(4), 1e-6 * np.eye(6)), walk=found)


def test_a_page_shows_the_walk() -> None:
    page = render_report(document(), [NOTHING])
    assert 'id="walk"' in page
    assert "t_target = t_source − 0.250000 s" in page
    assert page.count('class="line when-') > 10
    assert 'id="walk"' not in render_report(result_of("ok", [], np.eye(4)), [NOTHING])


def test_a_page_shows_the_walk_of_a_site() -> None:
    site = document_of(made_up_site(lidars=3, placements=1, count=30))
    pair = document()
    assert pair.walk is not None
    of_two = pair.walk.of_site
    third = replace(of_two.lidars[1], clock_offset_s=0.5)
    found = replace(of_two, lidars=[*of_two.lidars, third])
    page = render_report(replace(site, walk=found))
    names = [lidar.name for lidar in site.lidars]
    assert f"t_{names[0]} = t_{names[2]} + 0.500000 s" in page
    assert "Seen by each" in page
    assert page.count('id="clocks-said-') == 2
    words = describe_result(replace(site, walk=found), ["site-result.json"])
    assert f"t_{names[0]} = t_{names[1]} − 0.250000 s" in " ".join(words.split())
    assert "loop" not in words


def test_a_terminal_says_how_clocks_differ() -> None:
    words = describe_result(document(), ["result.json"])
    assert "clocks: t_target = t_source − 0.250000 s, 1 sigma 0.2 ms" in words


def test_a_document_of_a_walk_reads_back() -> None:
    assert decode(encode(document())) == document()
