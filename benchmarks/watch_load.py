"""Does a watch keep up with two LiDARs, and how fast are packets decoded?

Usage:
    python benchmarks/watch_load.py --minutes 10
    python benchmarks/watch_load.py --by udp --minutes 2
    python benchmarks/watch_load.py --decode 1000000

Two publishers, processes of their own, send sweeps of a simulated street at 10 Hz: by DDS on
loopback 100,000 points each, one as a Hesai driver lays them out and one as a Velodyne driver, one
reliably and one not; or by UDP packets of two OT128 of 1.2 million points a second each. Once a
minute: sweeps a second of each that were searched, how long ago the newest was, s, and memory, MB.
The need cannot be met, so that the watch goes on.

``--decode`` writes captures of so many packets, in which every firing has a return, and prints how
many times as fast as a LiDAR sends them one core decodes and reads them, by CPU time.
"""

from __future__ import annotations

import argparse
import resource
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from again import record_again
from retropole.api.watching import Watch, Wish, open_sources
from retropole.base.datatypes import IntArray, PointCloud
from retropole.io.fields import Wanted
from retropole.io.packets import open_packets
from retropole.io.packets.models import Angles, Blocks, Interpolated, Mirrors, Model, Points
from retropole.io.packets.sweeps import index_of, positions_of, sweeps_of
from retropole.result import RunConfig
from retropole.simulation import simulate_pair

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.io.packets.sending import datagram, hesai, model_named
from tests.io.packets.written import MANUALS, as_array

SWEEPS, POINTS = 5, 100_000
DOMAIN = "87"

OF_UDP, HERTZ = 1_200_000, 10
"""Points a second of each LiDAR that sends packets, and its turns."""

RATES = {
    "XT32": 640_000,
    "Pandar64": 1_152_000,
    "QT128": 864_000,
    "OT128": 3_456_000,
    "AT128": 1_536_000,
    "Helios": 576_000,
    "Ruby": 2_304_000,
    "Airy": 1_720_000,
    "M1": 787_500,
    "C32": 640_000,
    "Mid-360, HAP": 200_000,
}
"""Points a second by the makers' data sheets, single return."""

START = 1_700_000_000
"""When captures begin, Unix seconds."""

Packets = NDArray[np.uint8]


def memory() -> float:
    """Memory of this process, MB (Linux)."""
    with open("/proc/self/status") as file:
        return next(int(line.split()[1]) for line in file if line.startswith("VmRSS")) / 1024


def streets() -> list[list[PointCloud]]:
    """Sweeps of both LiDARs in a simulated street."""
    pair = simulate_pair("street", np.random.default_rng(3))
    again = [record_again(pair, np.random.default_rng(k)) for k in range(SWEEPS)]
    return [[getattr(one, name) for one in again] for name in ("target", "source")]


def stored(folder: Path) -> list[Path]:
    """Write sweeps for the publishers, points repeated up to `POINTS`."""
    paths = []
    for name, clouds in zip(("target", "source"), streets(), strict=True):
        arrays = {}
        for k, cloud in enumerate(clouds):
            # The bright ones once: a pole has no more returns than it has.
            more = np.flatnonzero(cloud.intensity < np.median(cloud.intensity))
            index = np.r_[np.arange(len(cloud)), np.resize(more, POINTS - len(cloud))]
            arrays |= {f"xyz{k}": cloud.xyz[index], f"intensity{k}": cloud.intensity[index]}
            arrays[f"ring{k}"] = cloud.ring[index]
        paths.append(folder / f"{name}.npz")
        np.savez(paths[-1], count=SWEEPS, **arrays)
    return paths


