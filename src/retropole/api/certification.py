"""The field test of two LiDARs, or of all of a site: by the distances between poles."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..base.datatypes import Placement
from ..base.errors import UsageError
from ..checking import certification
from ..result import RunConfig
from ..result.certification import FieldTestDoc, field_test_document
from .inputs import SILENT, CloudSource, Listener, input_documents, read_placements
from .site_inputs import read_site


def certify(
    target: CloudSource | Sequence[CloudSource],
    source: CloudSource | Sequence[CloudSource],
    config: RunConfig,
    listener: Listener = SILENT,
) -> FieldTestDoc:
    """Test two LiDARs by their recordings of one placement of the poles or several.

    Parameters
    ----------
    target, source
        As `api.calibration.calibrate` takes them.
    config
        The options: radius, sensors, thresholds, and what is read.
    listener
        Receives each step as it starts, and each cloud once it is read.

    Raises
    ------
    UsageError, ReadError, MissingExtraError
        As `api.inputs.read_placements`.
    """
    listener.progress("read")
    pairs = read_placements(target, source, config, listener)
    listener.progress("extract")
    r = config.radius_m
    found = [Placement(pair.target.search(r), pair.source.search(r)) for pair in pairs]
    listener.progress("certify")
    test = certification.certify(found, radius=config.radius_m, radius_sigma=config.radius_sigma_m)
    return field_test_document(
        {("target", "source"): test},
        lidars=("target", "source"),
        radius=config.radius_m,
        inputs=input_documents(given for pair in pairs for given in pair),
    )


def certify_site(path: Path, listener: Listener = SILENT) -> FieldTestDoc:
    """Test every pair of LiDARs of a site file.

    Raises
    ------
    UsageError
        If no two LiDARs recorded the same placement, or a pole was carried.
    ReadError, MissingExtraError
        As `api.site_inputs.read_site`.
    """
    read = read_site(path, listener)
    if read.site.carried:
        raise UsageError(f"{path}: a field test needs fixed poles; here a pole was carried")
    lidars = read.site.lidars
    tests = {
        (lidars[a].name, lidars[b].name): test
        for (a, b), test in certification.certify_site(read.site, listener.progress)
    }
    if not tests:
        raise UsageError(f"{path}: no two LiDARs recorded the same placement")
    return field_test_document(
        tests,
        lidars=[lidar.name for lidar in lidars],
        radius=read.site.radius,
        inputs=input_documents(read.inputs.values()),
        site=read.site.name,
        serials={lidar.name: lidar.serial for lidar in lidars if lidar.serial},
    )
