"""Paths in, point clouds out."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..datatypes import PointCloud
from ..errors import ReadError
from .arrays import read_kitti, read_npy, read_npz, read_text
from .las import read_las
from .pcd import read_pcd, write_pcd
from .ply import read_ply

__all__ = ["READERS", "read_cloud", "sha256_of", "write_pcd"]

READERS: dict[str, Callable[[Path], PointCloud]] = {
    ".pcd": read_pcd,
    ".ply": read_ply,
    ".las": read_las,
    ".laz": read_las,
    ".bin": read_kitti,
    ".npy": read_npy,
    ".npz": read_npz,
    ".csv": read_text,
    ".xyz": read_text,
    ".txt": read_text,
}
"""From the suffix of a file, in lower case, to what reads it."""


def read_cloud(path: str | Path) -> PointCloud:
    """Read a file, or a folder of files as one recording of frames.

    Parameters
    ----------
    path
        A file whose suffix is one of `READERS`, or a folder of such files. The files of a folder
        are frames in natural order (``frame2`` before ``frame10``); hidden files are passed over.

    Returns
    -------
    PointCloud
        In the file's own frame; points that are not finite or at zero range are dropped and
        counted.

    Raises
    ------
    ReadError
        Naming the file, the line or the field, and what was expected.
    MissingExtraError
        Where the format needs an optional part that is not installed.
    """
    path = Path(path)
    files = _files(path)
    clouds = [_read_file(file) for file in files]
    return _joined(path, clouds) if path.is_dir() else clouds[0]


def _files(path: Path) -> list[Path]:
    """The file itself, or the frames of a folder."""
    try:
        if not path.exists():
            raise ReadError(f"{path}: there is no such file or folder")
        return frames_of(path) if path.is_dir() else [path]
    except OSError as error:
        raise ReadError(f"{path}: cannot be read ({error.strerror or error})") from None


def _read_file(path: Path) -> PointCloud:
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        known = ", ".join(READERS)
        raise ReadError(f"{path}: unknown suffix {path.suffix!r}, expected one of {known}")
    try:
        return reader(path)
    except OSError as error:
        raise ReadError(f"{path}: cannot be read ({error.strerror or error})") from None


def frames_of(folder: Path) -> list[Path]:
    """List the point clouds of a folder in natural order.

    Raises
    ------
    ReadError
        Where there are none, or files of different kinds.
    """
    files = [p for p in folder.iterdir() if p.is_file() and not p.name.startswith(".")]
    clouds = [p for p in files if p.suffix.lower() in READERS]
    if not clouds:
        raise ReadError(f"{folder}: holds no point clouds, expected files of {', '.join(READERS)}")
    suffixes = sorted({p.suffix.lower() for p in clouds})
    if len(suffixes) > 1:
        raise ReadError(
            f"{folder}: holds files of different kinds ({', '.join(suffixes)}), expected the "
            "frames of one recording"
        )
    return sorted(clouds, key=_natural)


def _natural(path: Path) -> tuple[list[str | int], str]:
    """Sort key: the digits of a name as numbers; the name itself where these are the same."""
    words = re.split(r"([0-9]+)", path.name)
    return [int(word) if k % 2 else word for k, word in enumerate(words)], path.name


def _joined(path: Path, clouds: list[PointCloud]) -> PointCloud:
    first = clouds[0]
    for cloud in clouds[1:]:
        if not np.allclose(cloud.origin, first.origin):
            raise ReadError(
                f"{cloud.source}: its viewpoint {cloud.origin} differs from {first.origin} of "
                f"{first.source}, expected frames of one resting sensor"
            )

    def column(name: str) -> NDArray[Any] | None:
        columns = [getattr(cloud, name) for cloud in clouds]
        missing = [cloud for cloud, values in zip(clouds, columns, strict=True) if values is None]
        if name == "intensity" and 0 < len(missing) < len(clouds):
            raise ReadError(
                f"{missing[0].source}: has no intensity, other frames of the folder have"
            )
        return None if missing else np.concatenate(columns)

    frame = np.repeat(np.arange(len(clouds)), [len(cloud) for cloud in clouds])
    return replace(
        first,
        xyz=np.concatenate([cloud.xyz for cloud in clouds]),
        intensity=column("intensity"),
        ring=column("ring"),
        time=column("time"),
        frame=frame.astype(np.int64) if len(clouds) > 1 else None,
        dropped=sum(cloud.dropped for cloud in clouds),
        source=str(path),
    )


def sha256_of(path: str | Path) -> str:
    """SHA-256 of a file's bytes; of a folder, of its frames' bytes one after the other.

    Raises
    ------
    ReadError
        Where the file or folder cannot be read.
    """
    path = Path(path)
    digest = hashlib.sha256()
    for file in _files(path):
        try:
            digest.update(file.read_bytes())
        except OSError as error:
            raise ReadError(f"{file}: cannot be read ({error.strerror or error})") from None
    return digest.hexdigest()
