"""From a result document to a row of a dataset, and back."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from typing import Any

import msgspec

from ..api import Array
from ..result import ResultDoc, encode
from ..result.decoding import decode, decode_site
from ..result.site import LidarDoc, SiteDoc
from .dataset import AT_RANGE, InputEntry, LidarEntry
from .sites import FleetSite, Kind


def answered(
    site: FleetSite, document: ResultDoc | SiteDoc, inputs: Sequence[InputEntry]
) -> dict[str, Any]:
    """Give the columns of a row that follow from a result.

    Parameters
    ----------
    site
        What was calibrated.
    document
        Its result.
    inputs
        Its recordings, in the order of the document.
    """
    lidars, frame = _lidars(document), "target"
    latitude, longitude = site.latitude, site.longitude
    if isinstance(document, SiteDoc):
        frame, geodetic = document.frame.name, document.frame.geodetic
        if latitude is None and geodetic is not None:
            latitude, longitude = geodetic.latitude_rad, geodetic.longitude_rad
    errors = chain.from_iterable(lidar.predicted_error for lidar in lidars)
    at_range = [each.sigma_m for each in errors if each.range_m == AT_RANGE]
    return {
        "status": document.status,
        "codes": [reason.code for reason in document.reasons],
        "messages": [reason.message for reason in document.reasons],
        "inputs": [
            msgspec.structs.replace(entry, sensor=read.sensor, points=read.points)
            for entry, read in zip(inputs, document.inputs, strict=True)
        ],
        "latitude_rad": latitude,
        "longitude_rad": longitude,
        "frame": frame if lidars else None,
        "lidars": lidars,
        "sigma_30m_m": max(at_range, default=None),
        "document": encode(timeless(document)).decode(),
    }


def timeless(document: ResultDoc | SiteDoc) -> ResultDoc | SiteDoc:
    """Leave out when a result was made, and how long it took."""
    return msgspec.structs.replace(document, created="", seconds={})


def document_of(text: str, kind: Kind) -> ResultDoc | SiteDoc:
    """Read the result document of a row.

    Raises
    ------
    ReadError
        Where it is none.
    """
    return decode(text.encode()) if kind == "pair" else decode_site(text.encode())


def _lidars(document: ResultDoc | SiteDoc) -> list[LidarEntry]:
    """Give the pose of the source in the frame of the target, or of every LiDAR in the site's.

    None where refused.
    """
    poses: list[tuple[str, str, Array | None, ResultDoc | LidarDoc]]
    if isinstance(document, SiteDoc):
        poses = [(each.name, each.sensor, each.T_site_lidar, each) for each in document.lidars]
    else:
        poses = [("source", document.inputs[1].sensor, document.T_target_source, document)]
    return [
        LidarEntry(
            name=name,
            sensor=sensor,
            T=T.ravel().tolist(),
            covariance=of.covariance.ravel().tolist(),
            predicted_error=list(of.predicted_error or ()),
            budget=list(of.budget or ()),
        )
        for name, sensor, T, of in poses
        if T is not None and of.covariance is not None
    ]
