"""Who may see the live viewer: whoever was given its address, and no page of another origin.

A browser lets any page it shows open a WebSocket to this machine, and viser answers all of them.
"""

from __future__ import annotations

import logging
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http import HTTPStatus
from typing import TYPE_CHECKING, Any

from ..base.errors import UsageError

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
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
        # Browsers leave out the port that http has by default.
        address = host if port == 80 else f"{host}:{port}"
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
        _, given, path = (*request.path.split("/", 2), "", "")[:3]
        known = secrets.compare_digest(given.encode("utf-8", "replace"), token.encode())
        if not known or request.headers.get_all("Host") != [address]:
            return connection.respond(HTTPStatus.FORBIDDEN, "Open the address as printed.\n")
        request.path = f"/{path}"
        response = answer(connection, request)
        if response is not None:
            response.headers["Content-Security-Policy"] = POLICY.format(socket=f"ws://{address}")
            response.headers["Referrer-Policy"] = "no-referrer"
            response.headers["Cache-Control"] = "no-store"
        return response

    return guard
