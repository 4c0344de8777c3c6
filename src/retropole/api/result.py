"""Results as a user meets them, of two LiDARs or of a site: look at one, save it, load it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Generic

import numpy as np

from ..base import se3
from ..base.datatypes import Array, Placement
from ..base.errors import printable, visible
from ..base.files import write_atomically, write_together
from ..base.quantities import error
from ..base.uncertainty import RadiusEstimate, Uncertainty
from ..base.uncertainty.confirmation import Confirmation
from ..base.uncertainty.purpose import Fitness
from ..report import render_report
from ..report.listings import largest_error, radius_words, scene_words
from ..result import (
    REPORT_FILE,
    RESULT_FILE,
    ErrorAtRange,
    ReasonDoc,
    ResultDoc,
    encode,
    refusal_of,
    result_file,
)
from ..surfaces.consistency import contradicting_points, standing_in
from .stored import StoredInputs, decode_pair, loaded, placements_of
from .travelling import AnyDoc, named_from

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False, repr=False)
class Result(Generic[AnyDoc]):
    """An answer, or why there is none.

    Attributes
    ----------
    document
        Everything that was found, as the file holds it.
    """

    document: AnyDoc

    @property
    def status(self) -> str:
        """``ok``, ``warn`` or ``refused``."""
        return self.document.status

    @property
    def reasons(self) -> tuple[ReasonDoc, ...]:
        """What is wrong or doubtful: code, message and values of each; empty when ok."""
        return tuple(self.document.reasons)

    @property
    def notes(self) -> tuple[ReasonDoc, ...]:
        """What to know of an answer that makes it no less true, in the same form."""
        return tuple(self.document.notes)

    def __repr__(self) -> str:
        """Say the verdict, what was found and the reasons, a line each."""
        lines = [f"{type(self).__name__}: {self.status}"]
        return "\n".join(
            lines + [f"  {name:<16} {printable(value)}" for name, value in self._rows()]
        )

    def _repr_html_(self) -> str:
        """Show what `repr` says in a notebook, as a table."""
        rows = "".join(
            f'<tr><th style="text-align:left">{escape(visible(name))}</th>'
            f'<td style="text-align:left">{escape(visible(value))}</td></tr>'
            for name, value in [("verdict", self.status), *self._rows()]
        )
        return f"<table>{rows}</table>"

    def _rows(self) -> list[tuple[str, str]]:
        return [(reason.code, reason.message) for reason in self.reasons]

    def _write(self, document: AnyDoc, result: Path, page: Path, html: str) -> tuple[Path, Path]:
        """Write the document and its page, never of two runs."""
        write_together({result: encode(document), page: html.encode()})
        return result, page


@dataclass(frozen=True, eq=False, repr=False)
class CalibrationResult(Result[ResultDoc]):
    """A calibration, or why there is none.

    Attributes
    ----------
    document
        Everything that was found, as ``result.json`` holds it: hypotheses, poles, the uncertainty,
        the inputs with their hashes, the options, the time of each step.
    placements
        What was recorded and found, one for each placement of the poles; None of a result that was
        loaded.
    path
        The file that it was loaded from; None of a run.
    """

    placements: tuple[Placement, ...] | None = None
    path: Path | None = None

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
        """`covariance` in its two kinds, random and systematic, and the error budget.

        None when refused, and of a result of a version that did not state it.
        """
        return self.document.whole_uncertainty

    @property
    def radius(self) -> RadiusEstimate | None:
        """The poles' radius as given and as estimated, metres; None as `uncertainty` is."""
        return self.document.radius

    @property
    def confirmation(self) -> Confirmation | None:
        """What stands in the scene says of the pose: how many voxels agree or conflict with it.

        None where the run was refused before the scene was asked, and of a result of a version
        that did not state it.
        """
        return self.document.confirmation

    @property
    def fitness(self) -> Fitness | None:
        """Whether it is as accurate as was asked for (`answer`, `probability`, `bound_m`).

        None where nothing was asked for, and when refused.
        """
        return self.document.fitness

    @property
    def predicted_error(self) -> tuple[ErrorAtRange, ...]:
        """Predicted 1 σ error of a point (`sigma_m`) at ranges (`range_m`); empty when refused."""
        return tuple(self.document.predicted_error or ())

    def required_transform(self) -> Array:
        """Give (4, 4) ``T_target_source``, or say why there is none.

        Raises
        ------
        Refusal
            With the code of the result's first reason, where the calibration was refused.
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
        said = (
            ("fit for purpose", None if self.fitness is None else self.fitness.words),
            ("main error", largest_error(self.document)),
            ("radius", radius_words(self.document)),
            ("scene", scene_words(self.document)),
        )
        rows += [(name, words) for name, words in said if words is not None]
        return rows + super()._rows()

    def save(self, folder: str | Path, *, relative: bool = True) -> tuple[Path, Path]:
        """Write ``result.json`` and ``report.html`` to a folder, never of two runs.

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
        ReadError
            Of a loaded result, where its inputs are not found again for the report.
        OSError
            Where the folder cannot be written to.
        """
        stored, document = self._inputs(), self.document
        if relative:
            document = named_from(document, Path(folder), self._beside)
        html = render_report(document, stored.placements, notes=stored.notes)
        return self._write(document, Path(folder, RESULT_FILE), Path(folder, REPORT_FILE), html)

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
            Of a loaded result, where its inputs are now: target and source of each placement.
            Without, they are looked for where they were, and beside the result.
        site, serials
            For the certificate, the page's first sheet on paper: where it was calibrated, and the
            serial numbers of the target and the source LiDAR.

        Raises
        ------
        ReadError, MissingExtraError
            Of a loaded result, where an input is not found or cannot be read.
        UsageError
            Where not as many clouds are given as the result has.
        OSError
            Where the file cannot be written.
        """
        stored = self._inputs([Path(cloud) for cloud in clouds])
        page = render_report(
            self.document, stored.placements, notes=stored.notes, site=site, serials=serials
        )
        write_atomically(Path(path), page.encode("utf-8"))
        return Path(path)

    def plot(self) -> Figure:
        """Draw both clouds of the first placement, before and after.

        Returns
        -------
        matplotlib.figure.Figure
            A notebook shows it; ``figure.savefig("result.png")`` writes it.

        Raises
        ------
        MissingExtraError
            Where matplotlib is not installed.
        Refusal
            Where the calibration was refused: there is nothing to draw.
        ReadError
            Of a loaded result, where its inputs are not found again.
        """
        from ..report.figures import result_figure

        T = self.required_transform()
        placement = self._inputs().placements[0]
        chosen = self.document.chosen
        pairs = [] if chosen is None else chosen.pairs
        target, source = placement.target.poles, placement.source.poles
        if not target or not source:
            pairs = []
        rng = np.random.default_rng(0)
        standing = [standing_in(s.cloud, rng) for s in (placement.target, placement.source)]
        return result_figure(
            placement.target.cloud,
            placement.source.cloud,
            T,
            ([target[i] for i, _ in pairs], [source[j] for _, j in pairs]),
            contradicting=contradicting_points(standing[0], standing[1], T),
        )

    def _inputs(self, clouds: Sequence[Path] = ()) -> StoredInputs:
        """Take the placements of the run, or read them again."""
        if self.placements is not None and not clouds:
            return StoredInputs(self.placements, ())
        return placements_of(self.document, self._beside, clouds)

    @property
    def _beside(self) -> Path:
        """Folder that paths in the document count from."""
        return Path() if self.path is None else self.path.parent


def load_result(path: str | Path) -> CalibrationResult:
    """Load a result that was saved.

    Parameters
    ----------
    path
        ``result.json``, or the folder that holds it.

    Raises
    ------
    ReadError
        Where there is no such file, or it is no result document; names the file.
    """
    file = result_file(Path(path))
    return CalibrationResult(loaded(file, partial(decode_pair, file)), None, file)
