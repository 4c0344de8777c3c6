"""Recordings of Livox' viewers, written as their specifications describe them."""

from __future__ import annotations

import struct
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from retropole.base.errors import ReadError
from retropole.io import open_recording, read_cloud, topics_of

FIRST = 1_700_000_000 * 10**9
SERIALS = {0x0C01A8C0: b"47MDL4C0020046", 0x0D01A8C0: b"47MDL4C0020047"}


def _frames(start: int, bodies: list[bytes]) -> bytes:
    """Put each body into a frame, which says where it is and where the next one begins."""
    written = b""
    for number, body in enumerate(bodies):
        at = start + len(written)
        written += struct.pack("<QQQ", at, at + 24 + len(body), number) + body
    return written


def _new(points: dict[int, list[list[tuple[int, bytes]]]]) -> bytes:
    """Write LVX2: of each LiDAR the frames, each of some packages of a type and its points."""
    file = b"livox_tech".ljust(16, b"\0") + bytes([2, 0, 0, 0]) + struct.pack("<I", 0xAC0EA767)
    file += struct.pack("<IB", 50, len(points))
    for lidar in points:
        file += SERIALS[lidar].ljust(16, b"\0") + bytes(16) + struct.pack("<IBBB", lidar, 0, 9, 0)
        file += struct.pack("<6f", 0, 0, 0, 0, 0, 0)
    bodies = []
    for number in range(len(next(iter(points.values())))):
        body = b""
        for lidar, frames in points.items():
            for k, (kind, content) in enumerate(frames[number]):
                time = FIRST + number * 50_000_000 + k * 480_000
                body += struct.pack("<BIBBQ", 0, lidar, 8, 1, time)
                body += struct.pack("<HBIB4x", k, kind, len(content), number) + content
        bodies.append(body)
    return file + _frames(len(file), bodies)


def _old(bodies: list[bytes]) -> bytes:
    """Write LVX 1.1 of one LiDAR."""
    file = b"livox_tech".ljust(16, b"\0") + bytes([1, 1, 0, 0]) + struct.pack("<I", 0xAC0EA767)
    file += struct.pack("<IB", 50, 1) + b"3JEDK380010Z391".ljust(16, b"\0") + bytes(16)
    file += struct.pack("<BBB6f", 0, 7, 0, 0, 0, 0, 0, 0, 0)
    return file + _frames(len(file), bodies)


def _points(rng: np.random.Generator, form: str = "<iiiBB") -> tuple[bytes, np.ndarray]:
    sent = np.column_stack([rng.integers(400, 9000, (96, 3)), rng.integers(0, 256, 96)])
    return b"".join(struct.pack(form, *each, 0) for each in sent.tolist()), sent


def test_lvx2(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    whole, parts = [_points(rng) for _ in range(5)], [_points(rng, "<hhhBB") for _ in range(5)]
    frames = [[(1, w[0]), (0, bytes(24)), (2, p[0])] for w, p in zip(whole, parts, strict=True)]
    path = tmp_path / "a.lvx2"
    path.write_bytes(_new({0x0C01A8C0: frames}))
    recording = open_recording(path)
    assert (recording.count, recording.topic) == (5, "47MDL4C0020046")
    for frame, high, low in zip(recording.read(range(5)), whole, parts, strict=True):
        wanted = np.vstack([high[1][:, :3] / 1000, low[1][:, :3] / 100])
        np.testing.assert_allclose(frame.cloud.xyz, wanted)
        np.testing.assert_array_equal(frame.cloud.intensity, np.append(high[1][:, 3], low[1][:, 3]))
        assert frame.stamp == pytest.approx(FIRST / 1e9 + 0.05 * frame.number)
        assert frame.cloud.time is not None
        assert np.ptp(frame.cloud.time) == pytest.approx(0.00096, abs=1e-6)
        assert not frame.cloud.notes
    cloud = read_cloud(path, frames=slice(1, 3))
    assert len(cloud) == 4 * 96
    assert cloud.recorded == pytest.approx((FIRST / 1e9 + 0.05, FIRST / 1e9 + 0.1))


def test_several_lidars(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    one, two = _points(rng), _points(rng)
    path = tmp_path / "a.lvx2"
    path.write_bytes(_new({0x0C01A8C0: [[(1, one[0])]], 0x0D01A8C0: [[(1, two[0])]]}))
    assert [each.name for each in topics_of(path)] == ["47MDL4C0020046", "47MDL4C0020047"]
    with pytest.raises(ReadError, match=r"has 2 LiDARs, expected one of: 47MDL4C0020046, 47"):
        read_cloud(path)
    with pytest.raises(ReadError, match=r"has no LiDAR 48, expected one of"):
        read_cloud(path, topic="48")
    cloud = read_cloud(path, topic="47MDL4C0020047")
    np.testing.assert_allclose(cloud.xyz, two[1][:, :3] / 1000)


def test_lvx(tmp_path: Path) -> None:
    (body, sent), path = _points(np.random.default_rng(4)), tmp_path / "a.lvx"
    package = struct.pack("<BBBBBIBBQ", 0, 5, 1, 1, 0, 0, 0, 2, FIRST) + body
    motion = struct.pack("<BBBBBIBBQ", 0, 5, 1, 1, 0, 0, 0, 6, FIRST) + bytes(24)
    angles = struct.pack("<BBBBBIBBQ", 0, 5, 1, 1, 0, 0, 0, 3, FIRST) + bytes(960)
    path.write_bytes(_old([package + motion, motion + angles + package]))
    frames = list(open_recording(path).read(range(2)))
    for frame in frames:
        np.testing.assert_allclose(frame.cloud.xyz, sent[:, :3] / 1000)
    assert [frame.cloud.notes for frame in frames] == [(), ("points of type 3 are not read",)]


@pytest.mark.parametrize("cut", [30, 100, 140, 1000, 2000])
def test_cut(tmp_path: Path, cut: int) -> None:
    body, _ = _points(np.random.default_rng(5))
    path = tmp_path / "a.lvx2"
    path.write_bytes(_new({0x0C01A8C0: [[(1, body)], [(1, body)]]})[:cut])
    if cut < 1500:
        with pytest.raises(ReadError, match=r"a\.lvx2"):
            read_cloud(path)
    else:
        cloud = read_cloud(path)
        assert (len(cloud), cloud.notes) == (96, ("the last frame is cut",))


def test_damaged(tmp_path: Path) -> None:
    """No traceback, and nothing larger than the file can hold."""
    rng = np.random.default_rng(6)
    body, _ = _points(rng)
    made = [_new({0x0C01A8C0: [[(1, body)] * 2] * 3}), _old([body] * 2)]
    for k in range(400):
        damaged = bytearray(made[k % 2])
        for _ in range(int(rng.integers(1, 6))):
            damaged[rng.integers(0, len(damaged))] = rng.integers(0, 256)
        path = tmp_path / ("a.lvx" if k % 2 else "a.lvx2")
        path.write_bytes(damaged[: rng.integers(20, len(damaged))])
        with suppress(ReadError):
            assert len(read_cloud(path)) <= 96 * 6
