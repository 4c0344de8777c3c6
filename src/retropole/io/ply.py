"""PLY: ascii, and binary in either byte order."""

from __future__ import annotations

import io
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..datatypes import Array, PointCloud
from ..errors import ReadError
from .fields import cloud_from_columns

TYPES = {
    **{"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1"},
    **{"short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2"},
    **{"int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4"},
    **{"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"},
}
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass
class _Element:
    name: str
    count: int
    properties: list[tuple[str, str]] = field(default_factory=list)
    has_list: bool = False


def read_ply(path: Path) -> PointCloud:
    """Read the vertices of a PLY file; they must come before any element that holds lists.

    Raises
    ------
    ReadError
        Where the header or the data are not what they should be.
    """
    data = path.read_bytes()
    encoding, elements, body = _parse_header(path, data)
    before, vertex = _vertex(path, elements)
    if vertex.count == 0:
        raise ReadError(f"{path}: element vertex 0, expected at least one")
    if encoding == "ascii":
        return cloud_from_columns(path, _read_ascii(path, body, before, vertex))
    order = ORDERS[encoding]

    def record(element: _Element) -> np.dtype[np.void]:
        return np.dtype([(name, order + kind) for name, kind in element.properties])

    start = sum(element.count * record(element).itemsize for element in before)
    size = vertex.count * record(vertex).itemsize
    if len(body) < start + size:
        raise ReadError(
            f"{path}: the header promises {vertex.count} vertices, {start + size} bytes; the file "
            f"holds {len(body)} after it"
        )
    points = np.frombuffer(body, record(vertex), vertex.count, start)
    return cloud_from_columns(path, {name: points[name] for name, _ in vertex.properties})


def _vertex(path: Path, elements: list[_Element]) -> tuple[list[_Element], _Element]:
    for k, element in enumerate(elements):
        if element.name == "vertex":
            if element.has_list:
                raise ReadError(f"{path}: element vertex holds a list, expected numbers only")
            return elements[:k], element
        if element.has_list and element.count:
            raise ReadError(f"{path}: element {element.name} with lists comes before vertex")
    raise ReadError(f"{path}: the header has no element vertex")


def _parse_header(path: Path, data: bytes) -> tuple[str, list[_Element], bytes]:
    if not data:
        raise ReadError(f"{path}: is empty, expected a PLY header")
    end = data.find(b"end_header")
    stop = data.find(b"\n", end)
    if not data.startswith(b"ply") or end < 0 or stop < 0:
        raise ReadError(f"{path}: expected a header from 'ply' to 'end_header'")
    encoding, elements = "", list[_Element]()
    for number, line in enumerate(data[:end].decode("ascii", errors="replace").splitlines(), 1):
        words = line.split()
        try:
            match words:
                case ["format", name, _] if name in ORDERS:
                    encoding = name
                case ["element", name, count] if int(count) >= 0:
                    elements.append(_Element(name, int(count)))
                case ["property", "list", length, kind, _] if length in TYPES and kind in TYPES:
                    elements[-1].has_list = True
                case ["property", kind, name]:
                    if name in dict(elements[-1].properties):
                        raise ValueError
                    elements[-1].properties.append((name, TYPES[kind]))
                case [] | ["ply"] | ["comment" | "obj_info", *_]:
                    pass
                case _:
                    raise ValueError
        except (ValueError, KeyError, IndexError):
            raise ReadError(
                f"{path}, line {number}: {line.strip()!r}, expected format, element or property "
                "as PLY has them"
            ) from None
    if not encoding:
        raise ReadError(f"{path}: the header has no format line, expected {', '.join(ORDERS)}")
    return encoding, elements, data[stop + 1 :]


def _read_ascii(
    path: Path, body: bytes, before: list[_Element], vertex: _Element
) -> dict[str, Array]:
    values = len(vertex.properties)
    if len(body) + 1 < 2 * values * vertex.count:
        raise ReadError(
            f"{path}: the header promises {vertex.count} vertices of {values} values, the "
            f"{len(body)} bytes after it cannot hold them"
        )
    try:
        table = np.loadtxt(
            io.BytesIO(body),
            skiprows=sum(element.count for element in before),
            max_rows=vertex.count,
            ndmin=2,
        )
    except ValueError as error:
        raise ReadError(
            f"{path}: its vertices are not lines of {values} numbers ({error})"
        ) from None
    if table.shape != (vertex.count, values):
        raise ReadError(
            f"{path}: holds {len(table)} lines of vertices, expected {vertex.count} of {values} "
            "values"
        )
    return {name: table[:, k] for k, (name, _) in enumerate(vertex.properties)}
