"""Transforms on /tf_static, read back by another reader."""

from __future__ import annotations

import os
import time
from typing import Any

import numpy as np
import pytest

from retropole.base import se3
from retropole.export import Transform

pytest.importorskip("cyclonedds")

from retropole.export.publishing import publish
from retropole.export.recording import TRANSFORMS
from retropole.export.transform import to_quaternion
from retropole.io.live.dds import message_type, participant

DOMAIN = 10 + os.getpid() % 200


def test_one_who_comes_late_reads_the_transform() -> None:
    from cyclonedds.core import Policy, Qos
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic
    from rosbags.typesys import Stores, get_typestore

    T = se3.random(np.random.default_rng(0))
    published = publish([Transform(T, "front", "rear")], domain=DOMAIN, interface="lo")
    own = participant(DOMAIN, "lo")
    qos = Qos(
        Policy.Reliability.Reliable(10**9),
        Policy.Durability.TransientLocal,
        Policy.History.KeepLast(100),
    )
    reader = DataReader(own, Topic(own, "rt/tf_static", message_type(TRANSFORMS)), qos=qos)
    taken = []
    for _ in range(100):
        taken = reader.take(1)
        if taken:
            break
        time.sleep(0.1)
    message: Any = get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr(taken[0].data, TRANSFORMS)
    (stamped,) = message.transforms
    assert (stamped.header.frame_id, stamped.child_frame_id) == ("front", "rear")
    there = stamped.transform
    np.testing.assert_array_equal(
        [there.translation.x, there.translation.y, there.translation.z], T[:3, 3]
    )
    q = there.rotation
    np.testing.assert_array_equal([q.x, q.y, q.z, q.w], to_quaternion(T))
    del published
