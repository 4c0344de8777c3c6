"""Paths in, point clouds out: files, folders of frames, bags and packets."""

from __future__ import annotations

import hashlib
import re
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

from ..base.datatypes import PointCloud
from ..base.errors import ReadError, UsageError, naming, readable
from ..base.files import check_is_file
from .arrays import ARRAY_SOURCE as ARRAY_SOURCE
from .arrays import cloud_from_array as cloud_from_array
from .arrays import read_bin, read_npy, read_npz, read_pts, read_text
from .bags import BAGS as BAGS
from .bags import is_rosbag2
from .fields import USUAL, Unit, Wanted, in_metres, unit_named
from .fields import only_returns as only_returns
from .las import read_las
from .pcd import read_pcd
from .pcd import write_pcd as write_pcd
from .ply import read_ply
from .recordings import CAPTURES, LVX, read_within
from .recordings import MAX_POINTS as MAX_POINTS
from .recordings import PACKETS as PACKETS
from .recordings import Frame as Frame
from .recordings import FrameHeader as FrameHeader
from .recordings import ReadRecording as ReadRecording
from .recordings import Recording as Recording
from .recordings import Topic as Topic
from .recordings import chosen_frames as chosen_frames
from .recordings import downsample as downsample
from .recordings import joined as joined

READERS: dict[str, Callable[[Path, Wanted], PointCloud]] = {
    ".pcd": read_pcd,
    ".ply": read_ply,
    ".las": read_las,
    ".laz": read_las,
    ".bin": read_bin,
    ".npy": read_npy,
    ".npz": read_npz,
    ".csv": read_text,
    ".xyz": read_text,
    ".txt": read_text,
    ".asc": read_text,
    ".pts": read_pts,
}
"""From the suffix of a file of one frame, in lower case, to its reader."""


def open_recording(
    path: str | Path, *, topic: str | None = None, wanted: Wanted = USUAL
) -> Recording:
    """Look at a file, a folder of frames or a bag without reading its points.

    Parameters
    ----------
    path
        A file whose suffix is one of `READERS`, `BAGS` or `PACKETS`; a folder of files with a
        suffix of `READERS`, or of a ROS 2 bag. The files of a folder are frames in natural
        order (``frame2`` before ``frame10``); hidden files are skipped.
    topic
        Of a bag, the topic to read; needed where several have point clouds. Of a capture, the
        ``IP:port`` of a LiDAR; needed where several sent.
    wanted
        The field of the intensity, and of packets the angles of the unit.

    Raises
    ------
    ReadError
        Naming the file and what was expected.
    UsageError
        If a topic is given, and the path is neither a bag nor a capture; where angles are, and
        it has no packets.
    MissingExtraError
        If the format needs an extra that is not installed.
    """
    path = Path(path)
    files = _files(path)
    # What decodes packets takes as long to import as the rest, and most recordings are files.
    if _is_bag(path):
        from .ros import open_bag

        return open_bag(path, topic, wanted)
    if path.suffix.lower() in CAPTURES and path.is_file():
        from .packets import open_packets

        return open_packets(path, topic, wanted)
    wanted.refuse_angles(f"{path}: has no packets, angles do not apply")
    if path.suffix.lower() in LVX and path.is_file():
        from .lvx import open_lvx

        return open_lvx(path, topic, wanted)
    if topic is not None:
        raise UsageError(f"{path}: has no topics, only bags have ({', '.join(BAGS)})")

    def frames(numbers: range) -> Iterator[Frame]:
        return (Frame(k, _read(files[k], wanted)) for k in numbers)

    return Recording(path, len(files), frames)


def topics_of(path: str | Path) -> tuple[Topic, ...]:
    """List the topics of a bag by name, or the LiDARs of a capture of several; else nothing.

    Raises
    ------
    ReadError, MissingExtraError
        As `open_recording`.
    """
    path = Path(path)
    _files(path)
    if path.suffix.lower() in CAPTURES and path.is_file():
        from .packets import topics_of_capture

        return topics_of_capture(path)
    if path.suffix.lower() in LVX and path.is_file():
        from .lvx import lvx_topics

        return lvx_topics(path)
    if _is_bag(path):
        from .ros import bag_topics

        return bag_topics(path)
    return ()


def _is_bag(path: Path) -> bool:
    return is_rosbag2(path) or (path.is_file() and path.suffix.lower() in BAGS)


def read_frames(
    path: str | Path, *, topic: str | None = None, frames: slice | None = None
) -> Iterator[Frame]:
    """Read the frames of a recording one after the other; only one is in memory at a time.

    Parameters
    ----------
    path, topic
        As `open_recording` takes them.
    frames
        Which to read, by their numbers from 0, as Python slices a list. None reads them all.

    Raises
    ------
    ReadError, UsageError, MissingExtraError
        As `open_recording`, when the first frame is requested or where a frame cannot be read.
    """
    recording = open_recording(path, topic=topic)
    yield from recording.read(chosen_frames(recording, frames or slice(None)))


