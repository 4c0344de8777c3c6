"""From a site file to a site: the recordings are read, and coordinates counted from nearby."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from msgspec import structs

from ..base.datatypes import Array
from ..base.description import (
    ControlPoint,
    Frame,
    Geodetic,
    Sighting,
    Site,
    SiteLidar,
    SurveyedPole,
    Up,
)
from ..base.errors import ReadError, Refusal, UsageError, naming, quoting
from ..base.files import path_in_text
from ..base.projection import projected
from ..base.quantities import error as length
from ..base.quantities import step_of
from ..base.se3 import FARTHEST
from ..base.sensors import sensor_or_auto
from ..base.uncertainty.purpose import Need
from ..base.world import in_metres
from ..io import sha256_of
from ..io.fields import USUAL, Wanted
from ..io.survey import read_survey
from ..result.site import RecordingDoc, SiteConfig, recording_document
from .inputs import SILENT, Input, Listener, input_documents, read_input, refuse_repeated
from .site_file import (
    LARGEST_SIGMA,
    LEAST_SIGMA,
    SITE_FILE,
    LidarTable,
    SiteFile,
    read_site_file,
)

OFFSET_STEP = 100.0
"""The offset of large coordinates is a multiple of this, metres: a site that is surveyed about an
origin of its own has none."""

LARGEST_SITE = 10_000.0
"""What is surveyed lies this near to its median, metres: a digit too many or left out, or east and
north swapped, puts a point further off."""


@dataclass(frozen=True, eq=False)
class SiteInputs:
    """A site, and what it was made of.

    Attributes
    ----------
    site
        LiDARs with their clouds, and what was surveyed.
    inputs
        What was read, by the indices of the LiDAR and of the placement.
    config
        How it was read.
    """

    site: Site
    inputs: Mapping[tuple[int, int], Input]
    config: SiteConfig

    def documents(self) -> list[RecordingDoc]:
        """Give the entries of the recordings in the result document; each file is hashed once."""
        documents = input_documents(self.inputs.values())
        return [
            recording_document(document, *at, given.how)
            for document, (at, given) in zip(documents, self.inputs.items(), strict=True)
        ]


def site_file_in(path: Path) -> Path:
    """Find the site file in a folder; a file is returned unchanged.

    Raises
    ------
    ReadError
        If it is not there, and its folder is; names the command that writes one.
    """
    if path.is_dir():
        path = path / SITE_FILE
    if not path.exists() and path.parent.is_dir():
        raise ReadError(
            f"{path.parent}: has no {path.name}; 'retropole site init {path.parent}' writes "
            f"{SITE_FILE} from the recordings in it"
        )
    return path


def read_site(path: Path, listener: Listener = SILENT) -> SiteInputs:
    """Read a site file and all its recordings.

    Parameters
    ----------
    path
        Of the site file, or of the folder of ``site.toml``; the paths in it count from its
        folder.
    listener
        Told of each step as it starts, and of each cloud once it is read.

    Raises
    ------
    ReadError
        If the file or a recording cannot be read; names the file, the LiDAR and the placement.
    MissingExtraError
        If a recording needs an extra, or projected coordinates do.
    """
    path = site_file_in(path)
    file = with_survey(read_site_file(path), path)
    # What can be reported now is reported before recordings are read: that takes long.
    if file.reference.epsg is not None:
        with naming(f"{path}: reference, epsg", is_said_there=True):
            projected(file.reference.epsg)
    wanted = []
    for k, lidar in enumerate(file.lidar):
        for n, recording in enumerate(lidar.recordings):
            if recording and not (path.parent / recording).exists():
                place = path.parent / recording
                raise ReadError(f"{_where(file, path, k, n)}: {place}: no such file")
            if recording:
                wanted.append((k, n))
    inputs: dict[tuple[int, int], Input] = {}
    for count, at in enumerate(wanted, 1):
        listener.progress(step_of("read", count, len(wanted)))
        inputs[at] = read_of(file, path, listener, *at)
    with naming(path, is_said_there=True):
        site = in_metres(site_of(file, inputs))
    config = SiteConfig(
        site_file=path_in_text(path),
        site_sha256=sha256_of(str(path)),
        max_points=file.max_points,
        carried=file.carried,
    )
    return SiteInputs(site, inputs, config)


def with_survey(file: SiteFile, path: Path) -> SiteFile:
    """Insert the coordinates, and 1 σ of each, of the survey points that a site file names.

    A `sigma_m` that the site file gives goes before that of the survey.

    Parameters
    ----------
    file, path
        The site file, and where it is: the survey counts from its folder.

    Raises
    ------
    ReadError
        As `io.survey.read_survey`, and if the accuracy of a point is not stated.
    """
    if file.survey is None:
        return file
    place = path.parent / file.survey
    named = [name for pole in file.surveyed_pole for name in (pole.foot, pole.top) if name]
    named += [point.at for point in file.control_point if point.at]
    is_map = file.reference.frame == "enu" or file.reference.epsg is not None
    known = read_survey(place, named, file.columns, is_map=is_map)

    def keys(name: str | None, at: str, sigmas: str, *, is_given: bool) -> dict[str, list[float]]:
        if name is None:
            return {}
        found = known[name]
        with naming(f"{place}: point {quoting(name)}"):
            if np.abs(found.at).max() > FARTHEST:
                raise ReadError(f"a coordinate is beyond {FARTHEST:g} m")
            if is_given:
                return {at: found.at.tolist()}
            if found.sigma is None:
                raise ReadError("has no 1 σ for each coordinate; give sigma_m in the site file")
            if not LEAST_SIGMA <= found.sigma.min() <= found.sigma.max() <= LARGEST_SIGMA:
                raise ReadError(
                    f"its 1 σ are {found.sigma.tolist()}, expected {LEAST_SIGMA:g} to "
                    f"{LARGEST_SIGMA:g} m; give sigma_m in the site file"
                )
        return {at: found.at.tolist(), sigmas: found.sigma.tolist()}

    poles, points = [], []
    for pole in file.surveyed_pole:
        given = pole.sigma_m is not None
        foot = keys(pole.foot, "foot_m", "foot_sigma_m", is_given=given)
        top = keys(pole.top, "top_m", "top_sigma_m", is_given=given)
        poles.append(structs.replace(pole, **foot, **top))
    for point in file.control_point:
        at = keys(point.at, "at_m", "sigmas_m", is_given=point.sigma_m is not None)
        points.append(structs.replace(point, **at))
    return structs.replace(file, surveyed_pole=poles, control_point=points)


def read_of(
    file: SiteFile,
    path: Path,
    listener: Listener,
    lidar: int,
    placement: int,
    *,
    known: Mapping[str, Wanted] = {},
) -> Input:
    """Read what a LiDAR of a site file recorded in a placement, by their indices.

    `known` is of older recordings, by the names of LiDARs: what the file does not state.

    Raises
    ------
    ReadError, MissingExtraError
        If it cannot be read; names the file, the LiDAR and the placement.
    """
    table = file.lidar[lidar]
    with naming(_where(file, path, lidar, placement), is_said_there=True):
        place = path.parent / table.recordings[placement]
        how = table.reading(file.max_points)
        wanted = how.wanted.or_known(known.get(table.name, USUAL))
        return read_input(place, how._replace(wanted=wanted), listener)


def _where(file: SiteFile, path: Path, lidar: int, placement: int) -> str:
    return f"{path}: lidar {file.lidar[lidar].name}, placement {file.placements[placement]}"


def inputs_of(site: Site) -> SiteInputs:
    """Describe the input of a site that was built in Python.

    Raises
    ------
    MissingExtraError, UsageError
        If its frame is a projected one, as `base.world.in_metres`, and as `check_site`.
    """
    check_site(site)
    inputs = {
        (k, n): Input(cloud, cloud, lidar.sensor, lidar.threshold)
        for k, lidar in enumerate(site.lidars)
        for n, cloud in enumerate(lidar.clouds)
        if cloud is not None
    }
    return SiteInputs(in_metres(site), inputs, SiteConfig(carried=site.carried))


def check_site(site: Site) -> None:
    """Refuse a site that was put together in Python and makes no sense.

    Raises
    ------
    UsageError
        If an input is wrong; names the fault and the expected value.
    """
    names = [lidar.name for lidar in site.lidars]
    if len(names) < 2 or len(set(names)) < len(names):
        raise UsageError(f"the LiDARs are {names}, expected two or more of different names")
    for lidar in site.lidars:
        recorded = len(lidar.clouds) - lidar.clouds.count(None)
        if len(lidar.clouds) != len(site.placements) or not recorded:
            raise UsageError(
                f"{lidar.name} has {len(lidar.clouds)} clouds, expected {len(site.placements)}, "
                "one for each placement or None, and at least one"
            )
    tied = site.poles or site.points or any(lidar.up is not None for lidar in site.lidars)
    if site.carried and (len(site.placements) > 1 or tied):
        raise UsageError(
            "a walk has one placement, without surveyed points and without up of a lidar"
        )
    if not 0 <= site.reference < len(names):
        raise UsageError(f"reference is {site.reference}, expected 0 to {len(names) - 1}")


def site_of(file: SiteFile, inputs: Mapping[tuple[int, int], Input]) -> Site:
    """Make a site of a site file and its recordings, in the coordinates that the file has.

    Parameters
    ----------
    file
        As `api.site_file.decode_site_file` takes it.
    inputs
        What was read, by the indices of the LiDAR and of the placement.

    Raises
    ------
    ReadError
        Where surveyed coordinates cannot be those of one site.
    """
    names = [lidar.name for lidar in file.lidar]
    offset = offset_of(file)
    reference = 0 if file.reference.lidar is None else names.index(file.reference.lidar)
    need = file.need
    return Site(
        name=file.name,
        lidars=tuple(
            SiteLidar(
                lidar.name,
                tuple(
                    inputs[k, n].cloud if (k, n) in inputs else None
                    for n in range(len(file.placements))
                ),
                sensor_or_auto(lidar.sensor),
                lidar.threshold,
                lidar.serial,
                _up(lidar),
                None if lidar.mast_sway_deg is None else float(np.radians(lidar.mast_sway_deg)),
            )
            for k, lidar in enumerate(file.lidar)
        ),
        placements=tuple(file.placements),
        radius=file.poles.radius_m,
        radius_sigma=file.poles.radius_sigma_m,
        reference=reference,
        frame=_frame(file, names[reference], offset),
        poles=tuple(
            SurveyedPole(
                pole.name,
                file.placements.index(pole.placement),
                None if pole.foot_m is None else np.array(pole.foot_m) - offset,
                None if pole.top_m is None else np.array(pole.top_m) - offset,
                _largest(pole.sigma_m, pole.foot_sigma_m, pole.top_sigma_m),
                None if pole.foot_sigma_m is None else np.array(pole.foot_sigma_m),
                None if pole.top_sigma_m is None else np.array(pole.top_sigma_m),
                pole.on,
            )
            for pole in file.surveyed_pole
        ),
        points=tuple(
            ControlPoint(
                point.name,
                np.array(point.at_m) - offset,
                _largest(point.sigma_m, point.sigmas_m),
                tuple(
                    Sighting(names.index(each.lidar), np.array(each.at_m), each.sigma_m)
                    for each in point.seen
                ),
                None if point.sigmas_m is None else np.array(point.sigmas_m),
            )
            for point in file.control_point
        ),
        need=None if need is None else Need(need.within_cm / 100, need.at_m),
        carried=file.carried,
    )


def _largest(sigma: float | None, *sigmas: list[float] | None) -> float:
    return max(max(each) for each in ([] if sigma is None else [sigma], *sigmas) if each)


def offset_of(file: SiteFile) -> Array:
    """Choose the origin that computations count from: near what is surveyed, a round number.

    Returns
    -------
    numpy.ndarray
        (3,) metres; zero if nothing is surveyed.

    Raises
    ------
    ReadError
        If surveyed points are too far from each other for one site; names the point.
    """
    surveyed: list[tuple[str, list[float]]] = []
    for pole in file.surveyed_pole:
        ends = (("foot_m", pole.foot_m), ("top_m", pole.top_m))
        surveyed += [(f"surveyed_pole {pole.name}, {k}", end) for k, end in ends if end is not None]
    surveyed += [
        (f"control_point {each.name}, at_m", each.at_m)
        for each in file.control_point
        if each.at_m is not None
    ]
    if not surveyed:
        return np.zeros(3)
    places = np.array([place for _, place in surveyed])
    away = np.linalg.norm(places - np.median(places, axis=0), axis=1)
    worst = int(np.argmax(away))
    if away[worst] > LARGEST_SITE:
        raise ReadError(
            f"{surveyed[worst][0]}: lies {length(float(away[worst]))} from the middle of the "
            f"surveyed points, expected {LARGEST_SITE:g} m at most: is a digit wrong?"
        )
    return np.asarray(OFFSET_STEP * np.round(places.mean(axis=0) / OFFSET_STEP)) + 0.0


def _up(lidar: LidarTable) -> Up | None:
    if lidar.up is None or lidar.up_sigma_deg is None:
        return None
    direction = np.array(lidar.up)
    return Up(direction / np.linalg.norm(direction), float(np.radians(lidar.up_sigma_deg)))


def _frame(file: SiteFile, lidar: str, offset: Array) -> Frame:
    """Name the frame of the site, and say where its origin is."""
    given = file.reference
    if not file.surveyed:
        return Frame(f"LiDAR {lidar}")
    name, origin = "ENU" if given.frame == "enu" else "local frame of the survey", None
    latitude, longitude, height = given.latitude_deg, given.longitude_deg, given.height_m
    if given.epsg is not None:
        name = f"EPSG:{given.epsg}"
    elif latitude is not None and longitude is not None and height is not None:
        name = f"ENU at {latitude:g}, {longitude:g}"
        origin = Geodetic(math.radians(latitude), math.radians(longitude), height)
    return Frame(name, surveyed=True, offset=offset, epsg=given.epsg, geodetic=origin)


def repeated(read: SiteInputs, documents: Sequence[RecordingDoc]) -> Refusal | None:
    """Refuse a recording that is given for two LiDARs or placements; None if none does."""
    inputs, site = list(read.inputs.values()), read.site
    names = [f"{site.lidars[k].name} in placement {site.placements[n]}" for k, n in read.inputs]
    return refuse_repeated(
        inputs,
        documents,
        lambda first, second: (
            f"{names[first]} and {names[second]}, {inputs[first].name} and {inputs[second].name}, "
            "are identical; give each LiDAR and placement a separate recording"
        ),
    )
