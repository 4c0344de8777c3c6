"""The page of a watch is for those who know its address, however many others ask."""

from __future__ import annotations

import asyncio
import http.client
import socket
import ssl
import stat
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

from retropole.base.errors import MissingExtraError, UsageError
from retropole.report import watch_server
from retropole.report.watch_certificate import local_address, own_certificate, qr_code
from retropole.report.watch_page import watch_page
from retropole.report.watch_server import MOST_CONNECTIONS, MOST_OF_ONE, WatchServer, serve_watch

websockets = pytest.importorskip("websockets")
psutil = pytest.importorskip("psutil")

STATE = '{"seconds": 1.5, "next": "Lean pole A · é"}'.encode()
REFUSED = b"Open the address as printed.\n"


@pytest.fixture(scope="module")
def server() -> Iterator[WatchServer]:
    server = serve_watch(lambda: STATE)
    yield server
    server.stop()


def parts(url: str) -> tuple[str, int, str]:
    """Host, port and token of an address."""
    found = urlsplit(url)
    assert found.hostname is not None
    assert found.port is not None
    return found.hostname, found.port, found.path.strip("/")


def asked(
    server: WatchServer,
    path: str = "{token}/state",
    headers: dict[str, str] | None = None,
    method: str = "GET",
    context: ssl.SSLContext | None = None,
) -> tuple[int, bytes, dict[str, str]]:
    """Status, body and headers of an answer."""
    host, port, token = parts(server.url)
    client: http.client.HTTPConnection = http.client.HTTPConnection(host, port, timeout=10)
    if context is not None:
        client = http.client.HTTPSConnection(host, port, timeout=10, context=context)
    try:
        client.request(method, f"/{path.format(token=token)}", headers=headers or {})
        answer = client.getresponse()
        return answer.status, answer.read(), dict(answer.getheaders())
    finally:
        client.close()


def raw(server: WatchServer, sent: bytes) -> bytes:
    """All that comes back for some bytes."""
    with socket.create_connection(parts(server.url)[:2], timeout=10) as client:
        client.sendall(sent)
        received = b""
        try:
            while more := client.recv(4096):
                received += more
        except ConnectionResetError:
            pass
        return received


def test_state_and_page_go_through(server: WatchServer) -> None:
    status, body, headers = asked(server)
    assert (status, body, headers["Content-Type"]) == (200, STATE, "application/json")
    status, body, headers = asked(server, "{token}/")
    assert (status, body) == (200, watch_page().html.encode())
    assert headers["Content-Type"].startswith("text/html")
    assert asked(server, "{token}/other")[0] == 404
    assert asked(server, "{token}/state?x")[0] == 404


@pytest.mark.parametrize("path", ["{token}/", "{token}/state", "{token}/other", ""])
def test_nothing_is_kept_loaded_or_framed(server: WatchServer, path: str) -> None:
    _, _, headers = asked(server, path)
    policy = headers["Content-Security-Policy"]
    assert policy.startswith("default-src 'none'")
    assert "unsafe" not in policy
    assert "//" not in policy
    assert headers["Referrer-Policy"] == "no-referrer"
    assert headers["Cache-Control"] == "no-store"
    assert headers["X-Content-Type-Options"] == "nosniff"
    assert "Server" not in headers
    if path == "{token}/":
        assert "frame-ancestors 'none'" in policy


@pytest.mark.parametrize(
    "path",
    ["", "state", "x/state", "{token}x/", "x{token}/state", "x/{token}/", "?{token}", "%20/"],
)
def test_without_the_token_is_refused(server: WatchServer, path: str) -> None:
    assert asked(server, path)[:2] == (403, REFUSED)


def test_a_token_is_long_and_of_one_server(server: WatchServer) -> None:
    other = serve_watch(lambda: b"{}")
    try:
        _, _, token = parts(server.url)
        assert len(token) >= 22, "128 bits"
        assert asked(other, f"{token}/state")[0] == 403
        assert asked(server, f"{token.swapcase()}/state")[0] == 403
    finally:
        other.stop()


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "elsewhere.example"},
        {"Host": "elsewhere.example:{port}"},
        {"Host": "localhost:{port}"},
        {"Host": "127.0.0.1"},
        {"Host": "127.0.0.1:1"},
        {"Origin": "null"},
        {"Origin": "http://elsewhere.example"},
        {"Origin": "http://127.0.0.1"},
        {"Origin": "http://localhost:{port}"},
        {"Origin": "https://127.0.0.1:{port}"},
        {"Sec-Fetch-Site": "cross-site"},
        {"Sec-Fetch-Site": "same-site"},
        {"Connection": "Upgrade", "Upgrade": "websocket"},
    ],
)
def test_others_are_refused_also_with_the_token(
    server: WatchServer, headers: dict[str, str]
) -> None:
    port = parts(server.url)[1]
    given = {name: value.format(port=port) for name, value in headers.items()}
    for path in ("{token}/", "{token}/state"):
        assert asked(server, path, given)[:2] == (403, REFUSED)


