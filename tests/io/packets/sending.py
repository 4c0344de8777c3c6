"""Packets of LiDARs for the tests: real ones, and those that are written by the tables."""

import shutil
import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from retropole.io.packets.models import MODELS, Blocks, Mirrors, Model
from tests.paths import SHARED

REAL = SHARED / "packets"


def bag_of(name: str, folder: Path) -> Path:
    """Make a ROS 2 bag of a folder of real packets."""
    source = REAL / name
    if not source.exists():
        pytest.skip(f"{source} is not here")
    pytest.importorskip("rosbags", reason="needs pip install 'retropole[ros]'")
    text = (source / "packets.yaml").read_text()
    database = text.partition("relative_file_paths:")[2].split()[1]
    own = folder / name
    own.mkdir()
    shutil.copy(source / "packets.db3", own / database)
    (own / "metadata.yaml").write_text(text)
    return own


def model_named(name: str) -> Model:
    return next(model for model in MODELS if model.name == name)


def datagram(payload: bytes, address: str = "192.168.1.201", port: int = 10000) -> bytes:
    """Put the headers of Ethernet, IP and UDP before a payload."""
    udp = struct.pack(">HHHH", port, 2368, 8 + len(payload), 0)
    sender = bytes(int(part) for part in address.split("."))
    ip = struct.pack(">BBHHHBBH4s4s", 69, 0, 28 + len(payload), 0, 0, 64, 17, 0, sender, b"\2" * 4)
    return b"\xff" * 12 + b"\x08\x00" + ip + udp + payload


def pcap(packets: Sequence[bytes]) -> bytes:
    parts = [struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1)]
    for k, packet in enumerate(packets):
        seconds, part = divmod(k * 1000, 10**6)
        parts.append(struct.pack("<4I", 1_700_000_000 + seconds, part, len(packet), len(packet)))
        parts.append(packet)
    return b"".join(parts)


def pcapng(packets: Sequence[bytes], order: str = "<") -> bytes:
    """Write blocks of a section, an interface with ticks of 1 ns, packets and something else."""

    def block(kind: int, body: bytes) -> bytes:
        body += bytes(-len(body) % 4)
        size = struct.pack(f"{order}I", 12 + len(body))
        return struct.pack(f"{order}I", kind) + size + body + size

    options = struct.pack(f"{order}HH", 9, 1) + b"\x09\0\0\0" + bytes(4)
    parts = [
        block(0x0A0D0D0A, struct.pack(f"{order}IHHq", 0x1A2B3C4D, 1, 0, -1)),
        block(1, struct.pack(f"{order}HHI", 1, 0, 0) + options),
        block(5, bytes(12)),
    ]
    for k, packet in enumerate(packets):
        time = 1_700_000_000_000_000_000 + k * 1_000_000
        head = 0, time >> 32, time & 0xFFFFFFFF, len(packet), len(packet)
        parts.append(block(6, struct.pack(f"{order}5I", *head) + packet))
    return b"".join(parts)


def angles_of(path: Path, channels: int, heading: str = "Channel,Elevation,Azimuth") -> Path:
    """Write a unit's own angles as Hesai's web page gives them."""
    rows = [f"{k + 1},{k - 5.5},{k / 100}" for k in range(channels)]
    path.write_text("\n".join([heading, *rows, "0123abcd"]) + "\n", encoding="utf-8-sig")
    return path


def turning(name: str, packets: int = 40) -> list[bytes]:
    """Write packets of a Hesai that turns by 1.5 degrees a block and sees a wall all around."""
    model = model_named(name)
    layout = model.layout
    assert isinstance(layout, Blocks)
    raw = np.full((packets, layout.count, layout.channels), 2500)
    azimuth = np.arange(packets * layout.count).reshape(packets, -1) * 150 % 36_000
    return hesai(model, raw, azimuth << 8 if isinstance(layout, Mirrors) else azimuth)


def hesai(model: Model, distance: NDArray[np.int64], azimuth: NDArray[np.int64]) -> list[bytes]:
    """Write packets of Hesai as a table says: single returns.

    Parameters
    ----------
    distance
        (N, B, C) as sent; the intensity is the channel.
    azimuth
        (N, B) 0.01°; of an AT128 1/256 of that.
    """
    layout = model.layout
    assert isinstance(layout, Blocks)
    packets = []
    for k, (blocks, turned) in enumerate(zip(distance, azimuth, strict=True)):
        packet = bytearray(min(model.sizes))
        for at, first, *_ in model.marks:
            mark = bytes.fromhex(str(first))
            packet[int(at) : int(at) + len(mark)] = mark
        for b, (channels, own) in enumerate(zip(blocks, turned, strict=True)):
            at = layout.start + b * layout.block
            fine = isinstance(layout, Mirrors)
            struct.pack_into("<H", packet, at + layout.azimuth, own >> 8 if fine else own)
            if isinstance(layout, Mirrors):
                packet[at + layout.fine] = own & 255
            for c, raw in enumerate(channels):
                start = at + layout.distance + c * layout.channel
                struct.pack_into("<HB", packet, start, raw, c)
        if layout.returns:
            packet[layout.returns] = 0x37
        packet[layout.date : layout.date + 6] = bytes([124, 2, 3, 4, 5, 6])
        struct.pack_into("<I", packet, layout.microseconds, 100 * k)
        packets.append(bytes(packet))
    return packets
