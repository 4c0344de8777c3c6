"""What is wrong with a file, in an error that names it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from ..base.errors import MissingExtraError, ReadError, UsageError, said


class LineError(ReadError):
    """What is wrong with a line of a text, of which the number is known."""

    def __init__(self, line: int, words: str) -> None:
        super().__init__(f"line {line}: {words}")


@contextmanager
def naming(place: object, *, is_said_there: bool = False) -> Iterator[None]:
    """Name the file, or the part of it, in whatever is wrong with it or the system has against it.

    Parameters
    ----------
    place
        The file or its part.
    is_said_there
        Where an option makes no sense, that is what is wrong with the file: it stands there.

    Raises
    ------
    ReadError, UsageError
        In place of the same without the name, and of an `OSError`.
    """
    with readable(place):
        try:
            yield
        except (ReadError, UsageError) as error:
            kind = ReadError if is_said_there or isinstance(error, ReadError) else UsageError
            comma = ", " if isinstance(error, LineError) else ": "
            raise kind(f"{place}{comma}{error}") from None


@contextmanager
def readable(place: object) -> Iterator[None]:
    """Say what the system has against a file or folder; all other errors name it themselves."""
    try:
        yield
    except OSError as error:
        raise ReadError(f"{place}: cannot be read ({error.strerror or said(error)})") from None


@contextmanager
def reported(what: str, remedy: str = "") -> Iterator[None]:
    """Turn any failure of a library into a `ReadError` that says what to do.

    For damaged files the libraries raise a dozen unrelated types. An OSError with a number comes
    from the system, one without from decompressing.
    """
    try:
        yield
    except (ReadError, MissingExtraError):
        raise
    except Exception as error:
        if isinstance(error, OSError) and error.errno:
            raise
        raise ReadError(f"is not a readable {what} ({said(error)}){remedy}") from None
