"""The field test of two LiDARs, or of all of a site: by the distances between poles."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from ..base.datatypes import Placement, Scan
from ..base.errors import UsageError
from ..result import RunConfig
from ..result.certification import FieldTestDoc, field_test_document
from ..scene.scans import find_poles
from ..site import certification
from .inputs import CloudSource, Input, input_documents, read_placements
from .site_inputs import read_site


def certify(
    target: CloudSource | Sequence[CloudSource],
    source: CloudSource | Sequence[CloudSource],
    config: RunConfig,
    *,
    progress: Callable[[str], None] = lambda step: None,
    on_read: Callable[[Input], None] = lambda given: None,
) -> FieldTestDoc:
    """Test two LiDARs by their recordings of one placement of the poles or several.

    Parameters
    ----------
    target, source
        As `api.calibration.calibrate` takes them.
    config
        The options: radius, sensors, thresholds, and what is read.
    progress
        Called with the name of each step as it starts.
    on_read
        Called with each cloud once it is read.

    Raises
    ------
    UsageError, ReadError, MissingExtraError
        As `api.inputs.read_placements`.
    """
    progress("read")
    pairs = read_placements(target, source, config, progress, on_read)
    progress("extract")
    found = [
        Placement(_search(of_target, config.radius_m), _search(of_source, config.radius_m))
        for of_target, of_source in pairs
    ]
    progress("certify")
    test = certification.certify(found, radius=config.radius_m, radius_sigma=config.radius_sigma_m)
    return field_test_document(
        {("target", "source"): test},
        radius=config.radius_m,
        inputs=input_documents(given for pair in pairs for given in pair),
    )


def _search(given: Input, radius: float) -> Scan:
    return find_poles(given.cloud, sensor=given.sensor, threshold=given.threshold, radius=radius)


def certify_site(
    path: Path,
    *,
    progress: Callable[[str], None] = lambda step: None,
    on_read: Callable[[Input], None] = lambda given: None,
) -> FieldTestDoc:
    """Test every pair of LiDARs of a site file.

    Raises
    ------
    UsageError
        Where no two LiDARs recorded the same placement.
    ReadError, MissingExtraError
        As `api.site_inputs.read_site`.
    """
    read = read_site(path, progress=progress, on_read=on_read)
    lidars = read.site.lidars
    tests = {
        (lidars[a].name, lidars[b].name): test
        for (a, b), test in certification.certify_site(read.site, progress)
    }
    if not tests:
        raise UsageError(f"{path}: no two LiDARs recorded the same placement")
    return field_test_document(
        tests, radius=read.site.radius, inputs=list(read.documents().values())
    )
