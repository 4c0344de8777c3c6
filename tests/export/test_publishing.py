"""Transforms on /tf_static, read back by another reader."""

from __future__ import annotations

import os
import time
from typing import Any

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.errors import UsageError
from retropole.export import Transform

pytest.importorskip("cyclonedds")

from retropole.export.recording import TRANSFORMS, check_publishing, publish
from retropole.export.transform import to_quaternion
from retropole.io.live.dds import message_type, participant

DOMAIN = 10 + os.getpid() % 200


def late_reader() -> Any:
    """Listen to /tf_static as one who comes late."""
    from cyclonedds.core import Policy, Qos
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic

    own = participant(DOMAIN, "lo")
    qos = Qos(
        Policy.Reliability.Reliable(10**9),
        Policy.Durability.TransientLocal,
        Policy.History.KeepLast(100),
    )
    return DataReader(own, Topic(own, "rt/tf_static", message_type(TRANSFORMS)), qos=qos)


def taken_by(reader: Any, seconds: float) -> list[Any]:
    """Take a message that comes within some seconds."""
    start = time.monotonic()
    while time.monotonic() < start + seconds:
        if taken := [each for each in reader.take(1) if each.sample_info.valid_data]:
            return taken
        time.sleep(0.05)
    return []


def test_one_who_comes_late_reads_the_transform() -> None:
    from rosbags.typesys import Stores, get_typestore

    T = se3.random(np.random.default_rng(0))
    check_publishing(domain=DOMAIN, interface="lo")
    published = publish([Transform(T, "front", "rear")], domain=DOMAIN, interface="lo")
    taken = taken_by(late_reader(), 10.0)
    message: Any = get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr(taken[0].data, TRANSFORMS)
    (stamped,) = message.transforms
    assert (stamped.header.frame_id, stamped.child_frame_id) == ("front", "rear")
    there = stamped.transform
    np.testing.assert_array_equal(
        [there.translation.x, there.translation.y, there.translation.z], T[:3, 3]
    )
    q = there.rotation
    np.testing.assert_array_equal([q.x, q.y, q.z, q.w], to_quaternion(T))
    published.withdraw()
    assert taken_by(late_reader(), 1.0) == []


def test_what_dds_lacks_is_reported_before_anything_is_published() -> None:
    with pytest.raises(UsageError, match="no network interface"):
        check_publishing(domain=DOMAIN, interface="nowhere0")
    with pytest.raises(UsageError, match="domain"):
        check_publishing(domain=999)
