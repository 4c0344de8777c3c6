"""Recordings of every format, damaged in every way that a disk, a transfer or an editor has.

Run as a program, it holds readers and commands against them:
``python -m tests.damage FIRST LAST FOLDER``.
"""

from __future__ import annotations

import faulthandler
import json
import random
import resource
import struct
import sys
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from importlib.util import find_spec
from io import BytesIO, StringIO, TextIOWrapper
from pathlib import Path
from time import process_time

import numpy as np

from retropole.base.datatypes import PER_POINT, PointCloud
from retropole.base.errors import MissingExtraError, ReadError, UsageError
from retropole.cli import run
from retropole.io import read_cloud
from tests.io.exports import EXPORTS, write_livox_bag
from tests.io.files import INTENSITY, WRITERS, XYZ
from tests.io.packets import sending
from tests.memory import peak_memory

LONGEST = 10.0
"""CPU seconds that no file may take to be read, and no command with it."""

HANGS = 20.0
"""What takes so many times as long by the clock hangs: a busy machine is no counterexample."""

RIGHT_DEG, RIGHT_M = 1.0, 0.1
"""A pose so near to the truth is right: ten times what such scans leave open."""

MOST_MEMORY = 2**30
"""Bytes that no process may reach, however damaged the files are that it reads."""

COMMAND_EVERY = 20
"""Every so many files are also given to a command, which takes longer than reading alone."""

UNPACKED = {".npz": 1100, ".laz": 1000, ".pcd": 300, ".mcap": 300, ".bag": 300, ".db3": 300}
UNPACKED |= {".pcap": 2, ".pcapng": 2}
"""Bytes that one byte of a format can hold, where it is compressed."""

MOST_ADDED = 2**20
"""Bytes that are added to a file: more only takes time."""

NUMBERS = (
    *(b"0", b"-1", b"1", b"2", b"255", b"65536", b"2147483647", b"4294967295", b"1e308", b"1e999"),
    *(b"9223372036854775807", b"18446744073709551616", b"9" * 400, b"nan", b"inf", b"-inf", b""),
    *(b"1_000", b"0x10", b"1,5", b"\xd9\xa3", b"x", b"\x00", b"\x1b[2J", b"#", b"'", b'"'),
)
"""What stands in a text where there was a number."""

SIZES = (0, 1, 2, 3, 7, 255, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**62, 2**63, 2**64 - 1)
"""What a count or an offset is in a binary header."""

FLOATS = (float("nan"), float("inf"), -float("inf"), 0.0, 1e-320, 1e30, 1e308, -1e308)


def recordings(folder: Path) -> dict[str, bytes]:
    """Small recordings: by a name that ends with their suffix, their bytes."""
    found = {}
    for suffix, make in WRITERS.items():
        if suffix in (".las", ".laz") and find_spec("laspy") is None:
            continue
        path = folder / f"plain{suffix}"
        make(path)
        found[path.name] = path.read_bytes()
    cloud = PointCloud(XYZ, intensity=INTENSITY, ring=np.array([0, 1, 2]))
    found |= {name: make(cloud) for name, make in EXPORTS.items()}
    found |= {f"{name}.pcd": pcd(name) for name in ("ascii", "binary_compressed")}
    found |= {f"{order}.ply": ply(order) for order in ("little", "big")}
    if find_spec("velodyne_decoder") is not None:
        found["velodyne.pcap"] = velodyne()
    found |= captures()
    if find_spec("apsw") is not None:
        found |= bags(folder)
    return found


def pcd(encoding: str) -> bytes:
    """Write a PCD with a field of two values and padding, as text or compressed."""
    import lzf

    table = np.column_stack([XYZ, INTENSITY, XYZ[:, :2]]).astype("<f4")
    header = (
        "VERSION 0.7\nFIELDS x y z intensity pair\nSIZE 4 4 4 4 4\nTYPE F F F F F\n"
        f"COUNT 1 1 1 1 2\nWIDTH {len(table)}\nHEIGHT 1\nVIEWPOINT 0 0 1 1 0 0 0\n"
        f"POINTS {len(table)}\nDATA {encoding}\n"
    ).encode()
    if encoding == "ascii":
        return header + b"".join(b" ".join(b"%g" % v for v in row) + b"\n" for row in table)
    # What the library cannot make shorter it does not compress.
    table = np.repeat(table, 20, axis=0)
    header = header.replace(b" 3\n", f" {len(table)}\n".encode())
    plain = table.T.tobytes()
    packed = lzf.compress(plain)
    return bytes(header + struct.pack("<II", len(packed), len(plain)) + packed)


