"""Transforms on ``/tf_static`` of ROS 2, by DDS; no ROS is needed (the extra ``live``)."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from ..io.live.dds import domain_or_default, message_of, message_type, participant
from .recording import TRANSFORM_TOPIC, TRANSFORMS, transform_message
from .transform import Transform


@dataclass(eq=False)
class Published:
    """What is published, for as long as this is kept: those who come late are told all the same."""

    writer: Any

    def withdraw(self) -> None:
        """Publish it no longer: who comes from now on does not get it.

        Who listens already keeps it until it starts again: tf2 forgets no static transform.
        """
        self.writer = None


def check_publishing(*, domain: int | None = None, interface: str | None = None) -> None:
    """Join the domain, so that `publish` finds nothing missing when there is an answer.

    Raises
    ------
    MissingExtraError, UsageError
        As `publish`.
    """
    participant(domain_or_default(domain), interface)


def publish(
    transforms: Sequence[Transform], *, domain: int | None = None, interface: str | None = None
) -> Published:
    """Publish transforms on ``/tf_static``, reliably and for those who come late.

    Parameters
    ----------
    transforms
        All that this program publishes there.
    domain, interface
        As `io.live.dds.DdsSource` takes them.

    Raises
    ------
    MissingExtraError
        Where cyclonedds is not installed.
    UsageError
        Where DDS cannot be used.
    """
    own = participant(domain_or_default(domain), interface)
    from cyclonedds.core import Policy, Qos
    from cyclonedds.pub import DataWriter
    from cyclonedds.topic import Topic
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    message = transform_message(transforms, time.time_ns(), store)
    qos = Qos(
        Policy.Reliability.Reliable(10**9),
        Policy.Durability.TransientLocal,
        Policy.History.KeepLast(1),
    )
    writer = DataWriter(own, Topic(own, f"rt{TRANSFORM_TOPIC}", message_type(TRANSFORMS)), qos=qos)
    writer.write(message_of(TRANSFORMS, bytes(store.serialize_cdr(message, TRANSFORMS))))
    return Published(writer)