def read_cloud(
    path: str | Path,
    *,
    topic: str | None = None,
    frames: slice | None = None,
    max_points: int | None = None,
    unit: Unit = "m",
    intensity: str | None = None,
) -> PointCloud:
    """Read a file, a folder of files or a bag as one cloud.

    Parameters
    ----------
    path, topic
        As `open_recording` takes them.
    frames
        Which frames to combine, by their numbers from 0, as Python slices a list. None takes them
        all, or of a long recording evenly spread ones with about
        `recordings.MAX_RECORDING_POINTS` points.
    max_points
        How many points to keep of more; None keeps all. Of many frames, every second is left out
        as often as it takes; of few, or of one, the brightest points are kept and the others
        downsampled evenly.
    unit
        Of the file's coordinates: ``m``, ``cm``, ``mm``, ``ft`` or ``in``.
    intensity
        Field that it is read from; None takes the first of `fields.INTENSITY`.

    Returns
    -------
    PointCloud
        In the frame of the file, in metres; points that are not finite or at zero range are dropped
        and counted.

    Raises
    ------
    ReadError
        Naming the file, the line or the field, and what was expected.
    UsageError
        If a topic is given and the path is not a bag, frames are requested backwards, or a unit
        is given that the file cannot have.
    MissingExtraError
        If the format needs an extra that is not installed.
    """
    wanted = Wanted(intensity)
    read = read_recording(
        path, topic=topic, frames=frames, max_points=max_points, unit=unit, wanted=wanted
    )
    return read.cloud


def read_recording(
    path: str | Path,
    *,
    topic: str | None = None,
    frames: slice | None = None,
    max_points: int | None = None,
    unit: Unit = "m",
    wanted: Wanted = USUAL,
    progress: Callable[[str], None] = lambda step: None,
) -> ReadRecording:
    """Read as `read_cloud` does, and say besides what was read: the frames, and of how many.

    Parameters
    ----------
    path, topic, frames, max_points, unit
        As `read_cloud` takes them.
    wanted
        As `open_recording` takes it.
    progress
        Called as each of several frames is about to be read, with which of how many it is.

    Raises
    ------
    ReadError, UsageError, MissingExtraError
        As `read_cloud`.
    """
    unit = unit_named(unit)
    recording = open_recording(path, topic=topic, wanted=wanted)
    if unit != "m" and (recording.model or recording.path.suffix.lower() in CAPTURES):
        raise UsageError(f"{path}: packets are decoded to metres, the unit cannot be {unit}")
    requested = chosen_frames(recording, frames)
    most = sys.maxsize if max_points is None else max_points
    numbers, read = read_within(recording, requested, most, progress)
    headers = tuple(frame.header for frame in read)
    cloud = in_metres(joined(recording, read), unit)
    return ReadRecording(recording, requested, numbers, headers, cloud)


def _files(path: Path) -> list[Path]:
    """List the file itself, the frames of a folder, or the files of a ROS 2 bag."""
    with readable(path):
        if not path.exists():
            raise ReadError(f"{path}: there is no such file or folder")
        if is_rosbag2(path):
            return sorted((p for p in path.iterdir() if p.is_file()), key=_natural_key)
        if path.is_dir():
            return frames_of(path)
        check_is_file(path)
        return [path]


def _read(path: Path, wanted: Wanted) -> PointCloud:
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        known = ", ".join([*READERS, *BAGS, *PACKETS, *LVX])
        raise ReadError(f"{path}: unknown suffix {path.suffix!r}, expected one of {known}")
    with naming(path):
        return replace(reader(path, wanted), source=str(path))


def frames_of(folder: Path) -> list[Path]:
    """List the point clouds of a folder in natural order.

    Raises
    ------
    ReadError
        If there are none, or files of different formats.
    """
    named = [p for p in folder.iterdir() if not p.name.startswith(".") and not p.is_dir()]
    for path in named:
        # A frame that is a pipe, or a broken link, is not left out without a word.
        if path.suffix.lower() in READERS:
            check_is_file(path)
    files = [p for p in named if p.is_file()]
    clouds = [p for p in files if p.suffix.lower() in READERS]
    if not clouds:
        recordings = [p.name for p in files if p.suffix.lower() in (*BAGS, *CAPTURES, *LVX)]
        raise ReadError(
            f"{folder}: has several recordings, give one of them: {', '.join(sorted(recordings))}"
            if recordings
            else f"{folder}: has no point clouds, expected files of {', '.join(READERS)}"
        )
    suffixes = sorted({p.suffix.lower() for p in clouds})
    if len(suffixes) > 1:
        raise ReadError(
            f"{folder}: has files of different formats ({', '.join(suffixes)}), expected the "
            "frames of one recording"
        )
    return sorted(clouds, key=_natural_key)


def _natural_key(path: Path) -> tuple[list[str | int], str]:
    """Make a sort key: digits in a name are treated as numbers; equal ones are sorted by the
    name."""
    parts = re.split(r"([0-9]+)", path.name)
    return [int(word) if k % 2 else word for k, word in enumerate(parts)], path.name


def sha256_of(path: str | Path) -> str:
    """SHA-256 of a file's bytes; of a folder, of its files' bytes one after the other.

    Raises
    ------
    ReadError
        If the file or folder cannot be read.
    """
    digest = hashlib.sha256()
    for file in _files(Path(path)):
        with readable(file), file.open("rb") as opened:
            # It goes on with the hash that it is given.
            hashlib.file_digest(opened, lambda: digest)
    return digest.hexdigest()