def ply(order: str) -> bytes:
    """Write a binary PLY with faces before and a list among the vertices."""
    mark = "<" if order == "little" else ">"
    header = (
        f"ply\nformat binary_{order}_endian 1.0\ncomment made up\n"
        "element face 2\nproperty list uchar int vertex_indices\n"
        "element vertex 3\nproperty float x\nproperty float y\nproperty double z\n"
        "property list uchar ushort near\nproperty uchar intensity\nend_header\n"
    ).encode()
    faces = struct.pack(f"{mark}B3iB2i", 3, 0, 1, 2, 2, 0, 1)
    rows = [
        struct.pack(f"{mark}ffdBHHB", *xyz, 2, 5, 6, int(value))
        for xyz, value in zip(XYZ, INTENSITY, strict=True)
    ]
    return header + faces + b"".join(rows)


def captures() -> dict[str, bytes]:
    """Write captures of one Hesai each, as pcap and as pcapng, and of two together."""
    models = ("XT16", "Pandar40P", "OT128", "AT128", "JT16")
    sent = {name: [sending.datagram(own) for own in sending.turning(name)] for name in models}
    found = {f"{name}.pcap": sending.pcap(packets) for name, packets in sent.items()}
    both = [*sent["XT16"], *(sending.datagram(own, "10.0.0.1") for own in sending.turning("XT16"))]
    return found | {"two.pcap": sending.pcap(both), "ng.pcapng": sending.pcapng(sent["XT16"])}


def velodyne() -> bytes:
    """Write two turns of a VLP-16 in steps of 6 degrees."""
    records = [struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1)]
    for k in range(10):
        payload = b""
        for block in range(12):
            azimuth = (k * 12 + block) * 600 % 36_000
            payload += struct.pack("<HH", 0xEEFF, azimuth)
            payload += b"".join(struct.pack("<HB", 2500 + channel, 80) for channel in range(32))
        records.append(record(k, datagram(payload + struct.pack("<IBB", 1000 * k, 0x37, 0x22))))
    return b"".join(records)


def datagram(payload: bytes) -> bytes:
    """Put the headers of Ethernet, IP and UDP before a payload."""
    udp = struct.pack(">HHHH", 2368, 2368, 8 + len(payload), 0)
    words = (69, 0, 28 + len(payload), 0, 0, 64, 17, 0, b"\1" * 4, b"\2" * 4)
    ip = struct.pack(">BBHHHBBH4s4s", *words)
    return b"\xff" * 12 + b"\x08\x00" + ip + udp + payload


def record(second: int, packet: bytes) -> bytes:
    """Put the header of a pcap's record before a packet."""
    return struct.pack("<IIII", second, 0, len(packet), len(packet)) + packet


