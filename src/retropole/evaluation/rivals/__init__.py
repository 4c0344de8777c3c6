"""Other ways to the same transform, to compare with our own.

Every rival is a function ``(target, source, rng) -> PoseEstimate`` that raises `Refusal` where it
has no answer. None of them uses the poles. To add one, write its module and add its line to
`RIVALS`: the command line, the comparison and the benchmarks take it from there. Importing the
registry loads no rival.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    import numpy as np

    from ...base.datatypes import PointCloud, PoseEstimate

    Method = Callable[[PointCloud, PointCloud, np.random.Generator], PoseEstimate]


class Extra(NamedTuple):
    """What a rival needs beyond the core.

    Attributes
    ----------
    name
        Of the extra of this package that installs it.
    module
        Its module: where that is found, the extra is installed.
    """

    name: str
    module: str


class Rival(NamedTuple):
    """One line of the registry.

    Attributes
    ----------
    title
        What it is, for a person.
    function
        Where it is, ``module:function`` within this folder.
    extra
        What it needs beyond the core; None where it needs nothing.
    """

    title: str
    function: str
    extra: Extra | None = None


RIVALS: dict[str, Rival] = {
    "planes": Rival("planar surfaces (Jiao et al. 2019)", "planes:planar_surfaces"),
    "icp": Rival("point-to-point ICP from the identity", "registration:icp"),
    "gicp": Rival("plane-to-plane ICP from the identity", "registration:gicp"),
    "kiss": Rival("KISS-Matcher, then GICP", "kiss:kiss_matcher", Extra("kiss", "kiss_matcher")),
    "fpfh": Rival("FPFH with RANSAC, then GICP", "fpfh:fpfh_ransac", Extra("open3d", "open3d")),
}
"""Every rival by its name."""

OURS = {"poles": "retropole, the poles alone", "poles+scene": "retropole, poles and scene"}
"""Our own methods, and what each is."""

ALL_METHODS: tuple[str, ...] = (*OURS, *RIVALS)
"""Our own, then the rivals: all that `comparison.compare` runs."""


def load_rival(name: str) -> Method:
    """Import a rival of `RIVALS`; what it needs beyond the core is imported when it is called."""
    module, function = RIVALS[name].function.split(":")
    method: Method = getattr(import_module(f".{module}", __name__), function)
    return method


def missing_extra(name: str) -> str | None:
    """Name the extra that a rival of `RIVALS` lacks; None where it can run."""
    extra = RIVALS[name].extra
    return None if extra is None or find_spec(extra.module) is not None else extra.name
