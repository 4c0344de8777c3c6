"""PLY: ascii, and binary in either byte order."""

from __future__ import annotations

import re
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.datatypes import PointCloud
from ..base.errors import LineError, ReadError
from .arrays import read_table
from .fields import MAX_PROMISED, USUAL, Wanted, cloud_from_columns, left_out, noted, read_whole

PLY_TYPES = {
    **{"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1"},
    **{"short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2"},
    **{"int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4"},
    **{"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"},
}
MAX_HEADER = 10_000
"""Lines of a header: more properties are an error in it, and would take the time."""

ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass(frozen=True)
class _Property:
    name: str
    kind: str
    length: str = ""
    """Type of the count in front of a list; empty if there is one value."""


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: list[_Property]

    @property
    def names(self) -> list[str]:
        """Of its values, without the lists."""
        return [own.name for own in self.properties if not own.length]


def read_ply(path: Path, wanted: Wanted = USUAL) -> PointCloud:
    """Read the vertices of a PLY file; other elements, and lists, are skipped.

    Raises
    ------
    ReadError
        If the header or the data are not what they should be.
    """
    data = read_whole(path, "a PLY header")
    encoding, elements, start, lines = _parse_header(data)
    k = next((k for k, element in enumerate(elements) if element.name == "vertex"), None)
    if k is None:
        have = ", ".join(element.name for element in elements) or "none"
        raise ReadError(f"the header has no element vertex; the elements are: {have}")
    before, vertex = elements[:k], elements[k]
    if vertex.count == 0:
        raise ReadError("element vertex 0, expected at least one")
    if not vertex.names:
        raise ReadError("element vertex has no values, expected x, y and z at least")
    # Each value or list takes a byte, and in a text a blank or line end as well, but the last.
    least = sum(e.count * len(e.properties) for e in (*before, vertex))
    left = len(data) - start if encoding != "ascii" else (len(data) - start + 1) // 2
    if left < least:
        promised = f"{vertex.count} vertices and more, {least} values in all"
        cannot = f"the {len(data) - start} bytes after it cannot hold them"
        raise ReadError(f"the header promises {promised}; {cannot}")
    if encoding == "ascii":
        columns, rest = _read_ascii(data[start:], before, vertex, lines + 1)
        more = sum(1 for line in BytesIO(rest) if line.strip())
    else:
        columns, end = {}, start
        for element in (*before, vertex):
            start = end
            columns, end = _read_element(data, start, element, ORDERS[encoding])
        more = (len(data) - end) * vertex.count // (end - start)
    cloud = cloud_from_columns(columns, wanted)
    return noted(cloud, left_out(vertex.count, more) if more and vertex is elements[-1] else "")


def _read_element(
    data: bytes, start: int, element: _Element, order: str
) -> tuple[dict[str, NDArray[Any]], int]:
    """Read the values, not the lists, of all rows of a binary element; and give its end."""
    if not element.count or not element.properties:
        return {}, start
    # Lists mostly have the same length (triangles): then all rows are records like the first.
    record, end = _record(data, start, element, order)
    size = element.count * record.itemsize
    if start + size <= len(data):
        rows = np.frombuffer(data, record, element.count, start)
        lengths = [name for name in record.names or () if name.startswith("length ")]
        if all(np.all(rows[name] == rows[name][0]) for name in lengths):
            return {name: rows[name] for name in element.names}, start + size
    elif len(element.names) == len(element.properties):
        raise ReadError(
            f"the header promises {element.count} of element {element.name}, {size} bytes from "
            f"byte {start} on, the file has {len(data) - start}"
        )
    columns: dict[str, list[Any]] = {name: [] for name in element.names}
    for _ in range(element.count):
        record, end = _record(data, start, element, order)
        row = np.frombuffer(data, record, 1, start)[0]
        for name in element.names:
            columns[name].append(row[name])
        start = end
    return {name: np.array(column) for name, column in columns.items()}, start


def _record(
    data: bytes, start: int, element: _Element, order: str
) -> tuple[np.dtype[np.void], int]:
    """Give the data type of the row at `start`, with the length of its lists, and its end."""
    fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
    end = start
    for k, prop in enumerate(element.properties):
        count = 1
        if prop.length:
            kind = np.dtype(order + prop.length)
            if end + kind.itemsize > len(data):
                raise ReadError(f"ends within element {element.name}")
            count = int(np.frombuffer(data, kind, 1, end)[0])
            end += kind.itemsize
            if count < 0:
                raise ReadError(f"element {element.name} has a list of {count} values")
            # A name in the file has no blank, so these are not in use.
            fields.append((f"length {k}", order + prop.length))
            fields.append((f"list {k}", order + prop.kind, (count,)))
        else:
            fields.append((prop.name, order + prop.kind))
        end += count * np.dtype(prop.kind).itemsize
        if end > len(data):
            raise ReadError(f"ends within element {element.name}")
    return np.dtype(fields), end


