"""The result of a site on a terminal."""

import msgspec
import numpy as np
import pytest

from retropole.base.bounded import Status
from retropole.report.layout import LINES, WIDTH
from retropole.report.site_text import describe_site, pose_rows
from retropole.result import ReasonDoc
from retropole.result.site import SiteDoc
from tests.report.site.made_up import document_of, made_up_site

WRITTEN = ("out/site-result.json", "out/site-report.html")


def fits(words: str) -> bool:
    lines = words.split("\n")
    return len(lines) <= LINES and max(map(len, lines)) <= WIDTH


@pytest.mark.parametrize("status", ["ok", "warn", "refused"])
@pytest.mark.parametrize(("lidars", "placements"), [(2, 1), (3, 2), (8, 4)])
def test_the_verdict_stands_first_on_one_screen(
    status: Status, lidars: int, placements: int
) -> None:
    document = document_of(made_up_site(status, lidars=lidars, placements=placements))
    words = describe_site(document, WRITTEN, {"next": "retropole export out"})
    assert words.startswith(f"verdict: {status}\n")
    assert fits(words)
    for lidar in document.lidars:
        assert lidar.name in words
    assert ("next: " in words) == (status != "refused")
    for reason in document.reasons:
        assert f"  {reason.code}: " in words


def many(document: SiteDoc, count: int) -> SiteDoc:
    """Give a document many LiDARs of long names, and many reasons."""
    first = document.lidars[1]
    lidars = [msgspec.structs.replace(first, name=f"lidar-{k}" + 50 * "x") for k in range(count)]
    reasons = [ReasonDoc("few_points", f"pole {k} " + 40 * "has few points ", {}) for k in range(9)]
    return msgspec.structs.replace(
        document, lidars=lidars, reasons=reasons, found=count * document.found[:1]
    )


@pytest.mark.parametrize("status", ["warn", "refused"])
def test_many_lidars_and_reasons_fit_too(status: Status) -> None:
    words = describe_site(many(document_of(made_up_site(status)), 60), WRITTEN)
    assert fits(words)
    assert "more; -v lists them" in words
    assert "what to do about each: -v, or site-report.html" in words


def test_large_coordinates_are_the_frames_own() -> None:
    document = document_of(made_up_site(surveyed=True))
    frame = msgspec.structs.replace(document.frame, offset=np.array([500_000.0, 5_700_000.0, 0.0]))
    document = msgspec.structs.replace(document, frame=frame)
    row = pose_rows(document)[0]
    assert (row.x, row.y, row.z) == ("500000.000", "5700000.000", "0.000")
    words = describe_site(document, WRITTEN)
    assert "5700000.000" in words
    assert fits(words)


def test_what_stands_out_is_named() -> None:
    warned = describe_site(document_of(made_up_site("warn")), WRITTEN)
    assert "beyond w 3.29: pole 2 of morning as mast-b sees it (w 6.3)" in warned
    words = " ".join(describe_site(document_of(made_up_site("ok")), WRITTEN).split())
    assert "none beyond w 3.29" in words
    assert "unchecked: 1 of the tests would not show an error" in words
    assert "without placement after lunch" in words


def test_groups_that_nothing_links_are_named() -> None:
    words = describe_site(document_of(made_up_site("refused", lidars=3)), WRITTEN)
    assert "not linked with each other: mast-a, mast-b | gate" in words


def test_verbose_lists_everything() -> None:
    document = document_of(made_up_site("warn"))
    words = describe_site(document, WRITTEN, verbose=True)
    for test in document.tests:
        assert test.name in words
    assert words.count("/data/quay/") == len(document.inputs)
    assert "mast-a – mast-b" in words


def test_names_steer_no_terminal() -> None:
    document = document_of(made_up_site())
    lidar = msgspec.structs.replace(document.lidars[0], name="\x1b[31mred")
    document = msgspec.structs.replace(document, lidars=[lidar, *document.lidars[1:]])
    assert "\x1b" not in describe_site(document, WRITTEN)