def seen_by(model: Model, cloud: PointCloud) -> Packets:
    """Packets (N, size) of a turn in which a LiDAR of Hesai sees a cloud, and a wall elsewhere."""
    layout = model.layout
    assert isinstance(layout, Blocks)
    count = OF_UDP // HERTZ // layout.slots
    rows = count * layout.count
    x, y, z = cloud.xyz.T
    away = np.linalg.norm(cloud.xyz, axis=1)
    channel = np.abs(np.arcsin(z / away)[:, None] - model.angles.elevation).argmin(axis=1)
    turned = np.arctan2(x, y) - model.angles.azimuth[channel]
    row = np.round(turned / (2 * np.pi) * rows).astype(int) % rows
    # In a byte, as LiDARs of Hesai send it.
    scaled = cloud.intensity * (255 / max(cloud.intensity.max(), 255))
    least = float(np.quantile(scaled, 0.25))
    distance, intensity = (np.full((rows, layout.channels), each) for each in (20.0, least))
    distance[row, channel] = away
    intensity[row, channel] = scaled
    shape = count, layout.count, layout.channels
    azimuth = np.arange(rows).reshape(shape[:2]) * 36_000 // rows
    packets = as_array(hesai(model, np.zeros(shape, int), azimuth)).copy()
    raw = np.round(distance / model.distance_m).astype(int).reshape(shape)
    block, slot = np.mgrid[: layout.count, : layout.channels]
    at = layout.start + layout.distance + block * layout.block + slot * layout.channel
    sent = raw & 255, raw >> 8, intensity.reshape(shape)
    for k, values in enumerate(sent):
        packets[:, at + k] = values
    return packets


