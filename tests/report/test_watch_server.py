"""The page of a watch is for those who know its address, however many others ask."""

from __future__ import annotations

import http.client
import socket
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from typing import Any
from urllib.parse import urlsplit

import pytest

from retropole.base.errors import MissingExtraError, UsageError
from retropole.report import watch_server
from retropole.report.watch_server import (
    MOST_CONNECTIONS,
    MOST_OF_ONE,
    WatchServer,
    local_address,
    qr_code,
    watch_page,
)

psutil = pytest.importorskip("psutil")

STATE = '{"seconds": 1.5, "next": "Lean pole A · é"}'.encode()
REFUSED = watch_server.REFUSED


@pytest.fixture(scope="module")
def server() -> Iterator[WatchServer]:
    server = WatchServer(lambda: STATE)
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
) -> tuple[int, bytes, dict[str, str]]:
    """Status, body and headers of an answer."""
    host, port, token = parts(server.url)
    client = http.client.HTTPConnection(host, port, timeout=10)
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
    assert (status, body) == (200, watch_page()[0].encode())
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
    other = WatchServer(lambda: b"{}")
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
    assert status == 501
    assert body in (REFUSED, b"")


@pytest.mark.parametrize(
    ("sent", "status"),
    [
        (b"\x00\xff\r\n\r\n", b""),
        (b"GET / HTTP/x\r\n\r\n", b""),
        (b"GET / HTTP/1.0\r\n\r\n", b"403"),
        (b"GET / HTTP/1.1\r\nno header\r\n\r\n", b"403"),
        (b"GET / HTTP/1.1\r\nContent-Length: 5\r\n\r\nhello", b"403"),
        (b"GET / HTTP/1.1\r\n" + b"a: b\r\n" * 300 + b"\r\n", b"431"),
        (b"GET /" + b"a" * 9000 + b" HTTP/1.1\r\n\r\n", b"403"),
        (b"GET /\xff\xfe/ HTTP/1.1\r\nHost: a\r\nHost: b\r\n\r\n", b"403"),
    ],
)
def test_what_is_no_request_leaves_no_line(
    server: WatchServer, sent: bytes, status: bytes, capfd: pytest.CaptureFixture[str]
) -> None:
    # A browser that speaks no HTTP/1.1 gets no head.
    assert raw(server, sent).startswith(b"HTTP/1.1 " + status if status else REFUSED)
    assert asked(server)[0] == 200
    assert capfd.readouterr() == ("", "")


def test_a_request_that_is_too_long_is_not_read(server: WatchServer) -> None:
    # What was not read may reset the connection before the answer is.
    assert raw(server, b"GET /" + b"a" * 1_000_000)[:12] in (b"HTTP/1.1 414", b"")
    assert asked(server)[0] == 200


def test_a_state_that_fails_closes_the_connection(capfd: pytest.CaptureFixture[str]) -> None:
    def broken() -> bytes:
        raise RuntimeError("broken")

    server = WatchServer(broken)
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
    server = WatchServer(lambda: STATE)
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
    server = WatchServer(lambda: b" " * 30_000_000)
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
    server = WatchServer(lambda: STATE)
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
    again = WatchServer(lambda: STATE, port=port)
    try:
        assert asked(again)[0] == 200
        with pytest.raises(UsageError, match=f"port {port} of 127.0.0.1"):
            WatchServer(lambda: STATE, port=port)
    finally:
        again.stop()


def test_a_server_that_is_stopped_at_once() -> None:
    for _ in range(20):
        WatchServer(lambda: STATE).stop()


@pytest.mark.parametrize(
    ("host", "words"),
    [
        ("0.0.0.0", "all addresses"),
        ("::", "all addresses"),
        ("localhost", "not an IP address"),
        ("192.0.2.7", "port 0 of 192.0.2.7"),
    ],
)
def test_where_it_does_not_listen(host: str, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        WatchServer(lambda: STATE, host=host)


def test_an_address_of_version_6() -> None:
    try:
        server = WatchServer(lambda: STATE, host="::1")
    except UsageError:
        pytest.skip("there is no IPv6 here")
    try:
        assert server.url.startswith("http://[::1]:")
        assert asked(server)[:2] == (200, STATE)
    finally:
        server.stop()


# --- in a network ---------------------------------------------------------------------------------


def test_of_one_other_address_there_are_fewer_connections() -> None:
    try:
        host = local_address()
    except UsageError:
        pytest.skip("this machine is in no network")
    server = WatchServer(lambda: STATE, host=host)
    where = parts(server.url)[:2]
    clients = [socket.create_connection(where, timeout=10) for _ in range(MOST_OF_ONE + 10)]
    try:
        assert number_closed(clients, 10, 4.0) == 10
        for client in clients:
            client.close()
        time.sleep(0.3)
        assert asked(server)[:2] == (200, STATE)
    finally:
        server.stop()


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


def test_without_segno_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "segno", None)
    with pytest.raises(MissingExtraError, match=r"retropole\[live\]"):
        qr_code("http://127.0.0.1/")
