"""Colours are told apart, those of the LiDARs also by those who do not see all of them."""

from __future__ import annotations

import re
from itertools import combinations

import numpy as np
import pytest

from tests.paths import PACKAGE

LEAST_DIFFERENCE = 29.0
"""ΔE (CIE 1976) between any two colours; 2.3 is just seen. The common palette of Okabe and Ito has
16 by the same measure."""

LEAST_CONTRAST = 3.0
"""Of a mark against its ground (WCAG 2.2, 1.4.11)."""

SEEN_BY = {
    "all": np.eye(3),
    # Machado, Oliveira and Fernandes 2009, severity 1, linear RGB.
    "protanope": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "deuteranope": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
    "tritanope": [
        [1.255528, -0.076749, -0.178779],
        [-0.078411, 0.930809, 0.147602],
        [0.004733, 0.691367, 0.303900],
    ],
}
XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])


def linear(colour: str) -> np.ndarray:
    c = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def lab(rgb: np.ndarray) -> np.ndarray:
    v = XYZ @ np.clip(rgb, 0, 1) / [0.9505, 1.0, 1.089]
    f = np.where(v > 0.008856, np.cbrt(v), 7.787 * v + 16 / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


STYLE = (PACKAGE / "report" / "assets" / "style.css").read_text()


def palettes() -> dict[str, list[str]]:
    found = re.findall(r"--lidar-\d: (#\w{6})", STYLE)
    assert found[8:16] == found[16:24]
    return {"light": found[:8], "dark": found[8:16]}


@pytest.mark.parametrize("theme", [0, 1, 2], ids=["light", "dark by system", "dark by button"])
def test_text_and_marks_stand_out(theme: int) -> None:
    """WCAG 2: 4.5 to 1 for text, 3 to 1 for what is drawn."""
    block = [b for b in re.findall(r"{([^{}]*)}", STYLE) if "--ground" in b][theme]
    colour = dict(re.findall(r"--([a-z0-9-]+): (#[0-9a-f]{6})", block))
    for front, back, least in (
        ("text", "ground", 4.5), ("text", "card", 4.5), ("soft", "card", 4.5),
        ("soft", "ground", 4.5), ("text", "press", 4.5), ("text", "warn-soft", 4.5),
        ("accent", "card", 4.5), ("accent", "ground", 4.5),
        ("ok", "card", 4.5), ("ok", "ok-soft", 4.5), ("warn", "card", 4.5),
        ("warn", "warn-soft", 4.5), ("refused", "card", 4.5), ("refused", "refused-soft", 4.5),
        ("denied", "view", 3.0), ("soft", "view", 4.5),
        *((f"lidar-{k}", "view", LEAST_CONTRAST) for k in range(8)),
    ):  # fmt: skip
        a, b = sorted(XYZ[1] @ linear(colour[name]) for name in (front, back))
        assert (b + 0.05) / (a + 0.05) >= least, (front, back)


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_any_two_differ_for_every_eye(theme: str) -> None:
    colours = palettes()[theme]
    assert len(set(colours)) == 8
    for matrix in SEEN_BY.values():
        seen = [lab(np.array(matrix) @ linear(colour)) for colour in colours]
        assert min(np.linalg.norm(a - b) for a, b in combinations(seen, 2)) > LEAST_DIFFERENCE
