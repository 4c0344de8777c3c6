"""Serve the page of a watch and its state to those who know its address, on one address alone.

One request a connection, few connections, and none for long: whoever else is in the network can
neither read it nor keep others from it for more than moments.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
import socket
import threading
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from http import HTTPStatus
from ipaddress import ip_address
from typing import TYPE_CHECKING

from ..base.errors import MissingExtraError, UsageError
from .viewer_access import REFUSED, address_of, ip_of, knows, seal
from .watch_page import watch_page

if TYPE_CHECKING:
    import ssl

    from websockets.http11 import Request

    from .watch_certificate import Certificate

MOST_CONNECTIONS, MOST_OF_ONE = 64, 16
"""Connections at once, in all and of one address other than this machine's own."""

WAITING = 256
"""Connections that wait to be accepted; for those beyond, the other side tries again later."""

LONGEST_SECONDS = 5.0
"""From when a connection is accepted to when it is closed."""

LARGEST_REQUEST = 16_384
"""Bytes of a request line with its headers."""

HTML, JSON, TEXT = "text/html; charset=utf-8", "application/json", "text/plain; charset=utf-8"

# What others send is no line on a terminal.
_LOG = logging.getLogger(__name__)
_LOG.addHandler(logging.NullHandler())


class WatchServer:
    """A page of a watch that is served by a thread of its own, until it is stopped.

    Attributes
    ----------
    url
        Where the page is. Whoever knows it sees the watch.
    """

    def __init__(
        self,
        state: Callable[[], bytes],
        listener: socket.socket,
        address: str,
        context: ssl.SSLContext | None,
    ) -> None:
        self._token = secrets.token_urlsafe(16)
        self._origin = f"{'https' if context else 'http'}://{address}"
        self.url = f"{self._origin}/{self._token}/"
        self._state, self._address, self._context = state, address, context
        self._listener = listener
        self._open: Counter[str] = Counter()
        self._loop = asyncio.new_event_loop()
        self._loop.set_exception_handler(lambda _, what: _LOG.debug("%s", what["message"]))
        self._accepting = self._loop.create_task(self._accept())
        self._thread = threading.Thread(target=self._run, name="watch server", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop serving: all connections are closed, and the port is free."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._accepting.cancel)
            self._thread.join()

    def _run(self) -> None:
        with self._listener, suppress(asyncio.CancelledError):
            self._loop.run_until_complete(self._accepting)
        self._loop.close()

    async def _accept(self) -> None:
        async with asyncio.TaskGroup() as connections:
            while True:
                try:
                    connection, (host, *_) = await self._loop.sock_accept(self._listener)
                except OSError:
                    # Out of files, or gone before it was accepted.
                    await asyncio.sleep(0.1)
                    continue
                most = MOST_CONNECTIONS if ip_address(host).is_loopback else MOST_OF_ONE
                if self._open.total() >= MOST_CONNECTIONS or self._open[host] >= most:
                    connection.close()
                    continue
                self._open[host] += 1
                connections.create_task(self._serve(connection, host))

    async def _serve(self, connection: socket.socket, host: str) -> None:
        """Answer one request, in the time that there is."""
        try:
            async with asyncio.timeout(LONGEST_SECONDS):
                await self._converse(connection)
        except Exception as error:
            _LOG.debug("a connection failed: %s", error)
        finally:
            self._open[host] -= 1
            # An address that is gone is not counted for ever.
            self._open += Counter()

    async def _converse(self, connection: socket.socket) -> None:
        reader = asyncio.StreamReader(LARGEST_REQUEST)
        protocol = asyncio.StreamReaderProtocol(reader)
        # By default it waits 30 s for the other side's farewell.
        farewell = None if self._context is None else 1.0
        transport, _ = await self._loop.connect_accepted_socket(
            lambda: protocol, connection, ssl=self._context, ssl_shutdown_timeout=farewell
        )
        writer = asyncio.StreamWriter(transport, protocol, reader, self._loop)
        try:
            writer.write(self._answer(await _received(reader)))
            writer.close()
            await writer.wait_closed()
        finally:
            transport.abort()

    def _answer(self, request: Request | HTTPStatus) -> bytes:
        if isinstance(request, HTTPStatus):
            return _response(request, REFUSED.encode())
        if not self._may_see(request):
            return _response(HTTPStatus.FORBIDDEN, REFUSED.encode())
        if request.path == f"/{self._token}/":
            page = watch_page()
            return _response(HTTPStatus.OK, page.html.encode(), HTML, page.policy)
        if request.path == f"/{self._token}/state":
            return _response(HTTPStatus.OK, self._state(), JSON)
        return _response(HTTPStatus.NOT_FOUND, b"There is no such page.\n")

    def _may_see(self, request: Request) -> bool:
        """Refuse who does not know the token, other pages, other names (DNS rebinding), sockets."""
        headers = request.headers
        return (
            knows(request, self._token, self._address)
            and set(headers.get_all("Origin")) <= {self._origin}
            # Not sent by all browsers, nor over http to other machines. Another port of this one is
            # the same site.
            and set(headers.get_all("Sec-Fetch-Site")) <= {"same-origin", "none"}
            and "Upgrade" not in headers
        )


async def _received(reader: asyncio.StreamReader) -> Request | HTTPStatus:
    """Read a request; the status that refuses it where it is none that could be answered."""
    from websockets.http11 import Request
    from websockets.server import ServerProtocol

    try:
        head = await reader.readuntil(b"\r\n\r\n")
    except asyncio.LimitOverrunError:
        return HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE
    if not head.startswith(b"GET "):
        return HTTPStatus.METHOD_NOT_ALLOWED
    protocol = ServerProtocol(logger=_LOG)
    protocol.receive_data(head)
    first = next(iter(protocol.events_received()), None)
    return first if isinstance(first, Request) else HTTPStatus.BAD_REQUEST


def _response(
    status: HTTPStatus, body: bytes, kind: str = TEXT, policy: str = "default-src 'none'"
) -> bytes:
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    headers = Headers()
    headers["Content-Type"] = kind
    headers["Content-Length"] = str(len(body))
    headers["Connection"] = "close"
    if status == HTTPStatus.METHOD_NOT_ALLOWED:
        headers["Allow"] = "GET"
    seal(headers, policy)
    headers["Cross-Origin-Resource-Policy"] = "same-origin"
    return bytes(Response(status.value, status.phrase, headers, body).serialize())


def serve_watch(
    state: Callable[[], bytes],
    *,
    host: str = "127.0.0.1",
    port: int = 0,
    certificate: Certificate | None = None,
) -> WatchServer:
    """Serve the page of a watch, in the background.

    Parameters
    ----------
    state
        Gives the `WatchDoc` of now, as JSON; it is called by the thread that serves, for each
        request, and has to be quick.
    host
        The IP address to listen on, and no other; for one that is not this machine's alone there
        has to be a certificate.
    port
        0 for any that is free.
    certificate
        None to serve without encryption.

    Raises
    ------
    MissingExtraError
        Where websockets is not installed.
    UsageError
        Where the address cannot be listened on.
    """
    try:
        import websockets.server  # noqa: F401
    except ImportError:
        raise MissingExtraError("live", "a page that is served") from None

    address = ip_of(host)
    if address.is_unspecified:
        raise UsageError(f"{host} stands for all addresses of this machine: name the one to use")
    if certificate is None and not address.is_loopback:
        raise UsageError(f"{host} can be reached by others: it needs a certificate")
    family = socket.AF_INET6 if address.version == 6 else socket.AF_INET
    try:
        listener = socket.create_server((host, port), family=family, backlog=WAITING)
    except OSError as error:
        raise UsageError(f"port {port} of {host}: {error.strerror}") from None
    listener.setblocking(False)
    context = None if certificate is None else certificate.context
    where = address_of(host, listener.getsockname()[1], 443 if context else 80)
    return WatchServer(state, listener, where, context)
