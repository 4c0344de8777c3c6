"""What the result of two LiDARs and that of a site have in common: look at it, save it, load it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

from ..base.files import read_document, write_together
from ..io.failures import naming, readable
from ..result import ReasonDoc, ResultDoc, encode
from ..result.site import SiteDoc

AnyDoc = TypeVar("AnyDoc", ResultDoc, SiteDoc)


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
        """What is wrong or weak: code, message and values of each; empty when ok."""
        return tuple(self.document.reasons)

    def __repr__(self) -> str:
        """Say the verdict, what was found and the reasons, a line each."""
        lines = [f"{type(self).__name__}: {self.status}"]
        return "\n".join(lines + [f"  {name:<16} {value}" for name, value in self._rows()])

    def _rows(self) -> list[tuple[str, str]]:
        return [(reason.code, reason.message) for reason in self.reasons]

    def _write(self, result: Path, page: Path, html: str) -> tuple[Path, Path]:
        """Write the document and its page, never of two runs."""
        write_together({result: encode(self.document), page: html.encode()})
        return result, page


def loaded(file: Path, decode: Callable[[bytes], AnyDoc]) -> AnyDoc:
    """Read a result document.

    Raises
    ------
    ReadError
        Where there is no such file, or it is none; names the file.
    """
    with readable(file):
        data = read_document(file)
    with naming(file):
        return decode(data)
