"""The commands with datasets and histories in S3, Google's and Azure's stores, as emulators have
them.

Needs moto[server] with s3fs, gcp-storage-emulator with gcsfs, and azurite (of npm) with adlfs; what
is not installed is skipped.
"""

import importlib.util
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from retropole.base.files import RUNNING
from retropole.fleet import storage
from retropole.fleet.batch import calibrate_fleet
from retropole.fleet.dataset import ANSWERS
from retropole.fleet.sites import find_sites
from retropole.fleet.storage import below, exists, read_bytes
from tests.fleet.fleets import bytes_of, here

WAIT = 60.0
"""Seconds for a server or a run to begin."""

AZURE_KEY = (
    # That of every Azurite, from its documentation.
    "Eby8vdM02xNOcqFlqUwJPLlmEtlCDXJ1OUzFT50uSRZ6IFsuFq2UVErCz4I6tq/K1SZFPTOtr/KBHBeksoGMGw=="
)
SERVERS = {
    "s3": ("s3fs", "moto_server -H 127.0.0.1 -p {}"),
    "gs": ("gcsfs", "gcp-storage-emulator start --host 127.0.0.1 --in-memory --port {}"),
    "abfs": (
        "adlfs",
        "azurite-blob --inMemoryPersistence --skipApiVersionCheck "
        "--blobHost 127.0.0.1 --blobPort {}",
    ),
}
"""Of each protocol the package for fsspec, and the command of an emulator at a port."""


def settings(port: int) -> dict[str, str]:
    """What a user sets for such servers."""
    url = f"http://127.0.0.1:{port}"
    return {
        "AWS_ENDPOINT_URL": url,
        "AWS_ACCESS_KEY_ID": "any",
        "AWS_SECRET_ACCESS_KEY": "any",
        "AWS_DEFAULT_REGION": "us-east-1",
        "STORAGE_EMULATOR_HOST": url,
        "GCSFS_EXPERIMENTAL_ZB_HNS_SUPPORT": "false",
        "AZURE_STORAGE_CONNECTION_STRING": "DefaultEndpointsProtocol=http;"
        f"AccountName=devstoreaccount1;AccountKey={AZURE_KEY};BlobEndpoint={url}/devstoreaccount1;",
    }


@pytest.fixture(scope="module", params=SERVERS)
def store(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[str]:
    """URL of an empty bucket of an emulator."""
    package, command = SERVERS[request.param]
    if importlib.util.find_spec(package) is None:
        pytest.skip(f"needs {package}")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    program, *words = command.format(port).split()
    found = shutil.which(program) or shutil.which(program, path=Path(sys.executable).parent)
    if found is None:
        pytest.skip(f"needs the command {program}")
    server = subprocess.Popen(
        [found, *words],
        cwd=tmp_path_factory.mktemp("server"),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    with pytest.MonkeyPatch.context() as patch:
        for name, value in settings(port).items():
            patch.setenv(name, value)
        try:
            wait_until(lambda: answers(port))
            system, _ = storage.filesystem(f"{request.param}://city")
            system.mkdir("city")
            # Azure's own form names the account.
            account = "@devstoreaccount1.dfs.core.windows.net" if package == "adlfs" else ""
            yield f"{request.param}://city{account}"
        finally:
            server.terminate()
            server.wait()


def answers(port: int) -> bool:
    with socket.socket() as one:
        return one.connect_ex(("127.0.0.1", port)) == 0


def wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + WAIT
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def started(*words: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "retropole", "fleet", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def ran(*words: str, code: int = 0) -> str:
    process = started(*words)
    said = "".join(process.communicate())
    assert process.returncode == code, said
    return said


def answers_at(out: str) -> dict[str, bytes]:
    folder = below(out, ANSWERS)
    return {name: read_bytes(below(folder, name)) for name in storage.names_in(folder)}


@pytest.fixture(scope="module")
def local(fleet: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The partitions of the fleet in a folder."""
    out = tmp_path_factory.mktemp("local")
    calibrate_fleet(find_sites([str(fleet)]), str(out), here)
    return bytes_of(out)


def test_recordings_dataset_reports_and_history_may_all_be_there(
    store: str, fleet: Path, tmp_path: Path
) -> None:
    for path in fleet.parent.rglob("*"):
        if path.is_file():
            place = below(store, "in", path.relative_to(fleet.parent).as_posix())
            storage.write_bytes(place, path.read_bytes())
    out, page, reports = f"{store}/fleet", f"{store}/fleet.html", f"{store}/reports"
    given = (f"{store}/in/sites.csv", "--out", out, "--workers", "2")
    said = ran("calibrate", *given, "--reports", reports, "--report", page)
    assert "8 sites: 1 ok, 4 refused, 3 error\ncalibrated now: 7" in said
    assert "calibrated now: 1, as before: 7" in ran("calibrate", *given)
    found = (f"{store}/in/ya*/*.toml", f"{store}/in/good")
    assert "2 sites: 1 ok, 1 refused\n" in ran("calibrate", *found, "--out", f"{store}/two")
    assert exists(f"{reports}/good/report.html")
    ran("report", out, "--reports", reports, "--out", page)
    assert b"./reports/yard/site-report.html" in read_bytes(page)
    for new in (1, 0):
        said = ran(
            *("check", f"{store}/in/go*", "--answers", out, "--history", f"{store}/history"),
            *("--workers", "1"),
        )
        assert f"1 site, {new} new check" in said


def test_what_is_killed_goes_on_and_no_two_run_at_once(
    store: str, fleet: Path, local: dict[str, bytes]
) -> None:
    out = f"{store}/killed"
    words = ("calibrate", str(fleet), "--out", out, "--workers", "1")
    for last in (signal.SIGTERM, signal.SIGKILL):
        first = started(*words)
        wait_until(lambda: exists(below(out, RUNNING)))
        first.send_signal(signal.SIGSTOP)
        before = storage.found_below(out)
        assert f"another run is writing to it (process {first.pid} on " in ran(*words, code=2)
        assert storage.found_below(out) == before
        first.send_signal(last)
        first.send_signal(signal.SIGCONT)
        first.wait()
        assert exists(below(out, RUNNING)) == (last == signal.SIGKILL)
    assert "if that run was killed, remove .running there" in ran(*words, code=2)
    storage.remove(below(out, RUNNING))
    ran(*words)
    assert answers_at(out) == local
    assert not exists(below(out, RUNNING))


def test_a_bucket_that_a_slip_names_is_not_made(store: str, fleet: Path) -> None:
    slip = store.replace("city", "slip")
    said = ran("calibrate", str(fleet), "--out", f"{slip}/fleet", "--workers", "1", code=2)
    assert f"{slip}/fleet/.running: " in said
    assert not exists(slip)
