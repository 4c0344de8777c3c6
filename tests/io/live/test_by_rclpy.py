"""Topics by rclpy. No ROS is on a machine that runs the tests, so that a stand-in has its names."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from retropole.base.errors import UsageError
from retropole.io.live.by_rclpy import RclpySource
from tests.io.live import publishing

pytest.importorskip("rosbags")


class Context:
    def init(self) -> None:
        self.is_up = True

    def try_shutdown(self) -> None:
        self.is_up = False


class Node:
    callback: Callable[[Any], None]

    def create_subscription(
        self, kind: Any, topic: str, callback: Callable[[Any], None], qos: str
    ) -> None:
        self.topic, self.callback, self.qos = topic, callback, qos

    def count_publishers(self, topic: str) -> int:
        return int(topic == self.topic)


class Executor:
    def __init__(self, context: Context) -> None:
        self.is_up = True

    def add_node(self, node: Node) -> None:
        self.node = node

    def spin(self) -> None:
        while self.is_up:
            time.sleep(0.01)

    def shutdown(self) -> None:
        self.is_up = False


@pytest.fixture
def node(monkeypatch: pytest.MonkeyPatch) -> Node:
    made = Node()
    parts: dict[str, dict[str, Any]] = {
        "rclpy": {"Context": Context, "create_node": lambda name, context: made},
        "rclpy.executors": {"SingleThreadedExecutor": Executor},
        "rclpy.qos": {"qos_profile_sensor_data": "sensor data"},
        "sensor_msgs": {},
        "sensor_msgs.msg": {"PointCloud2": object},
    }
    for name, values in parts.items():
        module = ModuleType(name)
        vars(module).update(values)
        monkeypatch.setitem(sys.modules, name, module)
    return made


def test_the_newest_message_is_given(node: Node) -> None:
    source = RclpySource("/front/points")
    assert node.qos == "sensor data"
    assert source.newest(0.0) is None
    assert "1 publishers" in source.waits_for
    for k in range(3):
        columns = publishing.noise(100, k)
        step, fields, data = publishing.packed("hesai", columns)
        node.callback(
            SimpleNamespace(
                header=SimpleNamespace(frame_id="front"),
                height=1,
                width=100,
                fields=[
                    SimpleNamespace(name=n, offset=o, datatype=d, count=1) for n, o, d in fields
                ],
                is_bigendian=False,
                point_step=step,
                row_step=len(data),
                data=data,
            )
        )
    frame = source.newest(0.1)
    assert frame is not None
    assert (frame.number, frame.frame_id) == (2, "front")
    np.testing.assert_allclose(frame.cloud.xyz[:, 0], columns["x"], atol=1e-5)
    assert source.waits_for == ""
    source.close()


def test_without_ros_it_says_what_needs_none() -> None:
    with pytest.raises(UsageError, match="ros2:/front/points"):
        RclpySource("/front/points")