def send(path: Path, port: int, seconds: float) -> None:
    """Send packets of whole turns (T, N, size) at real time, again and again."""
    turns = np.load(path)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as own:
        # So that the system does not send to a port that nobody has opened yet.
        time.sleep(1.0)
        start, sent = time.monotonic(), 0
        step = 1 / HERTZ / turns.shape[1]
        while time.monotonic() - start < seconds:
            for packet in turns[sent // turns.shape[1] % len(turns)]:
                own.sendto(packet.tobytes(), ("127.0.0.1", port))
                sent += 1
                ahead = start + sent * step - time.monotonic()
                if ahead > 0.001:
                    time.sleep(ahead)
    print(sent)


def publishers(by: str, folder: Path, seconds: float) -> tuple[list[str], list[list[str]]]:
    """Say what a watch is to listen to, and with what commands it is sent."""
    if by == "udp":
        texts, commands = [], []
        for k, clouds in enumerate(streets()):
            path = folder / f"{k}.npy"
            np.save(path, np.stack([seen_by(model_named("OT128"), each) for each in clouds]))
            texts.append(f"hesai:127.0.0.1:{23680 + k}")
            commands.append([__file__, "--send", str(path), str(23680 + k), str(seconds)])
        return texts, commands
    paths = stored(folder)
    kinds = (["--layout", "hesai"], ["--layout", "velodyne", "--best-effort"])
    commands = [
        [
            *("-m", "tests.io.live.publishing", f"/{path.stem}/points", str(seconds)),
            *("--clouds", str(path), "--domain", DOMAIN, "--interface", "lo", *kind),
        ]
        for path, kind in zip(paths, kinds, strict=True)
    ]
    return [f"ros2:/{path.stem}/points" for path in paths], commands


def lost() -> list[int]:
    """Packets that the system dropped before the program took them, of each port (Linux)."""
    lines = Path("/proc/net/udp").read_text().splitlines()[1:]
    found = {int(line.split()[1].split(":")[1], 16): int(line.split()[-1]) for line in lines}
    return [found.get(23680 + k, 0) for k in range(2)]


def watched(by: str, minutes: float) -> None:
    """Watch two LiDARs, and print each minute how it keeps up."""
    with tempfile.TemporaryDirectory() as folder:
        texts, commands = publishers(by, Path(folder), 60 * minutes + 5)
        running = [
            subprocess.Popen([sys.executable, *each], stdout=subprocess.PIPE) for each in commands
        ]
        try:
            wish = Wish(RunConfig(need_m=0.001, at_m=30.0))
            network = {} if by == "udp" else {"domain": int(DOMAIN), "interface": "lo"}
            watch = Watch(open_sources(texts, **network), wish, Path(folder))
            print("| minute | said | sweeps/s came | searched | age, s: median | most | MB |")
            print("| --- | --- | --- | --- | --- | --- | --- |")
            skipped = ""
            for minute in range(round(minutes)):
                start = time.monotonic()
                ages, came, seen = [], [], 0
                last: list[float | None] = [None, None]
                while time.monotonic() - start < 60:
                    said = watch.step()
                    for k, lidar in enumerate(said.lidars):
                        if lidar.age_s is not None and (last[k] is None or lidar.age_s < last[k]):
                            seen += 1
                        last[k] = lidar.age_s
                        ages.append(lidar.age_s or 0.0)
                        came.append(lidar.sweeps_per_s)
                        skipped = lidar.skipped or skipped
                print(
                    f"| {minute + 1} | {said.code} | {np.median(came):.1f} | {seen / 120:.1f} "
                    f"| {np.median(ages):.2f} | {max(ages):.2f} | {memory():.0f} |",
                    flush=True,
                )
            print(f"\nIt says: {skipped or 'nothing'}.")
            if by == "udp" and minutes:
                # They send for some seconds more than were watched.
                sent = [int(each.communicate()[0]) for each in running]
                share = 100 * sum(lost()) / sum(sent)
                print(f"Of {sum(sent):,} packets sent, {share:.2f} % were lost.")
            watch.finish()
        finally:
            for each in running:
                each.kill()


def turn_of(model: Model) -> tuple[list[bytes], Angles | None]:
    """Write the packets of a tenth of a second, and the angles that they do not tell."""
    rng, layout, rate = np.random.default_rng(0), model.layout, RATES[model.name]
    count = round(rate / HERTZ / layout.slots)
    if isinstance(layout, Blocks):
        raw = rng.integers(500, 20_000, (count, layout.count, layout.channels))
        rows = count * layout.count
        azimuth = (np.arange(rows) * 36_000 // rows).reshape(count, -1)
        return hesai(model, raw, azimuth << 8 if isinstance(layout, Mirrors) else azimuth), None
    if isinstance(layout, Interpolated):
        manual = MANUALS[model.name]
        rows = manual.rows or manual.blocks
        size = manual.per_block * manual.blocks // rows
        packets = []
        for k in range(count):
            drawn = rng.uniform(5, 100, (rows, size)).tolist(), rng.integers(0, 256, (rows, size))
            turned = [(k * rows + row) * 360 / (count * rows) for row in range(rows)]
            each = zip(turned, drawn[0], drawn[1].tolist(), strict=True)
            packets.append(manual.packet(list(each), k * 50, k * 50 + 500))
        channels = len(layout.firing_us) * layout.together
        return packets, Angles(np.radians(np.linspace(-25, 15, channels)), np.zeros(channels))
    own = np.zeros((count, model.sizes[0]), np.uint8)
    for at, mark, *_ in model.marks:
        own[:, int(at) : int(at) + len(str(mark)) // 2] = list(bytes.fromhex(str(mark)))
    heads, point = list(layout.block), np.dtype(list(layout.point))
    blocks = np.zeros((count, layout.count), [*heads, ("points", point, (layout.points,))])
    for name in point.names or ():
        ranges = {"pitch": (31_500, 34_000), "yaw": (26_800, 38_700), "tag": (0, 1)}
        least, most = ranges.get(name, (0, 256) if point[name].itemsize == 1 else (500, 20_000))
        blocks["points"][name] = rng.integers(least, most, blocks["points"].shape)
    body = blocks.view(np.uint8).reshape(count, -1)
    own[:, layout.start : layout.start + body.shape[1]] = body
    if layout.counter is not None:
        own[:, layout.counter : layout.counter + 2] = np.stack(np.divmod(np.arange(count), 256), 1)
    return [each.tobytes() for each in own], None


def turns_of(model: Model, turn: list[bytes], packets: int) -> Iterator[Packets]:
    """Repeat a turn, with the times that sweeps are cut by, up to so many packets."""
    own, layout = as_array(turn).copy(), model.layout
    for k in range(-(-packets // len(own))):
        if isinstance(layout, Points) and layout.counter is None:
            late = np.arange(len(own)) * (1e9 / HERTZ / len(own))
            stamp = (START * 10**9 + k * (10**9 // HERTZ) + late).astype("<u8")
            own[:, layout.stamp : layout.stamp + 8] = stamp.view(np.uint8).reshape(-1, 8)
        yield own[: packets - k * len(own)]


def write_capture(path: Path, turns: Iterator[Packets]) -> None:
    """Write packets as a pcap, a tenth of a second for each turn."""
    with path.open("wb") as file:
        file.write(struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1))
        for k, turn in enumerate(turns):
            (start,) = {datagram(bytes(turn.shape[1]))[: -turn.shape[1]]}
            size = len(start) + turn.shape[1]
            late = (k * 1000 // HERTZ + np.arange(len(turn)) * 1000 // HERTZ // len(turn)) * 1000
            heads = np.full((len(turn), 4), size, "<u4")
            heads[:, 0], heads[:, 1] = START + late // 10**6, late % 10**6
            fixed = np.broadcast_to(np.frombuffer(start, np.uint8), (len(turn), len(start)))
            file.write(np.hstack([heads.view(np.uint8), fixed, turn]).tobytes())


def decoded(name: str, packets: int) -> None:
    """Print how many times as fast as sent packets of a model are decoded, and read from a file."""
    model = model_named(name)
    turn, angles = turn_of(model)
    real = packets * model.layout.slots / RATES[name]
    taken = 0.0
    for part in batched((each.copy() for each in turns_of(model, turn, packets)), 3):
        own = np.concatenate(part)

        def read(rows: IntArray, own: Packets = own) -> Iterator[Packets]:
            return (own[rows[k : k + 256]] for k in range(0, len(rows), 256))

        begun = time.process_time()
        index = index_of(model, positions_of(model, [own]), angles)
        for _, sweep in sweeps_of(model, angles, index, range(len(index.rows)), read):
            sweep.columns()
        taken += time.process_time() - begun
    with tempfile.TemporaryDirectory() as folder:
        path, table = Path(folder) / "packets.pcap", None
        write_capture(path, turns_of(model, turn, packets))
        if angles is not None:
            table = Path(folder) / "angles.csv"
            lines = (f"{k + 1},{up},0\n" for k, up in enumerate(np.degrees(angles.elevation)))
            table.write_text("".join(lines))
        size = path.stat().st_size / 2**20
        begun, before = time.process_time(), memory()
        recording = open_packets(path, wanted=Wanted(angles=None if table is None else str(table)))
        points = sum(len(each.cloud) for each in recording.read(range(recording.count)))
        read = time.process_time() - begun
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        f"| {name} | {packets:,} | {points / 1e6:.0f} | {real:.0f} | {real / taken:.0f} "
        f"| {size:.0f} | {real / read:.1f} | {most - before:.0f} |",
        flush=True,
    )


def batched(some: Iterator[Packets], size: int) -> Iterator[list[Packets]]:
    """Take so many at a time."""
    while part := list(islice(some, size)):
        yield part


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--by", choices=("dds", "udp"), default="dds")
    parser.add_argument("--decode", type=int, metavar="PACKETS")
    parser.add_argument("--models", nargs="+", default=list(RATES))
    parser.add_argument("--send", nargs=3, metavar=("FILE", "PORT", "SECONDS"))
    options = parser.parse_args()
    if options.send:
        path, port, seconds = options.send
        send(Path(path), int(port), float(seconds))
    elif options.decode is None:
        watched(options.by, options.minutes)
    elif len(options.models) == 1:
        decoded(options.models[0], options.decode)
    else:
        titles = "model", "packets", "points, million", "s", "decoded", "MB", "read", "memory, MB"
        print(f"| {' | '.join(titles)} |\n{'| --- ' * len(titles)}|", flush=True)
        for name in options.models:
            # Each in a process of its own, whose memory is its own.
            words = [__file__, "--decode", str(options.decode), "--models", name]
            subprocess.run([sys.executable, *words], check=True)


if __name__ == "__main__":
    main()
