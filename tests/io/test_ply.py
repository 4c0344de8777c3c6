"""PLY in its three encodings, with what other programs put beside the points."""

import struct
from pathlib import Path

import numpy as np
import pytest

from retropole.base.errors import ReadError
from retropole.io import read_cloud

ENCODINGS = ["ascii", "binary_little_endian", "binary_big_endian"]
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
CODES = {"uchar": "B", "short": "h", "int": "i", "float": "f", "double": "d"}
Row = list[float | list[int]]

VERTICES: list[Row] = [[1.5, -2.0, 3.0, 7], [4.0, 5.0, 6.25, 8], [0.0, 0.0, 0.0, 9]]
VERTEX = "element vertex 3\nproperty float x\nproperty double y\nproperty float z\n"
VERTEX += "property uchar intensity\n"
VERTEX_KINDS = ["float", "double", "float", "uchar"]


def pack(encoding: str, kinds: list[str], rows: list[Row]) -> bytes:
    """Write rows; a list of whole numbers is counted by a uchar and held as ints."""
    if encoding == "ascii":
        words = [
            " ".join(
                f"{len(v)} {' '.join(map(str, v))}" if isinstance(v, list) else f"{v}" for v in row
            )
            for row in rows
        ]
        return "".join(word.strip() + "\n" for word in words).encode()
    order, out = ORDERS[encoding], b""
    for row in rows:
        for kind, value in zip(kinds, row, strict=True):
            if isinstance(value, list):
                out += struct.pack(f"{order}B{len(value)}i", len(value), *value)
            else:
                out += struct.pack(order + CODES[kind], value)
    return out


def write(path: Path, encoding: str, elements: str, body: bytes, end: str = "\n") -> None:
    head = f"ply\nformat {encoding} 1.0\ncomment made for a test\n{elements}end_header\n"
    path.write_bytes(head.replace("\n", end).encode() + body)


def assert_vertices(path: Path) -> None:
    cloud = read_cloud(path)
    np.testing.assert_array_equal(cloud.xyz, [row[:3] for row in VERTICES[:2]])
    np.testing.assert_array_equal(cloud.intensity, [7, 8])
    assert cloud.dropped == 1


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_encodings_agree(tmp_path: Path, encoding: str, end: str) -> None:
    body = pack(encoding, VERTEX_KINDS, VERTICES)
    if encoding == "ascii":
        body = body.replace(b"\n", end.encode())
    write(tmp_path / "a.ply", encoding, VERTEX, body, end)
    assert_vertices(tmp_path / "a.ply")


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("faces", [[[0, 1, 2], [2, 1, 0]], [[0, 1, 2], [], [0]]], ids=len)
@pytest.mark.parametrize("first", [True, False])
def test_other_elements_are_passed_over(
    tmp_path: Path, encoding: str, faces: list[list[int]], first: bool
) -> None:
    camera = "element camera 1\nproperty short id\nproperty double focus\n"
    camera_body = pack(encoding, ["short", "double"], [[3, 0.5]])
    face = f"element face {len(faces)}\nproperty list uchar int vertex_indices\n"
    face_body = pack(encoding, ["list"], [[list(f)] for f in faces])
    head, body = camera + face, camera_body + face_body
    vertices = pack(encoding, VERTEX_KINDS, VERTICES)
    if first:
        write(tmp_path / "a.ply", encoding, head + VERTEX, body + vertices)
    else:
        write(tmp_path / "a.ply", encoding, VERTEX + head, vertices + body)
    assert_vertices(tmp_path / "a.ply")


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("lists", [[[1, 2]] * 3, [[1], [], [2, 3]]], ids=["equal", "varied"])
def test_lists_of_vertices_are_passed_over(
    tmp_path: Path, encoding: str, lists: list[list[int]]
) -> None:
    head = VERTEX.replace("property double y", "property list uchar int seen\nproperty double y")
    rows: list[Row] = [[row[0], seen, *row[1:]] for row, seen in zip(VERTICES, lists, strict=True)]
    kinds = ["float", "list", "double", "float", "uchar"]
    write(tmp_path / "a.ply", encoding, head, pack(encoding, kinds, rows))
    assert_vertices(tmp_path / "a.ply")


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_byte_too_few_is_an_error(tmp_path: Path, encoding: str) -> None:
    body = pack(encoding, VERTEX_KINDS, VERTICES)
    cut = -1 if encoding != "ascii" else -3
    write(tmp_path / "a.ply", encoding, VERTEX, body[:cut])
    with pytest.raises(ReadError, match=r"promises|line"):
        read_cloud(tmp_path / "a.ply")


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_promise_of_a_header_takes_no_memory(tmp_path: Path, encoding: str) -> None:
    head = VERTEX.replace("vertex 3", "vertex 1000000000000")
    write(tmp_path / "a.ply", encoding, head, pack(encoding, VERTEX_KINDS, VERTICES))
    with pytest.raises(ReadError, match="1000000000000 vertices"):
        read_cloud(tmp_path / "a.ply")


