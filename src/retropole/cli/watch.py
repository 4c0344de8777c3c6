"""The command ``retropole watch``."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Any

import click

from ..api.choices import SOURCE_KINDS
from ..result import CERTIFICATE, REPORT_FILE, RESULT_FILE, RunConfig
from .common import (
    EXIT_INTERRUPTED,
    EXIT_MOVED,
    EXIT_REFUSED,
    EXIT_WARNED,
    fill_in,
    say,
    show,
    show_written,
)
from .options import CLOUD, SENSORS, WANTED, Brief, Whole, more_option, run_option, run_options
from .out import out_folder

if TYPE_CHECKING:
    from ..api.watching import Watch
    from ..report.watch_server import WatchServer
    from ..result.watching import WatchDoc

CHECKED = {"same": 0, "moved": EXIT_MOVED, "cannot_tell": EXIT_REFUSED}

GRACE = 2.0
"""Time that work under way may take after a signal, s: then it waits for a file that never
ends, or for a program that does not answer, and is broken off."""


class BrokenOff(BaseException):
    """What was under way when a signal came did not end."""


class Stopped(Event):
    """Set by a signal; `code` is then the exit code."""

    code: int | None = None
    _can_break = False

    @contextmanager
    def breaking(self) -> Iterator[None]:
        """Break off the work within if it goes on for `GRACE` after a signal."""
        self._can_break = True
        try:
            with suppress(BrokenOff):
                yield
        finally:
            self._can_break = False

    def break_off(self, number: int, frame: object) -> None:
        """Break off what is under way: called by the alarm that follows the signal."""
        if self._can_break:
            raise BrokenOff


@click.command(cls=Brief)
@click.argument("target")
@click.argument("source")
@run_options("radius_m", SENSORS[0])
@run_option(SENSORS[1], more=True)
@run_options("need_m", "at_m", *WANTED)
@run_options("carried")
@more_option(
    "--sweeps",
    type=Whole(3, 100),
    default=15,
    help="Number of sweeps of each LiDAR kept for a placement.",
)
@click.option("--plan", type=CLOUD, help="Plan of the poles, with LiDARs named by --name.")
@more_option(
    "--name",
    "names",
    type=(str, str),
    metavar="TARGET SOURCE",
    help="Names of both LiDARs.  [default: by their topics, or target and source]",
)
@click.option(
    "--check",
    "stored",
    type=CLOUD,
    help="A result, or its folder, to check whether the LiDARs have moved since.",
)
@more_option("--domain", type=Whole(0, 232), help="Domain of ROS 2.  [default: ROS_DOMAIN_ID]")
@click.option("--interface", help="Network interface for ROS 2: eth0.  [default: all]")
@click.option(
    "--from",
    "senders",
    multiple=True,
    metavar="ADDRESS",
    help="IP address of a LiDAR that sends packets: packets of others are ignored. Repeat it for "
    "the other LiDAR.  [default: for each port, the address that sends most]",
)
@more_option("--port", type=Whole(0, 65535), default=0, help="Port of the page; 0: a free one.")
@click.option("--listen", is_flag=True, help="Serve the page to phones in the local network.")
@more_option("--no-page", is_flag=True, help="Serve no page.")
@click.option("--publish", is_flag=True, help="Publish the answer on /tf_static, if it is ok.")
@more_option("--publish-warned", is_flag=True, help="Publish an answer with a warning, too.")
@out_folder(
    "Folder for recordings and result.", RESULT_FILE, REPORT_FILE, *CERTIFICATE, keeping="stored"
)
@more_option("-q", "--quiet", is_flag=True, help="Print nothing but the address and errors.")
def watch(
    target: str,
    source: str,
    sweeps: int,
    plan: Path | None,
    names: tuple[str, str] | None,
    stored: Path | None,
    domain: int | None,
    interface: str | None,
    senders: tuple[str, ...],
    port: int,
    listen: bool,
    no_page: bool,
    publish: bool,
    publish_warned: bool,
    out: Path,
    quiet: bool,
    **options: Any,
) -> int:
    """Calibrate on site, at the poles: see the next thing to do, until the answer is good enough.

    TARGET and SOURCE are LiDARs that record now. The command shows which poles each one sees, and
    what to do next. When the poles are good and at rest it keeps sweeps, calibrates, and ends if
    the need is fulfilled (--need-cm and --at-m). Else it shows what to do for another placement.
    The folder gets the recordings (MCAP), the result, its report, and a certificate if the poles
    allow one.

    With --carried, one person walks with one pole: the command shows the path and how to continue,
    and ends by itself.

    \b
    Sources:
      SOURCES

    The page for a phone is for this computer alone (127.0.0.1), or with --listen for the local
    network, at a secret address that is shown as a QR code. It is not encrypted. Needs the extra
    'live' for topics, bags and the QR code; for packets 'velodyne' or 'ouster'.

    \b
    Examples:
      retropole watch ros2:/front/points ros2:/rear/points
      retropole watch ros2:/front/points ros2:/rear/points --need-cm 2 --at-m 30 --listen
      retropole watch velodyne:2368 velodyne:2369 --sensor VLP-16 --sensor auto
      retropole watch velodyne:2368 velodyne:2369 --from 192.168.1.201 --from 192.168.1.202
      retropole watch hesai:2368 hesai:2369 --angles front.csv --angles rear.csv
      retropole watch replay:drive.bag:/front replay:drive.bag:/rear
      retropole watch ros2:/front/points ros2:/rear/points --carried --need-cm 3 --at-m 30
      retropole watch ros2:/front/points ros2:/rear/points --check retropole-out

    \b
    Exit code:
      0    good enough; of --check: not moved
      1    ended before: there is an answer that is not good enough
      2    a source or an option is wrong
      3    ended without an answer; refused
      4    of --check: moved
      130  ended by Ctrl-C, with what was kept until then
    """
    from ..api.checking import read_stored
    from ..api.plan_checking import load_plan
    from ..api.watching import Source, Watch, Wish, check_publishing, names_of, open_sources
    from ..api.watching_walk import WalkWatch
    from ..report.text import legible
    from ..result import encode

    if options["at_m"] is not None and options["need_m"] is None:
        raise click.UsageError("--at-m is the distance at which --need-cm applies: give both")
    if options["carried"] and (plan is not None or stored is not None):
        raise click.UsageError("--plan and --check need fixed LiDARs and poles, without --carried")
    texts = target, source
    first, second = names or names_of(texts, ("target", "source"))
    if first == second:
        raise click.UsageError("both LiDARs have the same name")
    known = None if stored is None else read_stored(stored)
    read = RunConfig(**options)
    wanted = [read.of_target.wanted, read.of_source.wanted]
    if known is not None:
        before = known.config.of_target.wanted, known.config.of_source.wanted
        wanted = [each.or_known(own) for each, own in zip(wanted, before, strict=True)]
    wish = Wish(
        # What is kept of sweeps are clouds, with one intensity.
        RunConfig(**options | {field: None for pair in WANTED for field in pair[:2]}),
        (first, second),
        sweeps,
        None if plan is None else load_plan(plan, (first, second)),
        known,
    )
    latest: list[bytes] = [b"{}"]
    with ExitStack() as stack:
        stopped = stack.enter_context(until_signal())
        to_publish = ("ok", "warn") if publish_warned else ("ok",) if publish else ()
        if to_publish:
            check_publishing(domain=domain, interface=interface)
        sources = list[Source]()
        with stopped.breaking():
            sources = open_sources(
                texts, domain=domain, interface=interface, senders=senders, wanted=wanted
            )
        if not sources:
            return stopped.code or EXIT_INTERRUPTED
        made = (WalkWatch if options["carried"] else Watch)(sources, wish, out)
        stack.callback(lambda: _report(made.finish(), quiet))
        if not no_page:
            server = _served(lambda: latest[0], port, listen=listen)
            stack.callback(server.stop)
        view = stack.enter_context(_view(quiet))
        shown = None
        state: WatchDoc | None = None
        with stopped.breaking():
            while not (made.is_over or stopped.is_set()):
                begun = time.monotonic()
                # Topics, frames and faults are what others wrote.
                state = legible(made.step())
                latest[0] = encode(state)
                view(state)
                if to_publish and stored is None and made.result is None:
                    made.frames()
                if made.result is not shown:
                    shown = made.result
                    if shown is not None and shown.status in to_publish:
                        made.publish(domain=domain, interface=interface)
                    else:
                        made.withdraw()
                if not made.is_over:
                    # A step takes no less if nothing comes.
                    stopped.wait(max(0.02 - (time.monotonic() - begun), 0.0))
        if made.is_over and not no_page:
            # So that the page shows the end.
            stopped.wait(3.0)
        if made.published is not None and not stopped.is_set():
            say("retropole: published on /tf_static; Ctrl-C ends")
            stopped.wait()
    return _exit_code(made, state, stopped)


def _exit_code(made: Watch, said: WatchDoc | None, stopped: Stopped) -> int:
    if made.checked is not None:
        return CHECKED[made.checked.status]
    if made.is_over and said is not None and said.is_good:
        return 0
    if stopped.code is not None:
        return stopped.code
    if made.result is None or made.result.status == "refused":
        return EXIT_REFUSED
    return EXIT_WARNED


@contextmanager
def until_signal() -> Iterator[Stopped]:
    """Let the first Ctrl-C end in order, so that nothing is lost; a second ends at once.

    If a system has no alarms, as Windows, nothing is broken off after the first.
    """
    stopped = Stopped()
    has_alarm = hasattr(signal, "setitimer")
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def stop(number: int, frame: object) -> None:
        stopped.code = EXIT_INTERRUPTED if number == signal.SIGINT else 128 + 15
        stopped.set()
        for each, handler in before.items():
            signal.signal(each, handler)
        if has_alarm:
            signal.signal(signal.SIGALRM, stopped.break_off)
            signal.setitimer(signal.ITIMER_REAL, GRACE)

    for number, handler in before.items():
        if handler is not signal.SIG_IGN:
            signal.signal(number, stop)
    try:
        yield stopped
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if has_alarm and stopped.is_set():
            signal.setitimer(signal.ITIMER_REAL, 0)
            signal.signal(signal.SIGALRM, signal.SIG_DFL)


def _served(state: Callable[[], bytes], port: int, *, listen: bool) -> WatchServer:
    """Serve the page, and say where it is."""
    from ..report.watch_server import WatchServer, local_address, qr_code

    server = WatchServer(state, host=local_address() if listen else "127.0.0.1", port=port)
    if listen:
        show(qr_code(server.url))
    show(server.url)
    return server


def _report(written: list[Path], quiet: bool) -> None:
    if written and not quiet:
        show_written(*written)


@contextmanager
def _view(quiet: bool) -> Iterator[Callable[[WatchDoc], None]]:
    """Show the state on a terminal; in a pipe, a line for each new thing to do."""
    if quiet:
        fault = [""]

        def only_faults(said: WatchDoc) -> None:
            now = said.next if said.code == "not_written" else ""
            if now and not fault[0]:
                say(now)
            fault[0] = now

        yield only_faults
        return
    if not sys.stderr.isatty():
        last, noted, has_skipped = [""], list[str](), set[str]()

        def line(said: WatchDoc) -> None:
            for message in said.words:
                if message not in noted:
                    say(message)
            noted[:] = said.words
            # How many changes all the time: the first says it.
            for lidar in said.lidars:
                if lidar.skipped and lidar.name not in has_skipped:
                    say(lidar.skipped)
                    has_skipped.add(lidar.name)
            # Counts change with every sweep.
            if said.code != last[0]:
                say(said.next)
            last[0] = said.code

        yield line
        return
    from rich.console import Console
    from rich.live import Live

    from ..report.watch_terminal import drawn

    with Live(console=Console(stderr=True), auto_refresh=False, screen=False) as live:
        yield lambda said: live.update(drawn(said), refresh=True)


fill_in(watch, "SOURCES", SOURCE_KINDS, width=max(map(len, SOURCE_KINDS)))