def bags(folder: Path) -> dict[str, bytes]:
    """Write bags of two topics, plain and compressed."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import CompressionFormat, CompressionMode

    from tests.bags import points_of, write_bag

    cloud = PointCloud(XYZ, intensity=INTENSITY, ring=np.array([0, 1, 2]))
    points = points_of(cloud)
    packing = CompressionMode.MESSAGE, CompressionFormat.ZSTD
    found = {}
    for name, kind, compression in (
        ("plain", "bag", None),
        ("lz4", "bag", Writer1.CompressionFormat.LZ4),
        ("plain", "db3", None),
        ("plain", "mcap", None),
        ("zstd", "mcap", (CompressionMode.STORAGE, CompressionFormat.ZSTD)),
        ("zstd", "db3", packing),
    ):
        own = folder / f"{name} {kind}"
        own.mkdir()
        path = write_bag(own, kind, {"/a": [points] * 2, "/b": []}, compression=compression)
        if path.is_file() and path.suffix == f".{kind}":
            found[f"{name}.{kind}"] = path.read_bytes()
    for kind in ("bag", "db3", "mcap"):
        own = folder / f"livox {kind}"
        own.mkdir()
        path = write_livox_bag(own, [cloud] * 2, "livox_ros_driver2", kind)
        path = path if path.is_file() else next(path.glob(f"*.{kind}"))
        found[f"livox.{kind}"] = path.read_bytes()
    return found


def cut(data: bytearray, dice: random.Random) -> None:
    del data[dice.randrange(len(data)) :]


def flip(data: bytearray, dice: random.Random) -> None:
    for _ in range(dice.choice((1, 1, 3, 30))):
        data[dice.randrange(len(data))] ^= 1 << dice.randrange(8)


def set_bytes(data: bytearray, dice: random.Random) -> None:
    at, length = dice.randrange(len(data)), dice.choice((1, 2, 8, 64))
    data[at : at + length] = dice.choice((b"\0", b"\xff", b" ", b"\n", b"\x80")) * length


def set_size(data: bytearray, dice: random.Random) -> None:
    """Change a number of a binary header; mostly near the start or the end, where these are."""
    width, order = dice.choice((1, 2, 4, 8)), dice.choice("<>")
    near = dice.choice((64, 512, len(data)))
    at = dice.randrange(min(near, len(data)))
    at = len(data) - 1 - at if dice.random() < 0.2 else at
    value = dice.choice(SIZES) if dice.random() < 0.7 else dice.randrange(2**64)
    packed = struct.pack(f"{order}Q", value % 2 ** (8 * width))
    data[at : at + width] = packed[:width] if order == "<" else packed[-width:]


def set_float(data: bytearray, dice: random.Random) -> None:
    kind = dice.choice(("<f", "<d", ">d"))
    value = dice.choice(FLOATS[:6] if kind == "<f" else FLOATS)
    at = dice.randrange(len(data))
    data[at : at + struct.calcsize(kind)] = struct.pack(kind, value)


def set_word(data: bytearray, dice: random.Random) -> None:
    """Put something else in the place of a word of a text."""
    end = dice.choice((300, len(data)))
    blanks = [k for k in range(min(len(data), end)) if data[k] in b" \n,\t"]
    if blanks:
        k = dice.randrange(len(blanks))
        last = blanks[k + 1] if k + 1 < len(blanks) else len(data)
        data[blanks[k] + 1 : last] = dice.choice(NUMBERS)


def lines(data: bytearray, dice: random.Random) -> None:
    """Remove, repeat or swap lines."""
    all_lines = bytes(data).split(b"\n")
    k, j = dice.randrange(len(all_lines)), dice.randrange(len(all_lines))
    what = dice.randrange(4)
    if what == 0:
        del all_lines[k]
    elif what == 1:
        all_lines.insert(j, all_lines[k])
    elif what == 2:
        all_lines[k], all_lines[j] = all_lines[j], all_lines[k]
    else:
        times = min(dice.choice((10, 1000)), MOST_ADDED // (1 + len(all_lines[k])))
        all_lines[k:k] = [all_lines[k]] * times
    data[:] = b"\n".join(all_lines)


def parts(data: bytearray, dice: random.Random) -> None:
    """Remove, repeat, swap or put in a part."""
    a, b = sorted((dice.randrange(len(data)), dice.randrange(len(data))))
    b = min(b, a + dice.choice((1, 16, 4096)))
    part, at = bytes(data[a:b]), dice.randrange(len(data))
    what = dice.randrange(3)
    if what != 1:
        del data[a:b]
    if what == 2:
        at = min(at, len(data))
    if what != 0:
        data[at:at] = part * dice.choice((1, 1, 3))


DAMAGE: tuple[Callable[[bytearray, random.Random], None], ...] = (
    *(cut, flip, flip, set_bytes, set_size, set_size, set_float, set_word, set_word, lines, parts),
)


def damaged(data: bytes, dice: random.Random) -> bytes:
    """Damage a file once or several times."""
    changed = bytearray(data)
    for _ in range(dice.choice((1, 1, 1, 2, 5))):
        if changed:
            dice.choice(DAMAGE)(changed, dice)
    return bytes(changed)


def hold_reader(path: Path) -> str:
    """Read a file: an error that is documented, or a cloud that the file can hold."""
    try:
        cloud = read_cloud(path)
    except (ReadError, UsageError) as error:
        words = str(error)
        assert str(path) in words, f"does not name the file: {words[:200]!r}"
        assert len(words) - len(str(path)) <= 300, f"{len(words)} characters: {words!r}"
        assert words.isprintable(), f"control characters: {words!r}"
        return "error"
    for name in PER_POINT:
        column = getattr(cloud, name)
        assert column is None or len(column) == len(cloud)
    assert len(cloud) > 0
    assert np.isfinite(cloud.xyz).all()
    assert cloud.intensity is None or np.isfinite(cloud.intensity).all()
    most = path.stat().st_size * UNPACKED.get(path.suffix, 1) / 3
    assert len(cloud) + cloud.dropped <= most, f"{len(cloud)} + {cloud.dropped} points"
    return "cloud"


def hold_command(path: Path, dice: random.Random) -> str:
    """Give a file to a command: it answers, refuses, or says what is wrong and what to do."""
    words = ["info", str(path), *dice.choice(([], ["--json"]))]
    code, _ = ran(words)
    return f"info: exit {code}"


def ran(words: list[str]) -> tuple[int, str]:
    """Run a command; what it prints with an answer."""
    out, err = TextIOWrapper(BytesIO(), "utf-8"), StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        code = run(words)
    assert code in (0, 2, 3), f"{words[0]} ended with {code}"
    if code == 2:
        lines = err.getvalue().splitlines()
        errors = [line for line in lines if line.startswith("retropole: error: ")]
        known = ("retropole: ", "what to do: ", " ")
        assert len(errors) == 1, err.getvalue()
        assert len(lines) <= 4, err.getvalue()
        assert all(line.startswith(known) for line in lines), err.getvalue()
    out.seek(0)
    return code, out.read()


def scans(folder: Path) -> dict[str, bytes]:
    """Write the scans of two LiDARs, and give that of the first in several formats."""
    words = "simulate corridor --seed 3 --sensor VLP-16 -q --out"
    assert run([*words.split(), str(folder)]) == 0
    cloud = read_cloud(folder / "lidar0.pcd")
    assert cloud.intensity is not None
    table = np.column_stack([cloud.xyz, cloud.intensity]).astype("<f4")
    text, array = BytesIO(), BytesIO()
    np.savetxt(text, table, "%.4f", ",", header="x,y,z,intensity", comments="")
    np.save(array, table)
    plain = (folder / "lidar0.pcd").read_bytes()
    return {
        "scan.pcd": plain,
        "scan.csv": text.getvalue(),
        "scan.npy": array.getvalue(),
        "scan.bin": table.tobytes(),
    }


def hold_calibration(found: dict[str, bytes], folder: Path, dice: random.Random) -> str:
    """Calibrate with a damaged scan: an error, or a pose that is right or not called ok."""
    name = dice.choice(sorted(found))
    path = folder / f"damaged-{name}"
    path.write_bytes(damaged(found[name], dice))
    words = ["calibrate", str(path), str(folder / "lidar1.pcd"), "--json", "--out"]
    code, said = ran([*words, str(folder / "out")])
    if code:
        return f"calibrate: exit {code}"
    result = json.loads(said)
    truth = json.loads((folder / "truth.json").read_text())["T_target_source"]
    off = np.array(truth) @ np.linalg.inv(result["T_target_source"])
    turned = np.degrees(np.arccos(np.clip((np.trace(off[:3, :3]) - 1) / 2, -1, 1)))
    moved = np.linalg.norm(np.subtract(truth, result["T_target_source"])[:3, 3])
    is_right = turned < RIGHT_DEG and moved < RIGHT_M
    assert is_right or result["status"] != "ok", f"ok, but off by {turned:.2f} deg, {moved:.3f} m"
    return f"calibrate: {result['status']}{'' if is_right else ', wrong'}"


def hold(seed: int, found: dict[str, bytes], scanned: dict[str, bytes], folder: Path) -> str:
    """Damage a file of any format, and read it; some are given to a command."""
    dice = random.Random(seed)
    suffix = dice.choice(sorted({Path(name).suffix for name in found}))
    name = dice.choice(sorted(name for name in found if name.endswith(suffix)))
    path = folder / f"damaged{suffix}"
    path.write_bytes(damaged(found[name], dice))
    for left in folder.glob(f"{path.name}-*"):
        left.unlink()
    with ended_after(LONGEST):
        came = hold_reader(path)
    if seed % COMMAND_EVERY:
        return f"{path.suffix} {came}"
    with ended_after(LONGEST):
        return hold_calibration(scanned, folder, dice) if seed % 3 else hold_command(path, dice)


@contextmanager
def ended_after(seconds: float) -> Iterator[None]:
    """End the process where something hangs, in C code as well: no exception would do that.

    What ends, but takes more CPU seconds than are given, is a failure.
    """
    faulthandler.dump_traceback_later(HANGS * seconds, exit=True)
    start = process_time()
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()
        took = process_time() - start
        assert took <= seconds, f"took {took:.1f} s of CPU time"


def main(first: int, last: int, folder: Path) -> int:
    """Hold many, print what came out, and give the exit code."""
    # An array that NumPy cannot fill stops here; what counts is the memory that is in use.
    resource.setrlimit(resource.RLIMIT_AS, (8 * MOST_MEMORY, resource.RLIM_INFINITY))
    warnings.simplefilter("error", RuntimeWarning)
    found, scanned = recordings(folder), scans(folder)
    came: Counter[str] = Counter()
    wrong = 0
    for seed in range(first, last):
        (folder / "seed").write_text(str(seed))
        try:
            came[hold(seed, found, scanned, folder)] += 1
        except MissingExtraError:
            came["extra missing"] += 1
        except Exception as error:
            wrong += 1
            place = traceback.extract_tb(error.__traceback__)[-1]
            print(f"seed {seed}: {type(error).__name__}: {error!s:.300}", flush=True)
            print(f"  {place.filename}:{place.lineno} {place.line}", flush=True)
    memory = peak_memory()
    print(f"{last - first} files, {wrong} wrong, {memory / 2**20:.0f} MiB: {sorted(came.items())}")
    return 0 if not wrong and memory < MOST_MEMORY else 1


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3])))
