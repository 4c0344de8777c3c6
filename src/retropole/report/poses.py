"""The pose of every LiDAR: to read, to copy, how certain it is, and what its error is made of."""

from __future__ import annotations

import re

import numpy as np

from ..base import se3
from ..base.datatypes import Array
from ..base.errors import RetropoleError
from ..export import FORMATS, TREE_FORMATS, export_lines
from ..export.documents import found_in_result
from ..export.transform import NO_LIDARS
from ..export.tree import tree_of
from ..result import verdict_line
from ..result.site import SiteDoc
from . import listings
from .certainty import number
from .error_curve import ErrorCurve, curve_figure
from .page import EMPTY, Html, fill, folded, join, listed
from .subject import LIDARS, Subject, colour_class, recorded_by
from .uncertainty import uncertainty

FRAMES = ("lidar_target", "lidar_source")
"""Frames of a pair in the lines to copy: the page has those of the recordings in their place, or
what the reader types."""

OF_A_LIDAR = f"(?!(.*/)?({'|'.join(sorted(NO_LIDARS))})$).*"
"""What may be typed there."""

UNFOLDED = ("matrix", "ros2")
"""Formats that are shown at once; the page unfolds the others."""

WHOLE = ("launch", "urdf", "yaml")
"""Formats of a whole site that are ready to copy; `retropole export` writes the others."""


def transform(subject: Subject, curve: ErrorCurve | None) -> Html:
    """Show the transform of a pair, its lines to copy, and its error over the distance."""
    pair = subject.pair
    if pair is None or pair.T_target_source is None:
        return EMPTY
    target, source = recorded_by(pair)
    return fill(
        "transform",
        target=target,
        source=source,
        matrix=transform_matrix(pair.T_target_source),
        parts=pose_parts(pair.T_target_source),
        curve=curve_figure(curve),
        copies=_copies(subject, 1),
    )


def poses(subject: Subject, curve: ErrorCurve | None = None) -> Html:
    """Show every pose of a site, its error, and lines to copy: a summary, and each folded."""
    site = subject.site
    if not subject.answered or subject.pair is not None:
        return EMPTY
    offset = site.frame.offset
    lidars = (
        fill("lidar", colour=colour_class(k), name=site.lidars[k].name, body=_pose(subject, k))
        for k in range(len(site.lidars))
    )
    return fill(
        "poses",
        named=site.frame.name,
        offset=fill("offset", at=", ".join(f"{v:.3f}" for v in offset)) if any(offset) else "",
        table=listed(listings.poses(site)),
        curve=curve_figure(curve),
        whole=_copies_of_site(site),
        lidars=join(lidars),
    )


def _copies_of_site(site: SiteDoc) -> Html:
    """Show the frames of a whole site in formats that take all of them, folded."""
    try:
        tree = tree_of(site)
    except RetropoleError:
        # A name that no frame can have, or a projection that cannot be computed here.
        return EMPTY
    formats = ((key, TREE_FORMATS[key]) for key in WHOLE)
    copies = join(
        fill("copy", key=key, title=each.title, whose=" of all", text=each.write(tree).strip())
        for key, each in formats
    )
    return fill("copies-of-site", body=folded("All LiDARs, to copy", copies))


def _pose(subject: Subject, k: int) -> Html:
    """Show one pose of a site as matrix, translation, quaternion and angles, and all about it."""
    lidar = subject.site.lidars[k]
    T = np.array(lidar.T_site_lidar)
    said = (
        "" if lidar.sensor == "auto" else lidar.sensor,
        f"serial number {lidar.serial}" if lidar.serial else "",
        "" if lidar.fitness is None else lidar.fitness.words,
    )
    about = ", ".join(each for each in said if each)
    return fill(
        "pose",
        about=fill("p", text=about) if about else "",
        matrix=transform_matrix(T, f"T_site_lidar of {lidar.name}"),
        parts=pose_parts(T),
        copies=_copies(subject, k),
        uncertainty=uncertainty(subject, k),
    )


def transform_matrix(T: Array, name: str = "T_target_source") -> Html:
    """Lay out a transform (4, 4) as a matrix under its name."""
    rows = (join(fill("td", kind=EMPTY, text=f"{v:.6f}") for v in row) for row in T)
    return fill("matrix", name=name, rows=join(fill("row", cells=cells) for cells in rows))


def pose_parts(T: Array) -> Html:
    """Write a transform (4, 4) as translation, quaternion and angles."""
    angles = np.degrees(se3.rpy_from_rotation(T[:3, :3]))
    parts = (
        ("translation", "x y z", T[:3, 3], 4, " m"),
        ("quaternion", "x y z w", se3.quaternion_xyzw(T[:3, :3]), 6, ""),
        ("angles", "roll pitch yaw", angles, 3, "°"),
    )
    named = (
        fill(
            "pose-part",
            name=part,
            values=join(
                fill("named", name=name, value=number(value, digits, unit=unit))
                for name, value in zip(names.split(), values, strict=True)
            ),
        )
        for part, names, values, digits, unit in parts
    )
    return fill("pose-parts", body=join(named))


def _copies(subject: Subject, k: int) -> Html:
    """Show a pose in every format, with a button that copies it and says aloud whose it is."""
    T = np.array(subject.site.lidars[k].T_site_lidar)
    names = [lidar.name for lidar in subject.site.lidars]
    parent, fields = "site" if "site" not in names else "site_frame", EMPTY
    if subject.pair is not None:
        found = found_in_result(subject.pair)
        fields = join(
            fill(
                "frame",
                lidar=lidar,
                frame=frame,
                # The page takes no other signs.
                recorded=name if re.fullmatch(r"[\w./-]+", name or "", re.ASCII) else frame,
                pattern=OF_A_LIDAR,
            )
            for lidar, frame, name in zip(LIDARS, FRAMES, found[:2], strict=True)
        )
        fields = fill("frames", body=fields)
    verdict = verdict_line(subject.site.status, subject.site.reasons)
    try:
        lines = export_lines(T, *(FRAMES if subject.pair else (parent, names[k])), verdict)
    except RetropoleError:
        # A name that no frame can have: another program reads the pose all the same.
        lines = export_lines(T, parent, f"lidar_{k}", verdict)
    whose = f" of {names[k]}" if subject.pair is None else ""
    shown, more = (
        join(
            fill("copy", key=key, title=FORMATS[key].title, whose=whose, text=text.strip())
            for key, text in lines.items()
            if (key in UNFOLDED) is wanted
        )
        for wanted in (True, False)
    )
    # The names of the frames change what is shown at once, too.
    return fill("copies", fields=fields, shown=shown, more=folded("More formats", more))
