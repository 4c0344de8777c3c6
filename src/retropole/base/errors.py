"""All errors that retropole raises deliberately, and the reasons for a weak answer.

The command line catches the errors in one place; `naming` puts the name of a file into them.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from unicodedata import category

from .reasons import Code, Prefix, is_note, prefixed

LONGEST_MESSAGE = 300
"""Maximum number of characters of a message that quotes external text: a file, its name, an
option."""

UNUSUAL = re.compile(r"[^\n -~]")
"""A sign that is looked at: most are ASCII."""

ESCAPED_BYTES = range(0xDC80, 0xDD00)
"""Code points that Python uses for bytes of a file name that are not UTF-8 (PEP 383), from 0x80
on."""


def printable(text: str) -> str:
    """Write line ends, control characters and marks of direction as escapes, on one line.

    External text is then shown as text, and cannot control a terminal.
    """
    if text.isprintable():
        return text
    return "".join(sign if sign.isprintable() else escaped(sign) for sign in text)


def visible(text: str) -> str:
    """Write what `printable` does as escapes, but leave every kind of space and line end.

    Of a page the text is, which breaks lines as it needs, and has spaces that part no value and
    unit.
    """

    def sign(found: re.Match[str]) -> str:
        is_harmless = found[0].isprintable() or category(found[0]) == "Zs"
        return found[0] if is_harmless else escaped(found[0])

    return UNUSUAL.sub(sign, text)


def escaped(sign: str) -> str:
    """Write a sign in ASCII, as Python has it; a byte of a file name as that byte."""
    if ord(sign) in ESCAPED_BYTES:
        return f"\\x{ord(sign) - 0xDC00:02x}"
    return ascii(sign)[1:-1]


def shortened(text: str, most: int = LONGEST_MESSAGE) -> str:
    """Leave out the middle of a long text: its subject is first, the advice last."""
    if len(text) <= most:
        return text
    first = most // 2 - 1
    return f"{text[:first]} … {text[len(text) - (most - first - 3) :]}"


def quoting(text: str) -> str:
    """Make a message that quotes external text one line that is not too long."""
    return shortened(printable(text))


def said(error: BaseException) -> str:
    """Give the text of an error of the system or a library, or its kind if it has none."""
    return str(error).strip() or type(error).__name__


class RetropoleError(Exception):
    """Base of all errors raised by retropole; the message is one line that can be printed."""

    def __init__(self, message: str) -> None:
        super().__init__(quoting(message))


class ReadError(RetropoleError):
    """A file that cannot be read: names the file, the position and what was expected."""


class NewerError(ReadError):
    """A file that a newer version wrote: nothing is wrong with it, and it is to be kept.

    Parameters
    ----------
    what
        The file and its schema.
    """

    def __init__(self, what: str) -> None:
        super().__init__(f"{what} is from a newer version of retropole; update this one")


def is_newer(schema: str, known: str) -> bool:
    """Whether a schema, ``retropole/result/2``, is a later one of the same kind."""
    kind, _, number = schema.rpartition("/")
    own, _, ours = known.rpartition("/")
    digits = number if number.isascii() and number.isdigit() else "0"
    # Compared as text, since whoever wrote it may have written thousands of digits.
    later = (len(digits.lstrip("0")), digits.lstrip("0")) > (len(ours), ours)
    return kind == own and later


class UsageError(RetropoleError):
    """An invalid argument or option; the message uses the caller's terms."""


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
    """The data are not sufficient for an answer.

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
        # This is our text: nothing is left out.
        Exception.__init__(self, printable(message))
        self.code: Code = code
        self.message = str(self)
        self.values = dict(values or {})

    def __reduce__(self) -> tuple[type[Refusal], tuple[Code, str, dict[str, float | int | str]]]:
        """Rebuild from all three, so that a refusal can be passed between processes."""
        return Refusal, (self.code, self.message, self.values)

    @property
    def reason(self) -> Reason:
        """The same as a reason, for a verdict."""
        return Reason(self.code, self.message, self.values)


@dataclass(frozen=True, eq=False)
class Reason:
    """A remark on an answer: a stable code, a message with numbers, and the numbers."""

    code: Code
    message: str
    values: Mapping[str, float | int | str]

    def prefixed(self, prefix: Prefix) -> Reason:
        """Give the same with a prefix in front of its code: ``stored_few_points``."""
        return Reason(prefixed(prefix, self.code), self.message, self.values)


def warnings_and_notes(
    found: Iterable[Reason],
) -> tuple[tuple[Reason, ...], tuple[Reason, ...]]:
    """Separate reasons for doubt about an answer from notes on it (``reasons.toml``)."""
    every = tuple(found)
    notes = tuple(each for each in every if is_note(each.code))
    return tuple(each for each in every if not is_note(each.code)), notes


class LineError(ReadError):
    """An error in a line of a text, of which the number is known."""

    def __init__(self, line: int, message: str) -> None:
        super().__init__(f"line {line}: {message}")


@contextmanager
def naming(place: object, *, is_said_there: bool = False) -> Iterator[None]:
    """Add the name of the file, or of its part, to errors in it or errors of the system.

    Parameters
    ----------
    place
        The file or its part.
    is_said_there
        If an invalid option is an error in the file, since it is given there.

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
def refusing_of(what: str) -> Iterator[None]:
    """Add a name to a refusal; with an empty name it is unchanged.

    Raises
    ------
    Refusal
        In place of the same without the name.
    """
    try:
        yield
    except Refusal as refusal:
        if not what:
            raise
        raise Refusal(refusal.code, f"{what}: {refusal.message}", refusal.values) from None


@contextmanager
def readable(place: object) -> Iterator[None]:
    """Report an error of the system about a file or folder; all other errors name it themselves."""
    try:
        yield
    except OSError as error:
        raise ReadError(f"{place}: cannot be read ({error.strerror or said(error)})") from None


@contextmanager
def reported(what: str, remedy: str = "") -> Iterator[None]:
    """Turn any failure of a library into a `ReadError` with advice.

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
