"""The methods that can be compared, by name; nothing is loaded to list them."""

from __future__ import annotations

from importlib.util import find_spec
from typing import NamedTuple


class Rival(NamedTuple):
    """Another method.

    Attributes
    ----------
    title
        What it is, for a person.
    extra
        The extra of this package that installs what it needs; None if it needs nothing.
    module
        What that extra installs.
    """

    title: str
    extra: str | None = None
    module: str = ""


RIVALS = {
    "icp": Rival("point-to-point ICP from the identity"),
    "gicp": Rival("plane-to-plane ICP from the identity"),
    "kiss": Rival("KISS-Matcher, then GICP", "kiss", "kiss_matcher"),
    "fpfh": Rival("FPFH with RANSAC, then GICP", "open3d", "open3d"),
}
"""Every rival by its name; `rivals.FUNCTIONS` runs them."""

OURS = {"poles": "retropole, the poles alone", "poles+scene": "retropole, poles and scene"}
"""Our methods, and what each is."""

ALL_METHODS: tuple[str, ...] = (*OURS, *RIVALS)
"""Ours, then the rivals: all that `comparison.compare` runs."""


def missing_extra(name: str) -> str | None:
    """Name the extra that a rival of `RIVALS` lacks; None if it can run."""
    _, extra, module = RIVALS[name]
    return None if extra is None or find_spec(module) is not None else extra