@pytest.mark.parametrize(
    "headers",
    [
        {"Sec-Fetch-Site": "same-origin"},
        {"Sec-Fetch-Site": "none"},
        {"Origin": "http://127.0.0.1:{port}"},
    ],
)
def test_the_page_itself_is_answered(server: WatchServer, headers: dict[str, str]) -> None:
    port = parts(server.url)[1]
    given = {name: value.format(port=port) for name, value in headers.items()}
    assert asked(server, headers=given)[:2] == (200, STATE)


@pytest.mark.parametrize("method", ["HEAD", "POST", "PUT", "DELETE", "OPTIONS", "PATCH", "GET2"])
def test_other_methods_are_refused(server: WatchServer, method: str) -> None:
    status, body, _ = asked(server, method=method)
    assert status == 405
    assert body in (REFUSED, b"")


def test_a_websocket_is_refused(server: WatchServer) -> None:
    async def opened() -> None:
        async with websockets.connect(server.url.replace("http", "ws") + "state"):
            pass

    with pytest.raises(websockets.exceptions.InvalidStatus) as refused:
        asyncio.run(opened())
    assert refused.value.response.status_code == 403


@pytest.mark.parametrize(
    ("sent", "status"),
    [
        (b"\r\n\r\n", b"405"),
        (b"\x00\xff\r\n\r\n", b"405"),
        (b"GET /\r\n\r\n", b"400"),
        (b"GET / HTTP/1.0\r\n\r\n", b"400"),
        (b"GET / HTTP/1.1\r\nno header\r\n\r\n", b"400"),
        (b"GET / HTTP/1.1\r\nContent-Length: 5\r\n\r\nhello", b"400"),
        (b"GET / HTTP/1.1\r\n" + b"a: b\r\n" * 300 + b"\r\n", b"400"),
        (b"GET /" + b"a" * 9000 + b" HTTP/1.1\r\n\r\n", b"400"),
        (b"GET /\xff\xfe/ HTTP/1.1\r\nHost: a\r\nHost: b\r\n\r\n", b"403"),
    ],
)
def test_what_is_no_request_leaves_no_line(
    server: WatchServer, sent: bytes, status: bytes, capfd: pytest.CaptureFixture[str]
) -> None:
    assert raw(server, sent).startswith(b"HTTP/1.1 " + status)
    assert asked(server)[0] == 200
    assert capfd.readouterr() == ("", "")


def test_a_request_that_is_too_long_is_not_read(server: WatchServer) -> None:
    # What was not read may reset the connection before the answer is.
    assert raw(server, b"GET /" + b"a" * 1_000_000)[:12] in (b"HTTP/1.1 431", b"")
    assert asked(server)[0] == 200


def test_a_state_that_fails_closes_the_connection(capfd: pytest.CaptureFixture[str]) -> None:
    def broken() -> bytes:
        raise RuntimeError("broken")

    server = serve_watch(broken)
    try:
        with pytest.raises(http.client.RemoteDisconnected):
            asked(server)
        assert asked(server, "{token}/")[0] == 200
    finally:
        server.stop()
    assert capfd.readouterr() == ("", "")


# --- many, and slow ------------------------------------------------------------------------------


def is_closed(client: socket.socket) -> bool:
    """Whether the other side has closed a connection on which it sent nothing."""
    client.setblocking(False)
    try:
        return client.recv(1) == b""
    except BlockingIOError:
        return False
    except OSError:
        return True


def number_closed(clients: Sequence[socket.socket], expected: int, within_s: float) -> int:
    """How many connections the other side has closed; so long is waited for as many as expected."""
    until = time.monotonic() + within_s
    while (closed := sum(map(is_closed, clients))) < expected and time.monotonic() < until:
        time.sleep(0.02)
    return closed


@pytest.fixture
def many_files() -> Iterator[None]:
    """Let this process hold a few thousand sockets."""
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    most = before[1] if before[1] != resource.RLIM_INFINITY else 4096
    if most < 2048:
        pytest.skip("a process may hold too few files here")
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(before[0], min(4096, most)), before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, before)


@pytest.mark.usefixtures("many_files")
def test_a_thousand_connections_are_few_and_then_gone(
    server: WatchServer, capfd: pytest.CaptureFixture[str]
) -> None:
    where = parts(server.url)[:2]
    clients = []
    try:
        for k in range(1000):
            clients.append(socket.create_connection(where, timeout=10))
            if k % 2:
                clients[-1].send(b"GET / HTTP/1.1\r\nHost: a\r\n")
        until = time.monotonic() + 10
        left = 1000
        while left > MOST_CONNECTIONS and time.monotonic() < until:
            time.sleep(0.05)
            left = sum(not is_closed(client) for client in clients)
        assert 0 < left <= MOST_CONNECTIONS
    finally:
        for client in clients:
            client.close()
    time.sleep(0.2)
    assert [asked(server)[:2] for _ in range(20)] == [(200, STATE)] * 20
    assert capfd.readouterr() == ("", "")


