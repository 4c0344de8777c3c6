"""Reading the result document of a site that may have been edited, cut short or made elsewhere.

Whoever holds one that was decoded relies on it: every number is finite, rotations rotate,
covariances are covariances that agree with each other, and every index finds what it points to.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ..base.errors import ReadError
from . import COVARIANCE_ORDER
from .decoding import check_covariance, parsed
from .site import SITE_COVARIANCE_FRAME, SiteDoc, joint_order

BLOCKS_AGREE = 1e-6
"""A LiDAR's covariance is its block of the joint one, but for this part of the largest number."""


def decode_site(data: bytes) -> SiteDoc:
    """Read the result document of a site.

    Raises
    ------
    ReadError
        Where it is not one; names the field, and says what is wrong with it.
    """
    document = parsed(data, SiteDoc, "result document of a site")
    _check_verdict(document)
    _check_indices(document)
    _check_joint(document)
    return document


def _check_verdict(document: SiteDoc) -> None:
    """Hold the status, the names and what must be there against each other."""
    names = [lidar.name for lidar in document.lidars]
    if len(set(names)) < len(names):
        raise ReadError("lidars: two have the same name")
    if document.covariance_order != COVARIANCE_ORDER:
        raise ReadError(f"covariance_order: expected {' '.join(COVARIANCE_ORDER)}")
    if document.covariance_frame != SITE_COVARIANCE_FRAME:
        raise ReadError(f"covariance_frame: expected {SITE_COVARIANCE_FRAME}")
    if document.joint_order != joint_order(names):
        raise ReadError("joint_order: expected six rows for each LiDAR, in their order")
    answered = document.status != "refused"
    for k, lidar in enumerate(document.lidars):
        for name in ("T_site_lidar", "covariance"):
            if answered != (getattr(lidar, name) is not None):
                raise ReadError(f"lidars[{k}].{name}: {_there(answered, document.status)}")
    if answered != (document.joint_covariance is not None):
        raise ReadError(f"joint_covariance: {_there(answered, document.status)}")


def _there(answered: bool, status: str) -> str:
    return f"{'none' if answered else 'there is one'}, and the status is {status}"


def _check_indices(document: SiteDoc) -> None:
    """Let every index find a LiDAR, a placement or a pole."""
    counts = {
        "lidar": len(document.lidars),
        "placement": len(document.placements),
        "pole": len(document.poles),
        "surveyed": len(document.surveyed_poles),
    }
    for name, of, indices in _indices(document):
        beyond = [index for index in indices if index is not None and index >= counts[of]]
        if beyond:
            raise ReadError(f"{name}: {beyond[0]}, there are {counts[of]}")
    for k, pair in enumerate(document.pairs):
        if pair.lidars[0] >= pair.lidars[1]:
            raise ReadError(f"pairs[{k}].lidars: expected two, the lower first")
    grouped = [index for group in document.groups for index in group]
    if grouped and sorted(grouped) != list(range(len(document.lidars))):
        raise ReadError("groups: every LiDAR is in one group")
    rows = {"found": (len(document.found), len(document.lidars))} if document.found else {}
    rows |= {
        f"found[{k}]": (len(row), len(document.placements)) for k, row in enumerate(document.found)
    }
    for name, (count, expected) in rows.items():
        if count != expected:
            raise ReadError(f"{name}: {count} entries, expected {expected}")
    recorded = {(each.lidar, each.placement) for each in document.inputs}
    if len(recorded) < len(document.inputs):
        raise ReadError("inputs: two of the same LiDAR and placement")


def _indices(document: SiteDoc) -> Iterator[tuple[str, str, Sequence[int | None]]]:
    """Every index: the name of its field, of what it is one, and the indices."""
    yield "reference", "lidar", (document.reference,)
    for k, group in enumerate(document.groups):
        yield f"groups[{k}]", "lidar", group
    for k, pole in enumerate(document.poles):
        yield f"poles[{k}].placement", "placement", (pole.placement,)
        yield f"poles[{k}].seen_by", "lidar", pole.seen_by
        yield f"poles[{k}].surveyed", "surveyed", (pole.surveyed,)
    for k, pair in enumerate(document.pairs):
        yield f"pairs[{k}].lidars", "lidar", pair.lidars
    for k, loop in enumerate(document.loops):
        yield f"loops[{k}].lidars", "lidar", loop.lidars
    for k, test in enumerate(document.tests):
        yield f"tests[{k}].lidar", "lidar", (test.lidar,)
        yield f"tests[{k}].placement", "placement", (test.placement,)
        yield f"tests[{k}].pole", "pole", (test.pole,)
    for k, without in enumerate(document.without):
        yield f"without[{k}].placement", "placement", (without.placement,)
        yield f"without[{k}].lidar", "lidar", (without.lidar,)
    for k, surveyed in enumerate(document.surveyed_poles):
        yield f"surveyed_poles[{k}].placement", "placement", (surveyed.placement,)
    for k, point in enumerate(document.control_points):
        yield f"control_points[{k}].seen", "lidar", [each.lidar for each in point.seen]
    for k, source in enumerate(document.inputs):
        yield f"inputs[{k}].lidar", "lidar", (source.lidar,)
        yield f"inputs[{k}].placement", "placement", (source.placement,)


def _check_joint(document: SiteDoc) -> None:
    """Check the joint covariance, and that it holds those of the LiDARs."""
    joint = document.joint_covariance
    if joint is None:
        return
    size = 6 * len(document.lidars)
    if joint.shape != (size, size):
        raise ReadError(f"joint_covariance: expected {size} rows of {size} numbers")
    check_covariance("joint_covariance", joint, is_part=True)
    for k, lidar in enumerate(document.lidars):
        block = joint[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]
        assert lidar.covariance is not None
        if np.abs(lidar.covariance - block).max() > BLOCKS_AGREE * np.abs(block).max():
            raise ReadError(f"lidars[{k}].covariance: not its block of joint_covariance")
