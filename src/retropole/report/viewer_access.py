"""Who may see a page that is served: whoever was given its address, and no page of another origin.

A browser lets any page it shows open a WebSocket to this machine, and viser, which serves the live
viewer, answers all of them.
"""

from __future__ import annotations

import logging
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http import HTTPStatus
from ipaddress import IPv4Address, IPv6Address, ip_address
from typing import TYPE_CHECKING, Any

from ..base.errors import UsageError

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.datastructures import Headers
    from websockets.http11 import Request, Response

    Answer = Callable[[ServerConnection, Request], Response | None]

# Refused handshakes, and what is no HTTP at all, are no lines on a terminal.
_LOG = logging.getLogger(__name__)
_LOG.addHandler(logging.NullHandler())

POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'wasm-unsafe-eval' blob:; "
    "style-src 'unsafe-inline'; img-src data: blob:; font-src data:; worker-src blob: data:; "
    "connect-src data: blob: {socket}; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""What the page may load: nothing but itself. viser puts its code and styles into it inline."""

REFUSED = "Open the address as printed.\n"
"""All that those are told who do not know it."""


def address_of(host: str, port: int, default: int = 80) -> str:
    """Write host and port as browsers do: without the port that the protocol has by default."""
    host = f"[{host}]" if ":" in host else host
    return host if port == default else f"{host}:{port}"


def ip_of(host: str) -> IPv4Address | IPv6Address:
    """Read an IP address.

    Raises
    ------
    UsageError
        Where it is none.
    """
    try:
        return ip_address(host)
    except ValueError:
        raise UsageError(f"{host!r} is no IP address") from None


def knows(request: Request, token: str, address: str) -> bool:
    """Tell whether a request is for something below ``/TOKEN``, at this address and no other."""
    given = (*request.path.split("/", 2), "")[1]
    known = secrets.compare_digest(given.encode("utf-8", "replace"), token.encode())
    return known and request.headers.get_all("Host") == [address]


def seal(headers: Headers, policy: str) -> None:
    """Have a page load what its policy allows alone, be kept nowhere, and not tell its address."""
    headers["Content-Security-Policy"] = policy
    headers["Referrer-Policy"] = "no-referrer"
    headers["Cache-Control"] = "no-store"
    headers["X-Content-Type-Options"] = "nosniff"


@contextmanager
def guarded(token: str) -> Iterator[None]:
    """Serve what viser starts in this context to those alone who know a token.

    Everything is below ``/TOKEN/``, pages and WebSocket. The Host has to be the address that is
    listened on, else another name could be made to point to it (DNS rebinding), and a WebSocket
    has to come from a page of that address.

    Raises
    ------
    UsageError
        Where viser no longer serves in the one way that is known here.
    """
    import websockets.asyncio.server as websockets_server
    from websockets.typing import Origin

    serve = websockets_server.serve
    guards = 0

    # viser takes no hook of its own, and looks this function up where it starts.
    def serve_guarded(
        handler: Any, host: str, port: int, *, process_request: Answer, **options: Any
    ) -> Any:
        nonlocal guards
        guards += 1
        address = address_of(host, port)
        return serve(
            handler,
            host,
            port,
            process_request=_for_those_who_know(token, address, process_request),
            origins=[Origin(f"http://{address}")],
            logger=_LOG,
            **options,
        )

    setattr(websockets_server, "serve", serve_guarded)  # noqa: B010
    try:
        yield
    finally:
        setattr(websockets_server, "serve", serve)  # noqa: B010
    if not guards:
        raise UsageError("this version of viser cannot be guarded: install viser 1.1.1")


def _for_those_who_know(token: str, address: str, answer: Answer) -> Answer:
    """Answer requests to ``/TOKEN/…`` at an address; refuse all others."""

    def guard(connection: ServerConnection, request: Request) -> Response | None:
        if not knows(request, token, address):
            return connection.respond(HTTPStatus.FORBIDDEN, REFUSED)
        request.path = f"/{(*request.path.split('/', 2), '')[2]}"
        response = answer(connection, request)
        if response is not None:
            seal(response.headers, POLICY.format(socket=f"ws://{address}"))
        return response

    return guard
