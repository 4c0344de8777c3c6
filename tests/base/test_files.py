import errno
import os
import stat
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from retropole.base import files
from retropole.base.errors import ReadError, UsageError
from retropole.base.files import (
    LARGEST_DOCUMENT,
    RUNNING,
    UNFINISHED,
    check_is_file,
    path_in_text,
    path_of_text,
    read_document,
    run_alone,
    set_aside,
    this_run,
    unfinished,
    write_atomically,
    write_together,
)

posix = pytest.mark.skipif(os.name != "posix", reason="devices, links and locks of POSIX")


def test_writes_and_makes_the_folder(tmp_path: Path) -> None:
    path = tmp_path / "a" / "b.json"
    write_atomically(path, b"one")
    write_atomically(path, b"two")
    assert path.read_bytes() == b"two"
    assert [p.name for p in path.parent.iterdir()] == ["b.json"]


def test_an_interrupt_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "result.json"
    write_atomically(path, b"old")

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("os.replace", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_atomically(path, b"new")
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["result.json"]


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_a_full_disk_leaves_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = tmp_path / "result.json", tmp_path / "report.html"
    write_together({first: b"old", second: b"old"})

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space"):
        write_together({first: b"new", second: b"new"})
    assert first.read_bytes() == second.read_bytes() == b"old"
    assert names(tmp_path) == {"result.json", "report.html"}
    assert not unfinished


@pytest.mark.parametrize("after", range(3))
def test_files_that_are_there_are_of_one_run_wherever_it_ends(tmp_path: Path, after: int) -> None:
    code = f"""
import os
from pathlib import Path
from retropole.base.files import write_together
real, count = os.replace, [0]
def replace(*words):
    if count[0] == {after}:
        os._exit(9)
    count[0] += 1
    real(*words)
os.replace = replace
write_together({{Path("result.json"): b"new", Path("report.html"): b"new"}})
"""
    write_together({tmp_path / "result.json": b"old", tmp_path / "report.html": b"old"})
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=False)
    assert done.returncode == (9 if after < 2 else 0)
    left = [path for path in tmp_path.iterdir() if not path.name.endswith(UNFINISHED)]
    assert len({path.read_bytes() for path in left}) == 1
    write_together({tmp_path / "result.json": b"newer", tmp_path / "report.html": b"newer"})
    assert names(tmp_path) == {"result.json", "report.html"}, "what was left is swept"


@posix
def test_two_at_once_do_not_mix(tmp_path: Path) -> None:
    import fcntl

    descriptor = os.open(tmp_path, os.O_RDONLY)
    fcntl.flock(descriptor, fcntl.LOCK_EX)
    with pytest.raises(OSError, match="another run is writing"):
        write_atomically(tmp_path / "result.json", b"mine")
    os.close(descriptor)
    write_atomically(tmp_path / "result.json", b"mine")
    assert names(tmp_path) == {"result.json"}


@posix
def test_links_and_permissions_are_kept(tmp_path: Path) -> None:
    path, link, other = (tmp_path / name for name in ("robot.urdf", "link", "other"))
    path.write_bytes(b"old")
    path.chmod(0o640)
    link.symlink_to("robot.urdf")
    write_atomically(link, b"new")
    assert link.is_symlink()
    assert path.read_bytes() == b"new"
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    other.hardlink_to(path)
    write_atomically(path, b"newer")
    assert other.read_bytes() == b"newer"
    assert path.samefile(other)