@pytest.mark.parametrize(
    ("elements", "message"),
    [
        ("element vertex x\n", "line 4.*vertex x"),
        ("property float x\n", "line 4"),
        ("element vertex 1\nproperty quad x\n", "line 5.*quad"),
        ("element vertex 1\nproperty float x\nproperty float x\n", "line 6"),
        ("element vertex 1\nproperty list float int x\n", "line 5"),
        ("element vertex -1\n", "line 4"),
        ("nonsense\n", "line 4.*nonsense"),
        ("element face 1\nproperty int i\n", "no element vertex.*face"),
        ("element vertex 1\n", "no values"),
        ("element vertex 0\nproperty float x\n", "vertex 0"),
        ("element vertex 1\nproperty float x\nproperty float y\n", "z is missing.*x, y"),
    ],
)
def test_errors_name_the_line(tmp_path: Path, elements: str, message: str) -> None:
    write(tmp_path / "a.ply", "ascii", elements, b"1 2 3\n"[: 2 * elements.count("property")])
    with pytest.raises(ReadError, match=message):
        read_cloud(tmp_path / "a.ply")


def test_error_in_the_body_names_the_line(tmp_path: Path) -> None:
    write(tmp_path / "a.ply", "ascii", VERTEX, b"1 2 3 4\n\n1 2 3 4\n1 x 3 4\n")
    with pytest.raises(ReadError, match=r"line 13.*1 x 3 4"):
        read_cloud(tmp_path / "a.ply")


@pytest.mark.parametrize("content", [b"plx\nend_header\n", b"ply\nformat ascii 1.0\n"])
def test_no_ply(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(ReadError, match="'ply' to 'end_header'"):
        read_cloud(tmp_path / "a.ply")


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_vertices_that_the_header_does_not_promise_are_reported(
    tmp_path: Path, encoding: str
) -> None:
    body = pack(encoding, VERTEX_KINDS, [*VERTICES, *VERTICES[:2]])
    write(tmp_path / "a.ply", encoding, VERTEX, body)
    (note,) = read_cloud(tmp_path / "a.ply").notes
    assert note == "the header promises 3 points, the 2 that follow them are left out"
    # What follows the vertices may be another element.
    write(tmp_path / "a.ply", encoding, VERTEX + "element face 0\n", body)
    assert read_cloud(tmp_path / "a.ply").notes == ()


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_header_of_many_properties_is_refused(tmp_path: Path, encoding: str) -> None:
    properties = "".join(f"property uchar p{k}\n" for k in range(40_000))
    write(tmp_path / "a.ply", encoding, VERTEX + properties, bytes(3 * 50_000))
    with pytest.raises(ReadError, match=r"a\.ply: a header of 400.. lines, expected 10000 at most"):
        read_cloud(tmp_path / "a.ply")
