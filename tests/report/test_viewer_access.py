"""Only who was given the viewer's address gets an answer, and no page of another origin does."""

from __future__ import annotations

import asyncio
import socket
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from retropole.base.errors import UsageError
from retropole.report.viewer import Viewer, serve
from retropole.report.viewer_access import guarded
from tests.report.browser import Browser, WebDriverWait, needs_browser
from tests.report.test_viewer import shown, two_poles

viser = pytest.importorskip("viser", reason="viser is not installed (extra 'view')")
websockets = pytest.importorskip("websockets")
PROTOCOL = f"viser-v{viser.__version__}"


@pytest.fixture(scope="module")
def viewer() -> Iterator[Viewer]:
    viewer = serve([shown("a.pcd", two_poles(), 200.0)], port=8990)
    yield viewer
    viewer.stop()


def received(
    viewer: Viewer,
    path: str | None = None,
    origin: str | None = "http://{}",
    host: str | None = None,
) -> int | str:
    """Bytes of the first message that a WebSocket gets, or the status it is refused with."""
    port = viewer.server.get_port()
    address = f"127.0.0.1:{port}"

    async def first() -> int:
        async with websockets.connect(
            f"ws://{host or address}/{viewer.token if path is None else path}",
            host="127.0.0.1",
            port=port,
            origin=origin and origin.format(address),
            subprotocols=[PROTOCOL],
            max_size=None,
        ) as connection:
            return len(await asyncio.wait_for(connection.recv(), 20))

    try:
        return asyncio.run(first())
    except websockets.exceptions.InvalidStatus as refused:
        return f"refused {refused.response.status_code}"


def test_the_page_of_the_address_gets_the_cloud(viewer: Viewer) -> None:
    cloud = two_poles()
    assert received(viewer) > 12 * len(cloud)  # type: ignore[operator]


@pytest.mark.parametrize(
    "origin",
    [
        None,
        "null",
        "https://elsewhere.example",
        "http://127.0.0.1",
        "http://127.0.0.1:8080",
        "https://{}",
        "http://{}.elsewhere.example",
        "http://localhost:8990",
        "file://",
    ],
)
def test_a_page_of_another_origin_is_refused_also_with_the_token(
    viewer: Viewer, origin: str | None
) -> None:
    assert received(viewer, origin=origin) == "refused 403"


@pytest.mark.parametrize("edit", ["", "/", "x", "{0}x", "x{0}", "x/{0}", "?{0}", "%20{0}", "é/{0}"])
def test_without_the_token_is_refused(viewer: Viewer, edit: str) -> None:
    assert received(viewer, edit.format(viewer.token)) == "refused 403"
    assert received(viewer, viewer.token[:-1]) == "refused 403"
    assert received(viewer, viewer.token.swapcase()) == "refused 403"


@pytest.mark.parametrize(
    "host", ["elsewhere.example", "elsewhere.example:8990", "localhost:8990", "127.0.0.1", "[::1]"]
)
def test_another_name_for_this_machine_is_refused(viewer: Viewer, host: str) -> None:
    assert received(viewer, host=host) == "refused 403"
    assert received(viewer, host=host, origin=f"http://{host}") == "refused 403"


@pytest.mark.parametrize("path", ["", "index.html", "x/", "?token={0}", "x/{0}/", "%2e/{0}/", "//"])
def test_no_page_without_the_token(viewer: Viewer, path: str) -> None:
    address = f"http://127.0.0.1:{viewer.server.get_port()}/{path.format(viewer.token)}"
    with pytest.raises(urllib.error.HTTPError) as refused:
        urllib.request.urlopen(address, timeout=20)
    with refused.value as answer:
        assert answer.code == 403
        assert len(answer.read()) < 100


def test_the_page_may_load_nothing_from_elsewhere(viewer: Viewer) -> None:
    with urllib.request.urlopen(viewer.url, timeout=20) as answer:
        policy = answer.headers["Content-Security-Policy"]
    assert "'unsafe-eval'" not in policy
    assert "default-src 'none'" in policy
    assert "frame-ancestors 'none'" in policy
    port = viewer.server.get_port()
    assert [w for w in policy.split() if "://" in w] == [f"ws://127.0.0.1:{port};"]