@posix
def test_what_is_no_file_is_written_to_and_stays(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    read: list[bytes] = []
    reader = threading.Thread(target=lambda: read.append(pipe.read_bytes()))
    reader.start()
    write_atomically(pipe, b"through")
    reader.join(10)
    assert read == [b"through"]
    assert stat.S_ISFIFO(pipe.stat().st_mode)
    null = tmp_path / "null"
    null.symlink_to(os.devnull)
    write_atomically(null, b"away")
    assert null.is_symlink()
    assert stat.S_ISCHR(os.stat(os.devnull).st_mode)
    with pytest.raises(IsADirectoryError):
        write_atomically(tmp_path, b"folder")


def test_a_document_is_not_read_without_end(tmp_path: Path) -> None:
    path = tmp_path / "long.json"
    path.write_bytes(b" " * (LARGEST_DOCUMENT + 1))
    with pytest.raises(ReadError, match="more than"):
        read_document(path)
    path.write_bytes(b" " * LARGEST_DOCUMENT)
    assert len(read_document(path)) == LARGEST_DOCUMENT


@posix
def test_a_path_of_any_bytes_is_text_and_found_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in (b"caf\xe9 \xff.pcd", b"plain.pcd", b"\\xff literally", "é\n".encode()):
        path = Path(os.fsdecode(name))
        path.write_bytes(name)
        text = path_in_text(path)
        assert text.encode().decode() == text
        assert path_of_text(text).read_bytes() == name
    assert path_in_text(os.fsdecode(b"caf\xe9")) == "caf\\xe9"


@posix
def test_an_error_names_the_file_that_was_requested(tmp_path: Path) -> None:
    full = Path("/dev/full")
    if not full.exists():
        pytest.skip("this system has no full device")
    with pytest.raises(OSError, match="/dev/full") as caught:
        write_atomically(full, b"x" * 10**6)
    assert (caught.value.errno, caught.value.filename) == (errno.ENOSPC, "/dev/full")


def test_sets_aside_what_is_there_by_another_name(tmp_path: Path) -> None:
    result, page = tmp_path / "result.json", tmp_path / "report.html"
    write_atomically(result, b"one")
    assert set_aside([result, page]) == [tmp_path / "older-result.json"]
    assert (tmp_path / "older-result.json").read_bytes() == b"one"
    write_atomically(result, b"two")
    assert set_aside([result]) == [tmp_path / "older-result.json"]
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"two"]
    assert set_aside([tmp_path / "none" / "result.json", tmp_path]) == []


@posix
def test_a_link_is_set_aside_and_what_it_points_to_stays(tmp_path: Path) -> None:
    write_atomically(tmp_path / "kept" / "a.json", b"one")
    (tmp_path / "result.json").symlink_to(tmp_path / "kept" / "a.json")
    set_aside([tmp_path / "result.json"])
    assert (tmp_path / "older-result.json").is_symlink()
    assert (tmp_path / "kept" / "a.json").read_bytes() == b"one"


def test_a_folder_is_of_one_run_and_what_it_left_is_gone_with_it(tmp_path: Path) -> None:
    folder = tmp_path / "new"
    for _ in range(2):
        with run_alone(folder, "retropole plan"):
            note = (folder / RUNNING).read_text()
            assert note.startswith(f"retropole plan, process {os.getpid()} on ")
            with pytest.raises(BlockingIOError, match="another run") as caught, run_alone(folder):
                raise AssertionError
            assert (caught.value.filename, note in str(caught.value)) == (str(folder), True)
            # What it writes itself is not in the way.
            write_atomically(folder / "nested" / "a", b"a")
        assert names(folder) == {"nested"}
    with pytest.raises(KeyError), run_alone(tmp_path / "empty"):
        raise KeyError
    assert not (tmp_path / "empty").exists()
    assert not unfinished


def test_what_a_killed_run_left_keeps_nobody_away(tmp_path: Path) -> None:
    (tmp_path / RUNNING).write_text("process 1 on elsewhere, since 2026-11-25 09:29 UTC and more")
    with run_alone(tmp_path):
        assert (tmp_path / RUNNING).read_text() == this_run()
    assert names(tmp_path) == set()


@posix
def test_a_run_that_ends_while_another_begins_leaves_it_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = files._opened

    def late(note: Path) -> int:
        descriptor = opened(note)
        if len(seen) < 3:
            # The first has ended meanwhile: with its note, then with its folder.
            seen.append(note)
            note.unlink()
            if len(seen) > 1:
                note.parent.rmdir()
        return descriptor

    seen: list[Path] = []
    monkeypatch.setattr(files, "_opened", late)
    with run_alone(tmp_path / "out"):
        assert len(seen) == 3
        with pytest.raises(BlockingIOError), run_alone(tmp_path / "out"):
            raise AssertionError


@posix
def test_what_is_no_file_is_reported_and_not_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "null").symlink_to(os.devnull)
    for name, kind in (("pipe", "a named pipe"), ("null", "a device"), (".", "a folder")):
        with pytest.raises(ReadError, match=f"is {kind}, expected a file"):
            check_is_file(tmp_path / name)


def test_a_stream_is_whole_or_not_there_and_needs_a_file(tmp_path: Path) -> None:
    path = tmp_path / "new" / "a"
    with files.stream_atomically(path) as file:
        file.write(b"....end")
        file.seek(0)
        file.write(b"head")
        assert not path.exists()
    assert path.read_bytes() == b"headend"
    assert [*path.parent.iterdir()] == [path]
    with (
        pytest.raises(UsageError, match="is not a regular file"),
        files.stream_atomically(Path(os.devnull)),
    ):
        pass
