"""Results for users, of two LiDARs or of a site: look at one, save it, load it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Generic

import numpy as np

from ..adjustment.answer import LidarPose, SiteCalibration
from ..base import se3
from ..base.carried import CarriedWalk
from ..base.datatypes import Array, Placement, Scan
from ..base.errors import UsageError, printable, visible
from ..base.files import write_atomically, write_together
from ..base.quantities import error
from ..base.se3 import RelativePose, joint_of, relative
from ..base.uncertainty import RadiusEstimate, Uncertainty
from ..base.uncertainty.confirmation import Confirmation
from ..base.uncertainty.purpose import Fitness
from ..report import render_report
from ..report.listings import largest_error, pose_rows, radius_words, scene_words
from ..result import (
    REPORT_FILE,
    RESULT_FILE,
    SITE_REPORT_FILE,
    SITE_RESULT_FILE,
    ErrorAtRange,
    ReasonDoc,
    ResultDoc,
    encode,
    refusal_of,
    result_file,
)
from ..result.decoding import decode_site
from ..result.site import LIDARS, SiteDoc
from ..surfaces.consistency import contradicting_points, objects_in
from .stored import AnyDoc, StoredScans, decode_pair, loaded, named_from, scans_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False, repr=False)
class Result(Generic[AnyDoc]):
    """An answer, or why there is none.

    Attributes
    ----------
    document
        The whole result, as in the file.
    path
        The file that it was loaded from; None of a run.
    """

    document: AnyDoc
    path: Path | None = None
    _files: ClassVar[tuple[str, str]]

    @property
    def beside(self) -> Path:
        """Folder to which paths in the document are relative: that of a loaded result."""
        return Path() if self.path is None else self.path.parent

    @property
    def status(self) -> str:
        """``ok``, ``warn`` or ``refused``."""
        return self.document.status

    @property
    def reasons(self) -> tuple[ReasonDoc, ...]:
        """Errors or doubts: code, message and values of each; empty when ok."""
        return tuple(self.document.reasons)

    @property
    def notes(self) -> tuple[ReasonDoc, ...]:
        """Notes on an answer that do not make it doubtful, in the same form."""
        return tuple(self.document.notes)

    def __repr__(self) -> str:
        """The verdict, the pose and the reasons, one line each."""
        lines = [f"{type(self).__name__}: {self.status}"]
        return "\n".join(
            lines + [f"  {name:<16} {printable(value)}" for name, value in self._rows()]
        )

    def _repr_html_(self) -> str:
        """Show the content of `repr` in a notebook, as a table."""
        rows = "".join(
            f'<tr><th style="text-align:left">{escape(visible(name))}</th>'
            f'<td style="text-align:left">{escape(visible(value))}</td></tr>'
            for name, value in [("verdict", self.status), *self._rows()]
        )
        return f"<table>{rows}</table>"

    def _rows(self) -> list[tuple[str, str]]:
        return [(reason.code, reason.message) for reason in self.reasons]

    def save(self, folder: str | Path, *, relative: bool = True) -> tuple[Path, Path]:
        """Write the document and its page to a folder, never from two different runs.

        Of a pair ``result.json`` and ``report.html``, of a site ``site-result.json`` and
        ``site-report.html``. Of a result that was loaded, the recordings are read again.

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
            For a loaded result, if a recording of the run is not found, or for a site cannot
            be read.
        OSError
            If the folder cannot be written to.
        """
        stored, document = self._recorded(), self.document
        if relative:
            document = named_from(document, Path(folder), self.beside)
        page = render_report(document, stored.scans, notes=stored.notes)
        result, html = (Path(folder, name) for name in self._files)
        write_together({result: encode(document), html: page.encode()})
        return result, html

    def _report(
        self,
        path: str | Path,
        clouds: Sequence[str | Path],
        site: str,
        serials: Mapping[str, str] | None,
    ) -> Path:
        """Write the page alone, from recordings that may have another path now."""
        stored = self._recorded([Path(cloud) for cloud in clouds])
        page = render_report(
            self.document, stored.scans, notes=stored.notes, site=site, serials=serials
        )
        write_atomically(Path(path), page.encode())
        return Path(path)

    def _recorded(self, clouds: Sequence[Path] = ()) -> StoredScans:
        """Use the scans of the run, or read them again."""
        scans = self._scans
        if scans is not None and not clouds:
            return StoredScans(scans, ())
        return scans_of(self.document, self.beside, clouds)

    @property
    def _scans(self) -> Sequence[Sequence[Scan | None]] | None:
        """Those of the run; None of a result that was loaded."""
        raise NotImplementedError


@dataclass(frozen=True, eq=False, repr=False)
class CalibrationResult(Result[ResultDoc]):
    """A calibration, or why there is none.

    Attributes
    ----------
    document
        Everything that was found, as in ``result.json``: hypotheses, poles, the uncertainty,
        the inputs with their hashes, the options, the time of each step.
    placements
        Recordings and poles, one for each placement of the poles; None for a loaded
        result.
    path
        The file that it was loaded from; None of a run.
    """

    placements: tuple[Placement, ...] | None = None
    _files = RESULT_FILE, REPORT_FILE

    @property
    def T_target_source(self) -> Array | None:
        """(4, 4) maps points of the source into the target's frame; None when refused."""
        T = self.document.T_target_source
        return None if T is None else np.array(T)

    @property
    def covariance(self) -> Array | None:
        """(6, 6) over ``[φ, δ]``, rad and m, target axes; None when refused."""
        covariance = self.document.covariance
        return None if covariance is None else np.array(covariance)

    @property
    def uncertainty(self) -> Uncertainty | None:
        """The two parts of `covariance`, random and systematic, and the error

        budget. None when refused, and for a result of a version without it.
        """
        return self.document.whole_uncertainty

    @property
    def radius(self) -> RadiusEstimate | None:
        """The poles' radius as given and as estimated, metres; None as `uncertainty` is."""
        return self.document.radius

    @property
    def confirmation(self) -> Confirmation | None:
        """The scene check of the pose: how many voxels agree or conflict with it.

        None if the run was refused before the scene was used, and for a result of
        a version without it.
        """
        return self.document.confirmation

    @property
    def walk(self) -> CarriedWalk | None:
        """Of a pole that was carried: the offset of the clocks, and the walk; else None."""
        return self.document.walk

    @property
    def fitness(self) -> Fitness | None:
        """Whether it is as accurate as was requested (`answer`, `probability`, `bound_m`).

        None if nothing was requested, and when refused.
        """
        return self.document.fitness

    @property
    def predicted_error(self) -> tuple[ErrorAtRange, ...]:
        """Predicted 1 σ error of a point (`sigma_m`) at ranges (`range_m`); empty when refused."""
        return tuple(self.document.predicted_error or ())

    def required_transform(self) -> Array:
        """Give (4, 4) ``T_target_source``, or raise the reason why there is none.

        Raises
        ------
        Refusal
            With the code of the result's first reason, if the calibration was refused.
        """
        T = self.T_target_source
        if T is None:
            raise refusal_of(self.reasons)
        return T

    def _rows(self) -> list[tuple[str, str]]:
        rows = []
        T = self.T_target_source
        if T is not None:
            x, y, z = T[:3, 3]
            roll, pitch, yaw = np.degrees(se3.rpy_from_rotation(T[:3, :3]))
            rows += [
                ("translation", f"x {x:.4f}  y {y:.4f}  z {z:.4f} m"),
                ("rotation", f"roll {roll:.4f}  pitch {pitch:.4f}  yaw {yaw:.4f} deg"),
            ]
        if self.predicted_error:
            at = ", ".join(
                f"± {error(each.sigma_m)} at {each.range_m:g} m" for each in self.predicted_error
            )
            rows.append(("predicted error", f"{at} (1 σ)"))
        cells = (
            ("fit for purpose", None if self.fitness is None else self.fitness.words),
            ("main error", largest_error(self.document)),
            ("radius", radius_words(self.document)),
            ("scene", scene_words(self.document)),
        )
        rows += [(name, text) for name, text in cells if text is not None]
        return rows + super()._rows()

    def report(
        self,
        path: str | Path,
        *,
        clouds: Sequence[str | Path] = (),
        site: str = "",
        serials: tuple[str, str] = ("", ""),
    ) -> Path:
        """Write the report, one HTML page, to a file.

        A result that was loaded reads its inputs again; the page says which of them differ from
        those of the run.

        Parameters
        ----------
        path
            The file to write.
        clouds
            Of a loaded result, the paths of its inputs now: target and source of each placement.
            Without, they are searched for at their old paths, and next to the result.
        site, serials
            For the certificate, the page's first sheet on paper: the place of the calibration, and
            the serial numbers of the target and the source LiDAR.

        Raises
        ------
        ReadError, MissingExtraError
            Of a loaded result, where an input is not found or cannot be read.
        UsageError
            If the number of clouds is not that of the result.
        OSError
            If the file cannot be written.
        """
        return self._report(path, clouds, site, dict(zip(LIDARS, serials, strict=True)))

    def plot(self) -> Figure:
        """Draw both clouds of the first placement, before and after.

        Returns
        -------
        matplotlib.figure.Figure
            A notebook shows it; ``figure.savefig("result.png")`` writes it.

        Raises
        ------
        MissingExtraError
            If matplotlib is not installed.
        Refusal
            If the calibration was refused: there is nothing to draw.
        ReadError
            Of a loaded result, where its inputs are not found again.
        """
        from ..report.figures import result_figure

        T = self.required_transform()
        first = [scan for (scan, *_) in self._recorded().scans if scan is not None]
        chosen = self.document.chosen
        target, source = (scan.poles for scan in first)
        pairs = chosen.pairs if chosen and target and source else []
        rng = np.random.default_rng(0)
        objects = [objects_in(scan.cloud, rng) for scan in first]
        return result_figure(
            first[0].cloud,
            first[1].cloud,
            T,
            ([target[i] for i, _ in pairs], [source[j] for _, j in pairs]),
            contradicting=contradicting_points(objects[0], objects[1], T),
        )

    @property
    def _scans(self) -> Sequence[Sequence[Scan | None]] | None:
        if self.placements is None:
            return None
        return list(zip(*(each.scans for each in self.placements), strict=True))


