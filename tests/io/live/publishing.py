"""Publish clouds as drivers of ROS 2 do, from a process of its own.

    python publishing.py TOPIC SECONDS [--layout hesai] [--best-effort] [--garbage] …

The messages are made by rosbags, so that their bytes are not those of the package.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

XYZ = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7)]
OF_OUSTER = [("t", 20, 6), ("reflectivity", 24, 4), ("ring", 26, 4), ("ambient", 28, 4)]
LAYOUTS = {
    "velodyne": (22, [*XYZ, ("intensity", 12, 7), ("ring", 16, 4), ("time", 18, 7)]),
    "ouster": (48, [*XYZ, ("intensity", 16, 7), *OF_OUSTER, ("range", 32, 6)]),
    "hesai": (26, [*XYZ, ("intensity", 12, 7), ("ring", 16, 4), ("timestamp", 18, 8)]),
}
"""Bytes of a point, and of each field name, offset and type, as the makers' drivers have them."""

KINDS = {2: "u1", 4: "u2", 6: "u4", 7: "f4", 8: "f8"}
CLOUD = "sensor_msgs/msg/PointCloud2"


def packed(layout: str, columns: dict[str, NDArray[Any]]) -> tuple[int, list[Any], NDArray[Any]]:
    """Lay points out as a driver does; what it has no column for stays 0."""
    step, fields = LAYOUTS[layout]
    record = np.dtype(
        {
            "names": [name for name, *_ in fields],
            "formats": [f"<{KINDS[kind]}" for *_, kind in fields],
            "offsets": [offset for _, offset, _ in fields],
            "itemsize": step,
        }
    )
    points = np.zeros(len(columns["x"]), record)
    for name in record.names or ():
        if name in columns:
            points[name] = columns[name]
    return step, fields, points.view(np.uint8).reshape(-1)


def message(
    layout: str,
    columns: dict[str, NDArray[Any]],
    frame: str,
    when: float,
    *,
    garbage: bool = False,
) -> bytes:
    """Make the bytes of a message; of one that is garbage the numbers contradict each other."""
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    step, fields, data = packed(layout, columns)
    stamp = store.types["builtin_interfaces/msg/Time"](int(when), int(when % 1 * 1e9))
    made = store.types[CLOUD](
        header=store.types["std_msgs/msg/Header"](stamp, frame),
        height=1,
        width=10**9 if garbage else len(data) // step,
        fields=[
            store.types["sensor_msgs/msg/PointField"](name, offset, kind, 1)
            for name, offset, kind in fields
        ],
        is_bigendian=False,
        point_step=step,
        row_step=len(data),
        data=data,
        is_dense=True,
    )
    return bytes(store.serialize_cdr(made, CLOUD))


class Publisher:
    """Publishes bytes on a topic."""

    def __init__(self, topic: str, domain: int, *, reliable: bool, interface: str | None) -> None:
        from cyclonedds.core import Policy, Qos
        from cyclonedds.pub import DataWriter
        from cyclonedds.topic import Topic

        from retropole.io.live.dds import message_type, participant

        own = participant(domain, interface)
        kinds = Policy.Reliability.BestEffort, Policy.Reliability.Reliable(10**9)
        qos = Qos(kinds[reliable], Policy.History.KeepLast(5))
        self.writer = DataWriter(own, Topic(own, f"rt{topic}", message_type(CLOUD)), qos=qos)

    def publish(self, data: bytes) -> None:
        from retropole.io.live.dds import message_of

        self.writer.write(message_of(CLOUD, data))


def noise(points: int, seed: int) -> dict[str, NDArray[Any]]:
    """Points of no place in particular."""
    rng = np.random.default_rng(seed)
    xyz = rng.uniform(-20, 20, (3, points))
    ring = np.arange(points) % 32
    return {
        **dict(zip("xyz", xyz, strict=True)),
        "intensity": rng.uniform(0, 100, points),
        "ring": ring,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("topic")
    parser.add_argument("seconds", type=float)
    parser.add_argument("--clouds", help="an .npz with xyz, intensity, ring of each sweep")
    parser.add_argument("--layout", choices=LAYOUTS, default="velodyne")
    parser.add_argument("--points", type=int, default=100_000)
    parser.add_argument("--frame", default="lidar")
    parser.add_argument("--domain", type=int, default=42)
    parser.add_argument("--interface")
    parser.add_argument("--best-effort", action="store_true")
    parser.add_argument("--garbage", action="store_true", help="every second message")
    parser.add_argument("--behind", type=float, default=0.0, help="seconds that its clock is")
    options = parser.parse_args()
    if options.clouds:
        stored = np.load(options.clouds)
        sweeps = [
            {
                **dict(zip("xyz", stored[f"xyz{k}"].T, strict=True)),
                "intensity": stored[f"intensity{k}"],
                "ring": stored[f"ring{k}"],
            }
            for k in range(int(stored["count"]))
        ]
    else:
        sweeps = [noise(options.points, k) for k in range(3)]
    publisher = Publisher(
        options.topic,
        options.domain,
        reliable=not options.best_effort,
        interface=options.interface,
    )
    start, k = time.time(), 0
    while time.time() - start < options.seconds:
        when = time.time() - options.behind
        sweep, garbage = sweeps[k % len(sweeps)], options.garbage and k % 2 == 1
        data = message(options.layout, sweep, options.frame, when, garbage=garbage)
        publisher.publish(data)
        k += 1
        time.sleep(max(0.0, start + k * 0.1 - time.time()))


if __name__ == "__main__":
    main()
