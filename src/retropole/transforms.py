"""Reading a transform that a file holds."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np

from .datatypes import Array
from .errors import ReadError

ROTATION_TOLERANCE = 1e-4
"""How far RᵀR may be from the identity: files are written with few digits."""


def read_transform(path: Path) -> Array:
    """Read the transform of a file.

    Parameters
    ----------
    path
        JSON with a ``T_target_source`` (``result.json``, the ``truth.json`` of a simulation), or
        sixteen numbers, row by row, between spaces, commas or lines; ``#`` starts a comment.

    Returns
    -------
    (4, 4) float64
        With the nearest true rotation: a product of rotations rounded to few digits drifts.

    Raises
    ------
    ReadError
        The file cannot be read, holds no transform, or one that is not rigid.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ReadError(f"{path}: {error.strerror or error}") from error
    read = _from_json if data.lstrip()[:1] == b"{" else _from_text
    return _rigid(path, read(path, data))


def _from_json(path: Path, data: bytes) -> Array:
    try:
        document = msgspec.json.decode(data)
    except msgspec.DecodeError as error:
        raise ReadError(f"{path}: no JSON: {error}") from error
    if document.get("T_target_source", "") is None:
        raise ReadError(f"{path}: a calibration that was refused; it holds no transform")
    try:
        return np.array(document["T_target_source"], dtype=float)
    except KeyError:
        raise ReadError(f"{path}: no T_target_source in it") from None
    except (TypeError, ValueError) as error:
        raise ReadError(f"{path}: T_target_source is no matrix: {error}") from error


def _from_text(path: Path, data: bytes) -> Array:
    try:
        lines = [line.split("#")[0] for line in data.decode().splitlines()]
        numbers = [float(word) for line in lines for word in line.replace(",", " ").split()]
    except ValueError as error:
        raise ReadError(f"{path}: neither JSON nor a matrix of numbers: {error}") from error
    if len(numbers) != 16:
        raise ReadError(f"{path}: {len(numbers)} numbers where a 4×4 matrix has 16")
    return np.array(numbers).reshape(4, 4)


def _rigid(path: Path, matrix: Array) -> Array:
    if matrix.shape != (4, 4) or not np.all(np.isfinite(matrix)):
        raise ReadError(f"{path}: the transform must be 4×4 finite numbers, is {matrix.shape}")
    R = matrix[:3, :3]
    off = float(np.max(np.abs(R.T @ R - np.eye(3))))
    last = np.array([0.0, 0.0, 0.0, 1.0])
    if off > ROTATION_TOLERANCE or np.linalg.det(R) < 0 or not np.allclose(matrix[3], last):
        raise ReadError(
            f"{path}: no rigid transform: RᵀR is {off:.2g} off the identity, det R is "
            f"{np.linalg.det(R):.3g}, the last row is {matrix[3].tolist()}"
        )
    u, _, vt = np.linalg.svd(R)
    rigid = matrix.copy()
    rigid[:3, :3] = u @ vt
    return rigid
