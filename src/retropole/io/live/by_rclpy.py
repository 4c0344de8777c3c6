"""Point clouds that ROS 2 publishes now, by the ROS installation of this computer."""

from __future__ import annotations

import time
from threading import Thread
from typing import Any

from ...base.errors import UsageError
from ..recordings import Frame
from ..ros import frame_of_message
from .mailbox import QUIET, Mailbox


class RclpySource:
    """A topic of point clouds of ROS 2, by rclpy; see `Source`.

    Parameters
    ----------
    topic
        As ROS names it: ``/front/points``.

    Raises
    ------
    UsageError
        Where this Python has no rclpy.
    """

    has_ended = False

    def __init__(self, topic: str) -> None:
        try:
            import rclpy
            from rclpy.executors import SingleThreadedExecutor
            from rclpy.qos import qos_profile_sensor_data
            from sensor_msgs.msg import PointCloud2
        except ImportError:
            raise UsageError(
                "rclpy is not found: source the setup file of ROS, or name the topic as "
                f"ros2:{topic}, which needs no ROS"
            ) from None
        self.name = f"rclpy:{topic}"
        self._context = rclpy.Context()
        self._context.init()
        self._node = rclpy.create_node("retropole_watch", context=self._context)
        # What drivers publish reliably comes to who asks for less, too.
        self._node.create_subscription(PointCloud2, topic, self._put, qos_profile_sensor_data)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._mailbox: Mailbox[Any] = Mailbox()
        self._topic, self._last = topic, -float("inf")
        self._thread = Thread(target=self._executor.spin, name=self.name, daemon=True)
        self._thread.start()

    def _put(self, message: Any) -> None:
        self._mailbox.put(message)

    @property
    def waits_for(self) -> str:
        """See `Source`."""
        if time.monotonic() - self._last < QUIET:
            return ""
        count = self._node.count_publishers(self._topic)
        return f"{self._topic} has {count} publishers, but no message comes"

    def newest(self, wait: float) -> Frame | None:
        """See `Source`."""
        taken = self._mailbox.take(wait)
        if taken is None:
            return None
        self._last = time.monotonic()
        number, message = taken
        return frame_of_message("", self.name, number, time.time_ns(), message)

    def close(self) -> None:
        """See `Source`."""
        self._executor.shutdown()
        self._context.try_shutdown()
        self._thread.join(1.0)