def test_a_file_whose_name_is_no_text_is_shown() -> None:
    served = serve([shown("a\udcff.pcd", two_poles())], port=8994)
    try:
        assert received(served) > 12 * len(two_poles())  # type: ignore[operator]
    finally:
        served.stop()


def test_two_viewers_have_two_tokens(viewer: Viewer) -> None:
    other = serve([shown("b.pcd", two_poles())], port=viewer.server.get_port())
    try:
        assert other.server.get_port() != viewer.server.get_port()
        assert received(other, viewer.token) == "refused 403"
        assert len(other.token) >= 43, "256 bits"
    finally:
        other.stop()


@pytest.mark.parametrize(
    "sent", [b"", b"\x00\xff\r\n\r\n", b"GET /\xff\xfe/ HTTP/1.1\r\nHost: a\r\nHost: b\r\n\r\n"]
)
def test_what_is_no_request_leaves_no_line(
    viewer: Viewer, sent: bytes, capfd: pytest.CaptureFixture[str]
) -> None:
    with socket.create_connection(("127.0.0.1", viewer.server.get_port()), timeout=20) as other:
        other.sendall(sent)
        other.shutdown(socket.SHUT_WR)
        assert b"200" not in other.recv(12)
    assert received(viewer, "") == "refused 403"
    assert capfd.readouterr() == ("", "")


def test_a_server_that_escapes_the_guard_is_an_error() -> None:
    from websockets.asyncio import server

    serve_of_old = server.serve
    with pytest.raises(UsageError, match="viser"), guarded("token"):
        pass
    assert server.serve is serve_of_old


# --- in a browser --------------------------------------------------------------------------------

FOREIGN = """<!DOCTYPE html><title>foreign</title><script>
window.got = []; window.refused = 0;
const [port, token, protocol] = %s;
for (const host of [`127.0.0.1:${port}`, `localhost:${port}`]) {
  for (const path of ["", token, `${token}/`]) {
    const socket = new WebSocket(`ws://${host}/${path}`, [protocol]);
    socket.binaryType = "arraybuffer";
    socket.onmessage = (e) => got.push(e.data.byteLength);
    socket.onerror = () => { refused += 1; };
    fetch(`http://${host}/${path}`).then((r) => r.text()).then((t) => got.push(t.length))
      .catch(() => { refused += 1; });
  }
}
</script>"""


def tried_by_a_page(
    browser: Browser, address: str, wanted: int = 12
) -> tuple[list[int], int | None]:
    """What the foreign page got, and how many of its attempts were refused."""
    browser.driver.get(address)
    WebDriverWait(browser.driver, 30).until(
        lambda _: browser.run("return got.length > 1 || refused >= arguments[0]", wanted)
    )
    return browser.run("return got"), browser.run("return refused")


@pytest.fixture
def foreign(tmp_path: Path) -> Iterator[list[str]]:
    """Addresses of a page at another port, under either name, and of one in a file."""

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            pass

    handler = partial(Quiet, directory=str(tmp_path))
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    port = server.server_port
    page = tmp_path / "foreign.html"
    yield [
        f"http://127.0.0.1:{port}/foreign.html",
        f"http://localhost:{port}/foreign.html",
        page.as_uri(),
    ]
    server.shutdown()
    server.server_close()


@needs_browser
def test_a_foreign_page_in_the_same_browser_gets_nothing(
    viewer: Viewer, browser: Browser, foreign: list[str], tmp_path: Path
) -> None:
    page = tmp_path / "foreign.html"
    # Without the guard the same page gets the scene: it does try.
    bare = viser.ViserServer(host="127.0.0.1", port=8996, verbose=False)
    try:
        page.write_text(FOREIGN % [bare.get_port(), "", PROTOCOL])
        assert all(sum(tried_by_a_page(browser, each)[0]) > 0 for each in foreign)
    finally:
        bare.stop()
    # Even one that knew the token.
    page.write_text(FOREIGN % [viewer.server.get_port(), viewer.token, PROTOCOL])
    for each in foreign:
        assert tried_by_a_page(browser, each) == ([], 12), each
    browser.driver.get(viewer.url.replace("127.0.0.1", "localhost"))
    assert browser.find("body").text == "Open the address as printed."
    browser.driver.get(viewer.url)
    WebDriverWait(browser.driver, 60).until(
        lambda _: "1 pole in 132 bright points" in browser.find("body").text
    )
