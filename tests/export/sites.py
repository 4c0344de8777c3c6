"""Result documents of made-up sites in several frames."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from retropole.base import world
from retropole.base.description import Frame
from retropole.result.site import SiteDoc
from tests.report.site.made_up import document_of, made_up_site

UTM = 25832
SURVEYED = np.array([[691_607.25, 5_334_765.5, 512.0], [691_637.5, 5_334_790.25, 513.0]])
LIDARS = 3


def with_pyproj() -> Any:
    return pytest.importorskip("pyproj", reason="needs pip install 'retropole[world]'")


@cache
def free() -> SiteDoc:
    """A site whose frame is that of its first LiDAR."""
    return document_of(made_up_site("ok", lidars=LIDARS, placements=2, count=20))


@cache
def refused() -> SiteDoc:
    return document_of(made_up_site("refused", lidars=LIDARS, placements=2, count=20))


def surveyed(frame: Frame | None = None) -> SiteDoc:
    """A surveyed site, in an east-north-up frame unless another is given."""
    made = made_up_site("ok", lidars=LIDARS, placements=2, count=20, surveyed=True)
    return document_of(
        made if frame is None else replace(made, site=replace(made.site, frame=frame))
    )


def on_plan() -> SiteDoc:
    """A site with large coordinates of a plan that is nowhere on earth."""
    return surveyed(Frame("site plan", surveyed=True, offset=np.array([4e5, 5.7e6, 100.25])))


def in_utm() -> SiteDoc:
    with_pyproj()
    return surveyed(world.tangent_frame(UTM, SURVEYED))