def test_who_says_nothing_is_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    assert watch_server.LONGEST_SECONDS == 5.0
    monkeypatch.setattr(watch_server, "LONGEST_SECONDS", 0.5)
    server = serve_watch(lambda: STATE)
    where = parts(server.url)[:2]
    clients = [socket.create_connection(where, timeout=10) for _ in range(MOST_CONNECTIONS)]
    try:
        began = time.monotonic()
        # One byte at a time is no request either.
        while not is_closed(clients[0]):
            clients[0].send(b"G")
            time.sleep(0.05)
        assert 0.3 < time.monotonic() - began < 10
        assert asked(server)[0] == 200
        while not all(map(is_closed, clients[1:])):
            time.sleep(0.05)
            assert time.monotonic() - began < 10
    finally:
        for client in clients:
            client.close()
        server.stop()


def test_who_does_not_read_is_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watch_server, "LONGEST_SECONDS", 0.5)
    server = serve_watch(lambda: b" " * 30_000_000)
    host, port, token = parts(server.url)
    try:
        with socket.create_connection((host, port), timeout=10) as client:
            client.sendall(f"GET /{token}/state HTTP/1.1\r\nHost: {host}:{port}\r\n\r\n".encode())
            time.sleep(1.0)
            assert not server._open
    finally:
        server.stop()


# --- where it listens ----------------------------------------------------------------------------


def listening() -> set[tuple[str, int]]:
    own = psutil.Process().net_connections(kind="inet")
    return {(c.laddr.ip, c.laddr.port) for c in own if c.status == psutil.CONN_LISTEN}


def test_it_listens_on_one_port_until_it_is_stopped() -> None:
    before, threads = listening(), set(threading.enumerate())
    server = serve_watch(lambda: STATE)
    host, port, _ = parts(server.url)
    assert listening() - before == {(host, port)}
    assert host == "127.0.0.1"
    with socket.create_connection((host, port), timeout=10) as idle:
        asked(server)
        server.stop()
        assert is_closed(idle)
    server.stop()
    assert listening() == before
    assert set(threading.enumerate()) == threads
    again = serve_watch(lambda: STATE, port=port)
    try:
        assert asked(again)[0] == 200
        with pytest.raises(UsageError, match=f"port {port} of 127.0.0.1"):
            serve_watch(lambda: STATE, port=port)
    finally:
        again.stop()


def test_a_server_that_is_stopped_at_once() -> None:
    for _ in range(20):
        serve_watch(lambda: STATE).stop()