@dataclass(frozen=True, eq=False, repr=False)
class SiteResult(Result[SiteDoc]):
    """The calibration of a site, or why there is none.

    Attributes
    ----------
    document
        Everything that was found, as in ``site-result.json``.
    calibration
        The same as arrays, with the clouds; None of a result that was loaded.
    path
        The file that it was loaded from; None of a run.
    """

    calibration: SiteCalibration | None = None
    _files = SITE_RESULT_FILE, SITE_REPORT_FILE

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
            If no LiDAR is called so.
        Refusal
            If the calibration was refused.
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

        Common errors of the poses of a and b cancel: it is less than the sum of both.

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
            Of a loaded result, the paths of its recordings now, in any order: each is identified by
            its hash. The others are searched for at their old paths, and next to the result.
        site, serials
            For the certificate, the page's first sheet on paper: where it was calibrated, and
            serial numbers by the names of LiDARs. Without, what the site file said.

        Raises
        ------
        ReadError, MissingExtraError
            Of a loaded result, where a recording of the run cannot be read.
        UsageError
            If a cloud that is given is not of the run, or no LiDAR is called so.
        OSError
            If the file cannot be written.
        """
        return self._report(path, clouds, site, serials)

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
            If matplotlib is not installed.
        Refusal
            If the calibration was refused: there is nothing to draw.
        ReadError
            Of a loaded result, where a recording of the run cannot be read.
        """
        from ..report.figures import site_figure

        poses = [self.pose(name).T_site_lidar for name in self.lidars]
        clouds = [
            next((scan.cloud.xyz for scan in scans if scan is not None), np.empty((0, 3)))
            for scans in self._recorded().scans
        ]
        poles = [pole.point for pole in self.document.poles]
        frame = self.document.frame.name
        return site_figure(self.lidars, poses, clouds, poles, frame)

    def _rows(self) -> list[tuple[str, str]]:
        rows = [("datum", self.document.datum)] if self.document.datum else []
        for each in pose_rows(self.document):
            sigma = f", ± {error(each.sigma)} at 30 m" if each.sigma else ""
            rows.append((each.name, f"x {each.x}  y {each.y}  z {each.z} m{sigma}"))
        return rows + super()._rows()

    @property
    def _scans(self) -> Sequence[Sequence[Scan | None]] | None:
        return None if self.calibration is None else self.calibration.scans


def load_result(path: str | Path) -> CalibrationResult:
    """Load a result that was saved.

    Parameters
    ----------
    path
        ``result.json``, or its folder.

    Raises
    ------
    ReadError
        If there is no such file, or it is not a result document; names the file.
    """
    file = result_file(Path(path))
    return CalibrationResult(loaded(file, partial(decode_pair, file)), file)


def load_site_result(path: str | Path) -> SiteResult:
    """Load the result of a site that was saved.

    Parameters
    ----------
    path
        ``site-result.json``, or its folder.

    Raises
    ------
    ReadError
        If there is no such file, or it is not a result document of a site; names the file.
    """
    file = Path(path)
    if file.is_dir():
        file = file / SITE_RESULT_FILE
    return SiteResult(loaded(file, decode_site), file)
