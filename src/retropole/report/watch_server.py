"""The page of `retropole watch`, served to those who know its address, and how a phone finds it.

The page contains nothing of a watch itself: it fetches ``state`` next to it, a `WatchDoc`, again
and again. One request a connection, few connections, and none for long: whoever else is in the
network can neither request it without its address nor keep others from it for more than moments. It
is plain HTTP: who can read the traffic of the network reads it, too.
"""

from __future__ import annotations

import secrets
import socket
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from ipaddress import ip_address
from itertools import zip_longest
from socketserver import TCPServer, ThreadingMixIn
from string import Template
from threading import Thread
from time import monotonic

from ..base.errors import MissingExtraError, UsageError
from .page import asset, source_of

MOST_CONNECTIONS, MOST_OF_ONE = 64, 16
"""Connections at once, in all and of one address other than that of this machine."""

LONGEST_SECONDS = 5.0
"""From when a connection is accepted to when it is closed."""

REFUSED = b"Open the address as printed.\n"
"""The answer to those who do not know it."""


@cache
def watch_page() -> tuple[str, str]:
    """Assemble the page; and its policy, which allows only this style and code, by their
    hashes, and the state."""
    template, style, script = (asset(f"watch.{kind}") for kind in ("html", "css", "js"))
    policy = (
        f"default-src 'none'; script-src {source_of(script)}; style-src {source_of(style)}; "
        "img-src data:; connect-src 'self'; base-uri 'none'; form-action 'none'; "
        "frame-ancestors 'none'"
    )
    return Template(template).substitute(style=style, script=script), policy