@pytest.mark.parametrize(
    ("host", "words"),
    [
        ("0.0.0.0", "all addresses"),
        ("::", "all addresses"),
        ("localhost", "no IP address"),
        ("192.168.1.2", "needs a certificate"),
    ],
)
def test_where_it_does_not_listen(host: str, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        serve_watch(lambda: STATE, host=host)


def test_an_address_of_version_6() -> None:
    try:
        server = serve_watch(lambda: STATE, host="::1")
    except UsageError:
        pytest.skip("there is no IPv6 here")
    try:
        assert server.url.startswith("http://[::1]:")
        assert asked(server)[:2] == (200, STATE)
    finally:
        server.stop()


# --- encrypted, in a network ---------------------------------------------------------------------


def pinned(pem: str) -> ssl.SSLContext:
    return ssl.create_default_context(cadata=pem)


def test_tls_with_the_certificate_pinned(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    certificate = own_certificate("127.0.0.1", tmp_path)
    other = own_certificate("127.0.0.1", None)
    server = serve_watch(lambda: STATE, certificate=certificate)
    try:
        assert server.url.startswith("https://127.0.0.1:")
        assert asked(server, context=pinned(certificate.pem))[:2] == (200, STATE)
        with pytest.raises(ssl.SSLCertVerificationError):
            asked(server, context=pinned(other.pem))
        # Without encryption there is no answer.
        assert b"HTTP" not in raw(server, b"GET / HTTP/1.1\r\n\r\n")
        origin = {"Origin": server.url.replace("https", "http").rsplit("/", 2)[0]}
        assert asked(server, headers=origin, context=pinned(certificate.pem))[0] == 403
    finally:
        server.stop()
    assert list(tmp_path.iterdir()) == []
    assert capfd.readouterr() == ("", "")


def test_a_handshake_that_does_not_come_is_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watch_server, "LONGEST_SECONDS", 2.0)
    certificate = own_certificate("127.0.0.1", None)
    server = serve_watch(lambda: STATE, certificate=certificate)
    where = parts(server.url)[:2]
    clients = [socket.create_connection(where, timeout=10) for _ in range(MOST_CONNECTIONS + 5)]
    try:
        assert number_closed(clients, 5, 1.5) == 5
        assert number_closed(clients, len(clients), 10.0) == len(clients)
        assert asked(server, context=pinned(certificate.pem))[0] == 200
    finally:
        for client in clients:
            client.close()
        server.stop()


def test_of_one_other_address_there_are_fewer_connections() -> None:
    try:
        host = local_address()
    except UsageError:
        pytest.skip("this machine is in no network")
    certificate = own_certificate(host, None)
    server = serve_watch(lambda: STATE, host=host, certificate=certificate)
    where = parts(server.url)[:2]
    clients = [socket.create_connection(where, timeout=10) for _ in range(MOST_OF_ONE + 10)]
    try:
        assert number_closed(clients, 10, 4.0) == 10
        for client in clients:
            client.close()
        time.sleep(0.3)
        assert asked(server, context=pinned(certificate.pem))[:2] == (200, STATE)
    finally:
        server.stop()


def test_what_a_certificate_says() -> None:
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes
    from cryptography.hazmat.primitives.asymmetric import ec

    made = own_certificate("192.168.7.5", None)
    read = x509.load_pem_x509_certificate(made.pem.encode())
    names = read.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert [str(name) for name in names.get_values_for_type(x509.IPAddress)] == ["192.168.7.5"]
    key = read.public_key()
    assert isinstance(key, ec.EllipticCurvePublicKey)
    assert key.curve.name == "secp256r1"
    lasts = read.not_valid_after_utc - read.not_valid_before_utc
    assert lasts.days == 8, "seven from now on, and one for slow clocks"
    assert made.fingerprint.replace(":", "") == read.fingerprint(hashes.SHA256()).hex().upper()
    assert len(made.fingerprint) == 3 * 32 - 1
    assert "PRIVATE" not in made.pem
    with pytest.raises(UsageError, match="no IP address"):
        own_certificate("localhost", None)


def test_the_key_is_for_this_user_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[tuple[int, int, bytes]] = []

    load = ssl.SSLContext.load_cert_chain

    def watched(context: ssl.SSLContext, path: Path, **options: Any) -> None:
        modes = stat.S_IMODE(path.stat().st_mode), stat.S_IMODE(path.parent.stat().st_mode)
        seen.append((*modes, path.read_bytes()))
        load(context, path, **options)

    monkeypatch.setattr(ssl.SSLContext, "load_cert_chain", watched)
    own_certificate("127.0.0.1", tmp_path)
    [(file, folder, text)] = seen
    assert (file, folder) == (0o600, 0o700)
    assert b"ENCRYPTED PRIVATE KEY" in text
    assert list(tmp_path.iterdir()) == []


class NoWay(socket.socket):
    def connect(self, address: Any) -> None:
        raise OSError(101, "Network is unreachable")


class OnlySelf(socket.socket):
    def connect(self, address: Any) -> None:
        super().connect(("127.0.0.1", 9))


@pytest.mark.parametrize("kind", [NoWay, OnlySelf])
def test_a_machine_in_no_network(monkeypatch: pytest.MonkeyPatch, kind: type) -> None:
    monkeypatch.setattr(socket, "socket", kind)
    with pytest.raises(UsageError, match="in no network"):
        local_address()


def test_a_qr_code_is_dark_on_light() -> None:
    segno = pytest.importorskip("segno")
    url = "https://192.168.178.100:54321/AbCdEfGhIjKlMnOpQrStUv/"
    lines = qr_code(url).split("\n")
    drawn: list[list[int]] = []
    for line in lines:
        assert line.startswith("\x1b[30;107m")
        assert line.endswith("\x1b[0m")
        signs = [" ▄▀█".index(sign) for sign in line[9:-4]]
        drawn += [[sign >> 1 for sign in signs], [sign & 1 for sign in signs]]
    code = segno.make(url, error="l", micro=False)
    wanted = [[int(module) for module in row] for row in code.matrix_iter(border=4)]
    assert drawn[: len(wanted)] == wanted
    assert not any(map(any, drawn[len(wanted) :]))
    assert len(lines) <= 22
    assert max(len(line) for line in lines) - 13 <= 45


@pytest.mark.parametrize(
    ("module", "call"),
    [
        ("segno", lambda: qr_code("http://127.0.0.1/")),
        ("cryptography", lambda: own_certificate("127.0.0.1", None)),
        ("websockets.server", lambda: serve_watch(lambda: b"")),
    ],
)
def test_what_is_absent_is_named(monkeypatch: pytest.MonkeyPatch, module: str, call: Any) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingExtraError, match=r"retropole\[live\]"):
        call()
