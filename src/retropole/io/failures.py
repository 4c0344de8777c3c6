"""What is wrong with a file, in an error that names it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from ..base.errors import MissingExtraError, ReadError, UsageError


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
    try:
        yield
    except (ReadError, UsageError) as error:
        raise (ReadError if is_said_there else type(error))(f"{place}: {error}") from None
    except OSError as error:
        raise ReadError(f"{place}: cannot be read ({error.strerror or error})") from None


@contextmanager
def readable(place: object) -> Iterator[None]:
    """Say what the system has against a file or folder; all other errors name it themselves."""
    try:
        yield
    except OSError as error:
        raise ReadError(f"{place}: cannot be read ({error.strerror or error})") from None


@contextmanager
def reported(path: object, what: str, remedy: str = "") -> Iterator[None]:
    """Turn any failure of a library into a `ReadError` with the file and what to do.

    For damaged files the libraries raise a dozen unrelated types. An OSError with a number comes
    from the system, one without from decompressing.
    """
    with readable(path):
        try:
            yield
        except (ReadError, MissingExtraError):
            raise
        except Exception as error:
            if isinstance(error, OSError) and error.errno:
                raise
            words = str(error) or type(error).__name__
            raise ReadError(f"{path}: is not a readable {what} ({words}){remedy}") from None
