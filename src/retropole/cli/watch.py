"""The command ``retropole watch``."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Any

import click

from ..api.choices import SOURCE_KINDS
from ..result import RunConfig
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
from .older import DEFAULT_OUT, set_older_aside
from .options import OUT, run_options

if TYPE_CHECKING:
    from ..api.watching import Watch
    from ..report.watch_server import WatchServer
    from ..result.watching import WatchDoc

CHECKED = {"same": 0, "moved": EXIT_MOVED, "cannot_tell": EXIT_REFUSED}

TERMINATED = 128 + 15

SHORTEST = 0.02
"""A step takes no less, s, where nothing comes."""

PAGE_SECONDS = 3.0
"""The page is served for so much longer, s, so that it shows the end."""


class Stopped(Event):
    """Set by a signal; `code` is then the exit code."""

    code: int | None = None


@click.command()
@click.argument("target")
@click.argument("source")
@run_options("radius_m", "sensor_target", "sensor_source", "threshold_target", "threshold_source")
@run_options("need_m", "at_m")
@click.option(
    "--sweeps",
    type=click.IntRange(3, 100),
    default=15,
    help="Of each LiDAR that are kept of a placement.",
)
@click.option(
    "--plan",
    type=click.Path(path_type=Path),
    help="Folder of a plan: it says where each pole should stand. Its LiDARs are named by --name.",
)
@click.option(
    "--name",
    "names",
    type=(str, str),
    metavar="TARGET SOURCE",
    help="What words call both LiDARs.  [default: by their topics, or target and source]",
)
@click.option(
    "--check",
    "stored",
    type=click.Path(path_type=Path),
    help="A result, or its folder: say whether the LiDARs stand where they stood.",
)
@click.option("--domain", type=click.IntRange(0, 232), help="Of ROS 2.  [default: ROS_DOMAIN_ID]")
@click.option("--interface", help="Network interface for ROS 2: eth0.  [default: all]")
@click.option(
    "--port", type=click.IntRange(0, 65535), default=0, help="Of the page; 0: a free one."
)
@click.option("--listen", is_flag=True, help="Serve the page to phones in the local network.")
@click.option("--no-page", is_flag=True, help="Serve no page.")
@click.option("--publish", is_flag=True, help="Publish the answer on /tf_static, if it is ok.")
@click.option("--publish-warned", is_flag=True, help="Publish it with a warning, too.")
@click.option("--out", type=OUT, default=DEFAULT_OUT, help="Folder for recordings and result.")
@click.option("-q", "--quiet", is_flag=True, help="Print nothing but the address and errors.")
def watch(
    target: str,
    source: str,
    sweeps: int,
    plan: Path | None,
    names: tuple[str, str] | None,
    stored: Path | None,
    domain: int | None,
    interface: str | None,
    port: int,
    listen: bool,
    no_page: bool,
    publish: bool,
    publish_warned: bool,
    out: Path,
    quiet: bool,
    **options: Any,
) -> int:
    """Stand beside the poles, and be told the next thing to do, until the answer is good enough.

    TARGET and SOURCE are LiDARs that record now. The command says which poles each one sees, and
    what to do next; while all is good and still it keeps sweeps, calibrates, and ends when the need
    is met (--need-cm and --at-m). Else it says what to do for another placement. The folder gets
    the recordings (MCAP), the result, its report, and a certificate where the poles allow one.

    \b
    Sources:
      SOURCES

    The page for a phone is for this computer alone (127.0.0.1), or with --listen for the local
    network: with a secret address that is shown as a QR code, and a certificate of its own, which
    the phone asks to trust. Needs the extra 'live'; for packets 'velodyne' or 'ouster' too.

    \b
    Examples:
      retropole watch ros2:/front/points ros2:/rear/points
      retropole watch ros2:/front/points ros2:/rear/points --need-cm 2 --at-m 30 --listen
      retropole watch velodyne:2368 velodyne:2369 --sensor-target VLP-16
      retropole watch ouster:7502:front.json ros2:/rear/points --interface eth0
      retropole watch folder:in/front folder:in/rear --plan retropole-plan
      retropole watch replay:drive.bag:/front replay:drive.bag:/rear
      retropole watch ros2:/front/points ros2:/rear/points --publish
      retropole watch ros2:/front/points ros2:/rear/points --check retropole-out

    \b
    Exit code:
      0    good enough; of --check: they stand where they stood
      1    ended before: there is an answer that is not good enough
      2    a source or an option is wrong
      3    ended without an answer; refused
      4    of --check: moved
      130  ended by Ctrl-C, with what was kept until then
    """
    from ..api.checking import read_stored
    from ..api.plan_checking import load_plan
    from ..api.watching import Watch, Wish, names_of, open_sources
    from ..result import encode

    if options["at_m"] is not None and options["need_m"] is None:
        raise click.UsageError("--at-m says how far away --need-cm must hold: give both")
    texts = target, source
    first, second = names or names_of(texts, ("target", "source"))
    if first == second:
        raise click.UsageError("both LiDARs have the same name")
    wish = Wish(
        RunConfig(**options),
        (first, second),
        sweeps,
        None if plan is None else load_plan(plan, (first, second)),
        None if stored is None else read_stored(stored),
    )
    latest: list[bytes] = [b"{}"]
    with ExitStack() as stack:
        stopped = stack.enter_context(_until_signal())
        made = Watch(open_sources(texts, domain=domain, interface=interface), wish, out)
        stack.callback(lambda: _told(made.finish(), quiet))
        if not no_page:
            server = _served(lambda: latest[0], port, listen=listen)
            stack.callback(server.stop)
        view = stack.enter_context(_view(quiet))
        to_publish = ("ok", "warn") if publish_warned else ("ok",) if publish else ()
        published = None
        shown = None
        while True:
            begun = time.monotonic()
            said = made.step()
            latest[0] = encode(said)
            view(said)
            if made.result is not shown:
                shown = made.result
                if shown is not None and shown.status in to_publish:
                    published = made.publish(domain=domain, interface=interface)
            if made.is_over or stopped.is_set():
                break
            stopped.wait(max(SHORTEST - (time.monotonic() - begun), 0.0))
        if made.is_over and not no_page:
            stopped.wait(PAGE_SECONDS)
        if published is not None and not stopped.is_set():
            say("retropole: published on /tf_static; Ctrl-C ends")
            stopped.wait()
    if made.result is None and stored is None:
        set_older_aside(out)
    return _exit_code(made, said, stopped)


def _exit_code(made: Watch, said: WatchDoc, stopped: Stopped) -> int:
    if made.checked is not None:
        return CHECKED[made.checked.status]
    if made.is_over and said.is_good:
        return 0
    if stopped.code is not None:
        return stopped.code
    if made.result is None or made.result.status == "refused":
        return EXIT_REFUSED
    return EXIT_WARNED


@contextmanager
def _until_signal() -> Iterator[Stopped]:
    """Let the first Ctrl-C end in order, so that nothing is lost; a second ends at once."""
    stopped = Stopped()
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def stop(number: int, frame: object) -> None:
        stopped.code = EXIT_INTERRUPTED if number == signal.SIGINT else TERMINATED
        stopped.set()
        for each, handler in before.items():
            signal.signal(each, handler)

    for number, handler in before.items():
        if handler is not signal.SIG_IGN:
            signal.signal(number, stop)
    try:
        yield stopped
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _served(state: Callable[[], bytes], port: int, *, listen: bool) -> WatchServer:
    """Serve the page, and say where it is."""
    from ..report.watch_certificate import local_address, own_certificate, qr_code
    from ..report.watch_server import serve_watch

    if not listen:
        server = serve_watch(state, port=port)
        show(server.url)
        return server
    host = local_address()
    certificate = own_certificate(host, None)
    server = serve_watch(state, host=host, port=port, certificate=certificate)
    show(qr_code(server.url))
    show(server.url)
    say(f"The certificate that the phone asks to trust has SHA-256 {certificate.fingerprint}")
    return server


def _told(written: list[Path], quiet: bool) -> None:
    if written and not quiet:
        show_written(*written)


@contextmanager
def _view(quiet: bool) -> Iterator[Callable[[WatchDoc], None]]:
    """Show the state on a terminal; in a pipe, a line for each new thing to do."""
    if quiet:
        yield lambda said: None
        return
    if not sys.stderr.isatty():
        last, noted = [""], list[str]()

        def line(said: WatchDoc) -> None:
            for words in said.words:
                if words not in noted:
                    say(words)
            noted[:] = said.words
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
