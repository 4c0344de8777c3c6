"""The poses: every one can be read, copied and doubted."""

from __future__ import annotations

import re
from html import unescape

import msgspec
import numpy as np

from retropole.export import FORMATS
from retropole.report.site.poses import poses
from tests.report.made_up import HOSTILE, Page
from tests.report.site.made_up import document_of, made_up_site

DOCUMENT = document_of(made_up_site(lidars=4, placements=2, count=10))


def test_what_is_copied_is_the_pose() -> None:
    found = re.findall(r'data-export="matrix">(.*?)</pre>', poses(DOCUMENT), re.DOTALL)
    assert len(found) == 4
    for text, lidar in zip(found, DOCUMENT.lidars, strict=True):
        (read,) = FORMATS["matrix"].read(unescape(text).encode())
        assert np.allclose(read.pose(), np.array(lidar.T_site_lidar))
        assert (read.parent, read.child) == ("site", lidar.name)


def test_each_pose_has_its_certainty_and_what_it_is_made_of() -> None:
    html = poses(DOCUMENT)
    text = Page(html).text
    assert text.count("What the error is made of") == 3
    assert "Its frame is that of the site: its pose has no error." in text
    assert "range offset of gate" in text
    assert "-0.000" not in text


def test_the_offset_of_large_coordinates_is_said() -> None:
    frame = msgspec.structs.replace(DOCUMENT.frame, offset=np.array([565_000.0, 5_934_000.0, 0.0]))
    far = msgspec.structs.replace(DOCUMENT, frame=frame)
    assert "Add (565000.000, 5934000.000, 0.000) m" in poses(far)
    assert "Add (" not in poses(DOCUMENT)


def test_a_name_that_no_frame_can_have_is_shown_and_not_copied() -> None:
    lidars = list(DOCUMENT.lidars)
    lidars[1] = msgspec.structs.replace(lidars[1], name=f"a\nb{HOSTILE}")
    lidars[2] = msgspec.structs.replace(lidars[2], name="site")
    html = poses(msgspec.structs.replace(DOCUMENT, lidars=lidars))
    page = Page(html)
    assert page.open == []
    assert "lidar_1" in page.text
    assert "site_frame" in page.text


def test_a_refused_site_has_none() -> None:
    assert poses(document_of(made_up_site("refused", lidars=3, count=10))) == ""