def _parse_header(data: bytes) -> tuple[str, list[_Element], int, int]:
    end = re.search(rb"^end_header[ \t]*(\r\n|\n|\r)", data, re.MULTILINE)
    if end is None:
        # Old Macintosh files end their lines with a carriage return alone.
        end = re.search(rb"\rend_header[ \t]*\r", data)
    if data[:3] != b"ply" or end is None:
        raise ReadError("expected a header from 'ply' to 'end_header'")
    encoding, elements = "", list[_Element]()
    header = data[: end.start()].decode("ascii", errors="replace")
    lines = header.replace("\r\n", "\n").replace("\r", "\n").rstrip("\n").split("\n")
    names = set[str]()
    if len(lines) > MAX_HEADER:
        raise ReadError(f"a header of {len(lines)} lines, expected {MAX_HEADER} at most")
    for number, line in enumerate(lines, 1):
        tokens = line.split()
        try:
            match tokens:
                case ["format", name, _] if name in ORDERS and not encoding:
                    encoding = name
                case ["element", name, count] if 0 <= int(count) <= MAX_PROMISED:
                    elements.append(_Element(name, int(count), []))
                    names = set()
                case ["property", "list", length, kind, name] if PLY_TYPES[length][0] != "f":
                    elements[-1].properties.append(
                        _Property(name, PLY_TYPES[kind], PLY_TYPES[length])
                    )
                case ["property", kind, name]:
                    if name in names:
                        raise ValueError
                    names.add(name)
                    elements[-1].properties.append(_Property(name, PLY_TYPES[kind]))
                case [] | ["ply"] | ["comment" | "obj_info", *_]:
                    pass
                case _:
                    raise ValueError
        except (ValueError, KeyError, IndexError):
            stated = f"{line.strip()[:60]!r}, expected format, element or property as PLY has them"
            raise LineError(number, stated) from None
    if not encoding:
        raise ReadError(f"the header has no format line, expected {', '.join(ORDERS)}")
    return encoding, elements, end.end(), len(lines) + 1


def _read_ascii(
    body: bytes, before: list[_Element], vertex: _Element, line: int
) -> tuple[dict[str, NDArray[Any]], bytes]:
    """Read the vertices of a text, and give what follows them."""
    # One row per line, as all writers have it; blank lines are not used.
    if b"\r" in body:
        body = body.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    skipped = sum(element.count for element in before)
    rows, start, end, lines_before = 0, 0, 0, 0
    for k, row in enumerate(BytesIO(body)):
        if row.strip():
            rows += 1
            if rows == skipped + 1:
                start, lines_before = end, k
        end += len(row)
        if rows == skipped + vertex.count:
            break
    text = body[start:end]
    line += lines_before
    if len(vertex.names) < len(vertex.properties):
        # Blank lines are kept, so that messages name the right line of the file.
        text = b"\n".join(
            _without_lists(row, vertex, line + k) if row.strip() else b""
            for k, row in enumerate(BytesIO(text))
        )
    found = max(rows - skipped, 0)
    if found == vertex.count:
        table = read_table(text, len(vertex.names), line=line)
        found = len(table)
    if found != vertex.count:
        raise ReadError(f"has {found} lines of vertices, the header promises {vertex.count}")
    return dict(zip(vertex.names, table.T, strict=True)), body[end:]


def _without_lists(row: bytes, vertex: _Element, line: int) -> bytes:
    tokens, kept = row.split(), list[bytes]()
    position = 0
    for prop in vertex.properties:
        if position >= len(tokens):
            raise LineError(line, f"ends before property {prop.name}")
        word = tokens[position]
        position += 1
        if not prop.length:
            kept.append(word)
        elif word.isdigit():
            position += int(word)
        else:
            raise LineError(line, f"the length of list {prop.name} is not a number")
    if position != len(tokens):
        raise LineError(line, f"has {len(tokens)} values, expected {position}")
    return b" ".join(kept)
