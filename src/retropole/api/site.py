"""`calibrate_site`: a site file in, the poses of all its LiDARs in one frame out."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..adjustment.answer import LidarPose, SiteCalibration
from ..base.datatypes import Array, Scan
from ..base.description import Site
from ..base.errors import Refusal, UsageError
from ..base.files import write_atomically
from ..base.quantities import error as in_words
from ..base.se3 import RelativePose, joint_of, relative
from ..hypotheses.scans import SiteScans
from ..pipeline import calibrate_site as find_poses
from ..report import render_site
from ..report.listings import pose_rows
from ..result import SITE_REPORT_FILE, SITE_RESULT_FILE, refusal_of
from ..result.decoding import decode_site
from ..result.site import SiteDoc, site_document
from ..verdict.statement import state_site_refusal
from .inputs import Input, Listener
from .result import Result
from .site_inputs import inputs_of, read_site, repeated
from .stored import StoredScans, loaded, scans_of
from .travelling import named_from

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False, repr=False)
class SiteResult(Result[SiteDoc]):
    """The calibration of a site, or why there is none.

    Attributes
    ----------
    document
        Everything that was found, as ``site-result.json`` holds it.
    calibration
        The same as arrays, with the clouds; None of a result that was loaded.
    beside
        Folder that paths in the document count from: of a result that was loaded, its own.
    """

    calibration: SiteCalibration | None = None
    beside: Path = Path()

    @property
    def lidars(self) -> tuple[str, ...]:
        """Names of the LiDARs."""
        return tuple(lidar.name for lidar in self.document.lidars)

    def pose(self, name: str) -> LidarPose:
        """Give the pose of a LiDAR in the frame of the site, with its covariance and budget.

        Parameters
        ----------
        name
            Of the LiDAR.

        Raises
        ------
        UsageError
            Where no LiDAR is called so.
        Refusal
            Where the calibration was refused.
        """
        if name not in self.lidars:
            raise UsageError(f"no LiDAR {name!r}; there are {', '.join(self.lidars)}")
        k = self.lidars.index(name)
        pose = self.document.lidars[k].pose(k)
        if pose is None:
            raise refusal_of(self.reasons)
        return pose

    def T(self, a: str, b: str) -> Array:
        """Give (4, 4) that maps points of LiDAR b into the frame of LiDAR a.

        Parameters
        ----------
        a, b
            Names of LiDARs.

        Raises
        ------
        UsageError, Refusal
            As `pose`.
        """
        return self._relative(a, b).T_i_j

    def covariance(self, a: str, b: str) -> Array:
        """Give (6, 6) of `T`, over ``[φ, δ]``, rad and m, axes of a.

        What the poses of a and b have in common cancels: it is less than the sum of both.

        Parameters
        ----------
        a, b
            Names of LiDARs.

        Raises
        ------
        UsageError, Refusal
            As `pose`.
        """
        return self._relative(a, b).covariance

    def _relative(self, a: str, b: str) -> RelativePose:
        i, j = self.pose(a), self.pose(b)
        joint = joint_of(np.asarray(self.document.joint_covariance), i.lidar, j.lidar)
        return relative(i.T_site_lidar, j.T_site_lidar, joint)

    def save(self, folder: str | Path, *, relative: bool = True) -> tuple[Path, Path]:
        """Write ``site-result.json`` and ``site-report.html`` to a folder, never of two runs.

        Of a result that was loaded, the recordings are read again, as for `report`.

        Parameters
        ----------
        folder
            Made where there is none.
        relative
            Whether files are named by their paths from the folder, so that all may be moved
            together and are found again; else as they are in `document`.

        Returns
        -------
        tuple of Path
            The two files.

        Raises
        ------
        ReadError, MissingExtraError
            Of a loaded result, where a recording of the run cannot be read.
        OSError
            Where the folder cannot be written to.
        """
        document = self.document
        if relative:
            document = named_from(document, Path(folder), self.beside)
        stored = self._inputs()
        html = render_site(document, stored.scans, notes=stored.notes)
        files = Path(folder, SITE_RESULT_FILE), Path(folder, SITE_REPORT_FILE)
        return self._write(document, *files, html)

    def report(
        self,
        path: str | Path,
        *,
        clouds: Sequence[str | Path] = (),
        site: str = "",
        serials: Mapping[str, str] | None = None,
    ) -> Path:
        """Write the report, one HTML page, to a file.

        A result that was loaded reads its recordings again. Those that are not found, or are no
        longer those of the run, are not shown, and the page says so.

        Parameters
        ----------
        path
            The file to write.
        clouds
            Of a loaded result, where its recordings are now, in any order: each is told by its
            hash. The others are looked for where they were, and beside the result.
        site, serials
            For the certificate, the page's first sheet on paper: where it was calibrated, and
            serial numbers by the names of LiDARs. Without, what the site file said.

        Raises
        ------
        ReadError, MissingExtraError
            Of a loaded result, where a recording of the run cannot be read.
        UsageError
            Where a cloud that is given is not of the run, or no LiDAR is called so.
        OSError
            Where the file cannot be written.
        """
        stored = self._inputs([Path(cloud) for cloud in clouds])
        html = render_site(
            self.document, stored.scans, notes=stored.notes, site=site, serials=serials
        )
        write_atomically(Path(path), html.encode())
        return Path(path)

    def _inputs(self, clouds: Sequence[Path] = ()) -> StoredScans:
        """Take the scans of the run, or read them again."""
        if self.calibration is not None and not clouds:
            return StoredScans(self.calibration.scans, ())
        return scans_of(self.document, self.beside, clouds)

    def plot(self) -> Figure:
        """Draw all LiDARs in the frame of the site, with the first cloud of each, and the poles.

        Of a result that was loaded, without the clouds that are not found again.

        Returns
        -------
        matplotlib.figure.Figure
            A notebook shows it; ``figure.savefig("site.png")`` writes it.

        Raises
        ------
        MissingExtraError
            Where matplotlib is not installed.
        Refusal
            Where the calibration was refused: there is nothing to draw.
        ReadError
            Of a loaded result, where a recording of the run cannot be read.
        """
        from ..report.figures import site_figure

        poses = [self.pose(name).T_site_lidar for name in self.lidars]
        clouds = [
            next((scan.cloud.xyz for scan in scans if scan is not None), np.empty((0, 3)))
            for scans in self._inputs().scans
        ]
        poles = [pole.point for pole in self.document.poles]
        frame = self.document.frame.name
        return site_figure(self.lidars, poses, clouds, poles, frame)

    def _rows(self) -> list[tuple[str, str]]:
        rows = [("datum", self.document.datum)] if self.document.datum else []
        for each in pose_rows(self.document):
            error = f", ± {in_words(each.sigma)} at 30 m" if each.sigma else ""
            rows.append((each.name, f"x {each.x}  y {each.y}  z {each.z} m{error}"))
        return rows + super()._rows()


def calibrate_site(
    site: str | Path | Site,
    *,
    progress: Callable[[str], None] = lambda step: None,
    on_read: Callable[[Input], None] = lambda given: None,
) -> SiteResult:
    """Find the poses of all LiDARs of a site in one frame.

    Parameters
    ----------
    site
        A site file, or the folder that holds ``site.toml``; or a `base.description.Site` that was
        put together in Python.
    progress
        Called with the name of each step as it starts, and with which recording of how many is
        read.
    on_read
        Called with each cloud once it is read.

    Returns
    -------
    SiteResult
        With ``status`` ``refused``, the reasons and no poses where the data carry no answer.

    Raises
    ------
    ReadError, MissingExtraError
        Where the site file or a recording cannot be read; names the key.
    UsageError
        Where a site that was put together in Python makes no sense.
    """
    progress("read")
    start = time.perf_counter()
    if isinstance(site, Site):
        check_site(site)
        read = inputs_of(site)
    else:
        read = read_site(Path(site), Listener(progress, on_read))
    documents = read.documents()
    seconds = time.perf_counter() - start
    twice = repeated(read, documents)
    calibration = refused(read.site, twice) if twice else find_poses(read.site, progress=progress)
    document = site_document(
        calibration,
        inputs=documents,
        config=read.config,
        seconds={"read": seconds, **calibration.seconds},
    )
    return SiteResult(document, calibration)


def load_site_result(path: str | Path) -> SiteResult:
    """Load the result of a site that was saved.

    Parameters
    ----------
    path
        ``site-result.json``, or the folder that holds it.

    Raises
    ------
    ReadError
        Where there is no such file, or it is no result document of a site; names the file.
    """
    file = Path(path)
    if file.is_dir():
        file = file / SITE_RESULT_FILE
    return SiteResult(loaded(file, decode_site), None, file.parent)


def check_site(site: Site) -> None:
    """Refuse a site that was put together in Python and makes no sense.

    Raises
    ------
    UsageError
        Naming what is wrong and what is expected.
    """
    names = [lidar.name for lidar in site.lidars]
    if len(names) < 2 or len(set(names)) < len(names):
        raise UsageError(f"the LiDARs are {names}, expected two or more of different names")
    for lidar in site.lidars:
        recorded = len(lidar.clouds) - lidar.clouds.count(None)
        if len(lidar.clouds) != len(site.placements) or not recorded:
            raise UsageError(
                f"{lidar.name} has {len(lidar.clouds)} clouds, expected {len(site.placements)}, "
                "one for each placement or None, and one at least"
            )
    if not 0 <= site.reference < len(names):
        raise UsageError(f"reference is {site.reference}, expected 0 to {len(names) - 1}")


def refused(site: Site, refusal: Refusal) -> SiteCalibration:
    """State a refusal before anything was looked for."""
    scans = tuple(
        tuple(None if cloud is None else Scan(cloud, lidar.sensor) for cloud in lidar.clouds)
        for lidar in site.lidars
    )
    unsearched = SiteScans(scans, np.zeros((len(scans), 3)))
    return state_site_refusal(site, unsearched, (), (), refusal, (), {})
