"""The command `retropole`, also as `python -m retropole`.

What ends the process at any moment, while modules are loaded as well, ends it in order: unfinished
files are removed, one line says so, and the exit code is that of the signal.
"""

import sys

try:
    import os
    import signal
    from contextlib import suppress
except KeyboardInterrupt:  # before there is a handler
    sys.exit(130)

WORDS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}
SHOW_CURSOR = "\x1b[?25h"
"""Undoes what the progress on a terminal does."""


def _end(number: int, frame: object) -> None:
    """End the process at once: an exception may be lost in what is being loaded or computed."""
    files = sys.modules.get("retropole.base.files")
    for path in getattr(files, "unfinished", ()):
        with suppress(OSError):
            os.unlink(path)
    # Where a server does not answer, a second signal ends it.
    while leaving := getattr(files, "leaving", ()):
        with suppress(Exception):
            leaving.pop()()
    line = f"retropole: {WORDS[signal.Signals(number)]}\n"
    if os.isatty(2):
        line = f"{SHOW_CURSOR}\r{line}"
    try:
        os.write(2, line.encode())
    finally:
        os._exit(128 + number)


def _open_standard_streams() -> None:
    """Give each standard stream that is closed a place, which no other file may take.

    Reading finds nothing there, output goes nowhere, and printing an answer is an error.
    """
    for number, mode in ((0, os.O_RDONLY), (1, os.O_RDONLY), (2, os.O_WRONLY)):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, mode)
    sys.stdout = sys.stdout or open(1, "w", closefd=False)  # noqa: SIM115
    sys.stderr = sys.stderr or open(2, "w", closefd=False)  # noqa: SIM115


def main() -> None:
    """Run the command line, and end the process with its exit code."""
    _open_standard_streams()
    for number in WORDS:
        # Who starts a command in the background has it ignore interrupts.
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _end)
    from .cli import run

    code = run()
    try:
        sys.stdout.flush()
    except OSError:
        # What could not be printed was said; Python would try again, and end with 120.
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115
    sys.exit(code)


if __name__ == "__main__":
    main()