class WatchServer(ThreadingMixIn, TCPServer):
    """A page of a watch that is served by separate threads, until it is stopped.

    Parameters
    ----------
    state
        Gives the `WatchDoc` of now, as JSON; it is called by a thread that serves, for each
        request, and has to be quick.
    host
        The IP address of this machine to listen on, and no other.
    port
        0 for any that is free.

    Attributes
    ----------
    url
        Where the page is. Whoever knows it sees the watch.

    Raises
    ------
    UsageError
        If the address cannot be listened on.
    """

    allow_reuse_address = True
    # For those beyond, the other side tries again later.
    request_queue_size = 256

    def __init__(
        self, state: Callable[[], bytes], *, host: str = "127.0.0.1", port: int = 0
    ) -> None:
        try:
            address = ip_address(host)
        except ValueError:
            raise UsageError(f"{host!r} is not an IP address") from None
        if address.is_unspecified:
            raise UsageError(f"{host} means all addresses of this machine: give the one to use")
        self.state = state
        self._open: dict[socket.socket, tuple[str, float]] = {}
        self.address_family = socket.AF_INET6 if address.version == 6 else socket.AF_INET
        try:
            super().__init__((host, port), _Answering)
        except OSError as error:
            raise UsageError(f"port {port} of {host}: {error.strerror}") from None
        where = f"[{host}]" if address.version == 6 else host
        own = self.server_address[1]
        # As browsers write it: without the port that the protocol has by default.
        self.host = where if own == 80 else f"{where}:{own}"
        self.path = f"/{secrets.token_urlsafe(16)}/"
        self.url = f"http://{self.host}{self.path}"
        self._thread = Thread(target=self.serve_forever, args=[0.1], daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop serving: all connections are closed, and the port is free."""
        self.shutdown()
        self._thread.join()
        self._close_older(0.0)
        self.server_close()

    def verify_request(self, request: object, client_address: object) -> bool:
        """Accept a connection where there are not too many."""
        assert isinstance(request, socket.socket)
        assert isinstance(client_address, tuple)
        host = client_address[0]
        hosts = [each for each, _ in list(self._open.values())]
        most = MOST_CONNECTIONS if ip_address(host).is_loopback else MOST_OF_ONE
        if len(hosts) >= MOST_CONNECTIONS or hosts.count(host) >= most:
            return False
        self._open[request] = host, monotonic()
        return True

    def service_actions(self) -> None:
        """Close connections of too long a time, which ends its thread: called again and
        again."""
        self._close_older(LONGEST_SECONDS)

    def _close_older(self, seconds: float) -> None:
        for connection, (_, since) in list(self._open.items()):
            if monotonic() - since >= seconds:
                with suppress(OSError):
                    connection.shutdown(socket.SHUT_RDWR)

    def shutdown_request(self, request: socket.socket | tuple[bytes, socket.socket]) -> None:
        """Release a connection."""
        super().shutdown_request(request)
        if isinstance(request, socket.socket):
            self._open.pop(request, None)

    def handle_error(self, request: object, client_address: object) -> None:
        """Write nothing: requests of others are not shown on a terminal."""


class _Answering(BaseHTTPRequestHandler):
    """Answers one request, and closes the connection."""

    server: WatchServer
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        """Give the page or the state to who may see it."""
        own = self.server.path
        if not self._may_see():
            self._answer(HTTPStatus.FORBIDDEN, REFUSED)
        elif self.path == own:
            html, policy = watch_page()
            self._answer(HTTPStatus.OK, html.encode(), "text/html; charset=utf-8", policy)
        elif self.path == f"{own}state":
            self._answer(HTTPStatus.OK, self.server.state(), "application/json")
        else:
            self._answer(HTTPStatus.NOT_FOUND, b"There is no such page.\n")

    def _may_see(self) -> bool:
        """Refuse who does not know the token, other pages, other names (DNS rebinding), sockets."""
        headers, host, own = self.headers, self.server.host, self.server.path
        given = self.path[: len(own)].encode("utf-8", "replace")
        return (
            secrets.compare_digest(given, own.encode())
            and headers.get_all("Host") == [host]
            and set(headers.get_all("Origin", [])) <= {f"http://{host}"}
            # Not sent by all browsers, nor over http to other machines. Another port of this one is
            # the same site.
            and set(headers.get_all("Sec-Fetch-Site", [])) <= {"same-origin", "none"}
            and "Upgrade" not in headers
        )

    def _answer(
        self, status: int, body: bytes, kind: str = "text/plain", policy: str = "default-src 'none'"
    ) -> None:
        self.send_response_only(status)
        for name, value in {
            "Content-Type": kind,
            "Content-Length": str(len(body)),
            "Connection": "close",
            # A page loads what its policy allows alone, is kept nowhere, and does not show its
            # address.
            "Content-Security-Policy": policy,
            "Cross-Origin-Resource-Policy": "same-origin",
            "Referrer-Policy": "no-referrer",
            "Cache-Control": "no-store",
            "X-Content-Type-Options": "nosniff",
        }.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Refuse an invalid request, or any but GET."""
        self._answer(code, REFUSED)

    def log_message(self, format: str, *args: object) -> None:
        """Write nothing."""


def local_address() -> str:
    """Find the address of this machine in the local network; nothing is sent.

    Raises
    ------
    UsageError
        If it is in none.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            # A datagram socket sends nothing to connect: it only chooses the way, here to an
            # address for documentation (RFC 5737), which is that to any other machine.
            probe.connect(("192.0.2.1", 9))
            address = str(probe.getsockname()[0])
        except OSError:
            address = "127.0.0.1"
    if ip_address(address).is_loopback or ip_address(address).is_unspecified:
        raise UsageError("this machine is in no network that a phone could join")
    return address


def qr_code(url: str) -> str:
    """Draw an address for a terminal, dark on light: two modules a character.

    Raises
    ------
    MissingExtraError
        Where segno is not installed.
    """
    try:
        import segno
    except ImportError:
        raise MissingExtraError("live", "a QR code") from None

    code = segno.make(url, error="l", micro=False)
    # Its standard requires four modules of light around it.
    rows = [[bool(module) for module in row] for row in code.matrix_iter(border=4)]
    light = [False] * len(rows[0])
    lines = (
        "".join(" ▄▀█"[2 * upper + lower] for upper, lower in zip(*pair, strict=True))
        for pair in zip_longest(rows[::2], rows[1::2], fillvalue=light)
    )
    # Black on white, whatever the colours of the terminal are.
    return "\n".join(f"\x1b[30;107m{line}\x1b[0m" for line in lines)
