"""Everything that retropole raises on purpose, and why an answer is weak.

The command line catches the errors in one place.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from .reasons import Code


class RetropoleError(Exception):
    """Base of all errors raised by retropole."""


class ReadError(RetropoleError):
    """A file that cannot be read: names the file, the place and what was expected."""


class UsageError(RetropoleError):
    """An argument or option that makes no sense; the message uses the caller's words."""


class MissingExtraError(RetropoleError):
    """An optional dependency is not installed.

    Parameters
    ----------
    extra
        Name of the extra of this package that brings the dependency.
    purpose
        What it is needed for, as a noun phrase ("reading LAS files").
    """

    def __init__(self, extra: str, purpose: str) -> None:
        super().__init__(f"{purpose} needs an extra: pip install 'retropole[{extra}]'")
        self.extra = extra


class Refusal(RetropoleError):
    """The data cannot carry an answer.

    Parameters
    ----------
    code
        Stable machine-readable reason, of the tables in `reasons`.
    message
        The reason in numbers, and what the user can do about it.
    values
        The numbers of the message, by name.
    """

    def __init__(
        self, code: Code, message: str, values: Mapping[str, float | int | str] | None = None
    ) -> None:
        super().__init__(message)
        self.code: Code = code
        self.message = message
        self.values = dict(values or {})

    def __reduce__(self) -> tuple[type[Refusal], tuple[Code, str, dict[str, float | int | str]]]:
        """Rebuild from all three, so that a refusal gets across processes."""
        return Refusal, (self.code, self.message, self.values)


@dataclass(frozen=True, eq=False)
class Reason:
    """Why a verdict is not a plain ok: a stable code, words with numbers, and the numbers."""

    code: Code
    message: str
    values: Mapping[str, float | int | str]
