"""LiDARs that record now: topics, packets, folders and bags that grow, recordings played again.

A maker's driver is one class with what `Source` names, and one line in `source_of`.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Protocol

from ...base.errors import RetropoleError, UsageError
from ..fields import USUAL, Wanted
from ..recordings import Frame

SOURCE_KINDS = {
    "ros2:/TOPIC": "a topic of ROS 2, by DDS; no ROS is needed",
    "velodyne:PORT": "packets of a Velodyne; velodyne:ADDRESS:PORT listens on one address",
    "hesai:PORT": "packets of a Hesai",
    "robosense:PORT": "packets of a RoboSense, and at 7788 its angles (DIFOP)",
    "robosense:PORT,DIFOP": "the same, its angles at another port",
    "leishen:PORT": "packets of a Leishen",
    "livox:PORT": "packets of a Livox",
    "ouster:PORT:FILE": "packets of an Ouster, and its metadata (.json)",
    "folder:PATH": "a folder to which a file is added for each sweep",
    "bag:PATH": "a bag that is being recorded (.mcap, .db3, or its folder); bag:PATH:/TOPIC",
    "replay:PATH": "a recording, played at its original speed; replay:PATH:/TOPIC",
}
"""What a source may be, as it is requested."""


MAKERS = ("velodyne", "hesai", "robosense", "leishen", "livox")
"""Kinds of sources that need nothing but a port."""


class Source(Protocol):
    """One LiDAR that records now.

    Attributes
    ----------
    name
        As it was requested: ``ros2:/front/points``.
    waits_for
        In words why nothing comes: ``nobody publishes /front/points; there are: /rear/points``.
        Empty while sweeps come.
    has_ended
        Whether nothing will come any more: a recording that was played to its end.
    """

    @property
    def name(self) -> str: ...  # noqa: D102

    @property
    def waits_for(self) -> str: ...  # noqa: D102

    @property
    def has_ended(self) -> bool: ...  # noqa: D102

    def newest(self, wait: float) -> Frame | None:
        """Give the newest sweep since the last call, and leave out those before it.

        Its number counts the sweeps that came, also those left out.

        Parameters
        ----------
        wait
            Most seconds to wait for one; None is given where none came.

        Raises
        ------
        ReadError
            If what came is not a sweep; the next call goes on.
        """
        ...

    def close(self) -> None:
        """Close ports, files and threads; a second call does nothing."""
        ...


def source_of(
    text: str,
    *,
    domain: int | None = None,
    interface: str | None = None,
    senders: Collection[str] = (),
    wanted: Wanted = USUAL,
) -> Source:
    """Open a source by what it is called.

    Parameters
    ----------
    text
        One of `SOURCE_KINDS`.
    domain, interface
        Of ROS 2, as `dds.DdsSource` takes them.
    senders
        Of packets, as `udp.PacketSource` takes them.
    wanted
        Of packets by the tables, the angles of the unit; of clouds, the field of the intensity.

    Raises
    ------
    UsageError
        If there is no such kind, a part is missing, or what is wanted is of no use.
    ReadError, MissingExtraError
        If it cannot be opened.
    """
    kind, _, where = text.partition(":")
    if kind not in {each.partition(":")[0] for each in SOURCE_KINDS} or not where:
        raise UsageError(f"{text!r} is not a source, expected one of {', '.join(SOURCE_KINDS)}")
    if kind not in (*MAKERS[1:], "replay"):
        wanted.refuse_angles(f"{text}: angles can be given for packets of {', '.join(MAKERS[1:])}")
    if kind in (*MAKERS, "ouster") and wanted.intensity and "intensity" not in wanted.if_any:
        raise UsageError(f"{text}: packets have one intensity, a field cannot be chosen")
    # Each loads what it needs alone.
    if kind == "ros2":
        from .dds import DdsSource

        return DdsSource(where, domain=domain, interface=interface, wanted=wanted)
    if kind in MAKERS:
        from .udp import ALL_INTERFACES, TableSource, VelodyneSource

        host, _, ports = where.rpartition(":")
        port, has_more, more = ports.partition(",")
        listens = _port(text, port), host or ALL_INTERFACES, senders
        if kind != "velodyne":
            own = None if wanted.angles is None else Path(wanted.angles)
            reported = _port(text, more) if has_more else None
            return TableSource(kind, *listens, reported, angles=own)
        if has_more:
            raise UsageError(f"{text!r}: a Velodyne sends to one port")
        return VelodyneSource(*listens)
    if kind == "ouster":
        from .udp import OusterSource

        port, _, metadata = where.partition(":")
        if not metadata:
            raise UsageError(f"{text!r}: name the metadata too, ouster:PORT:FILE.json")
        return OusterSource(_port(text, port), Path(metadata), senders=senders)
    if kind == "folder":
        from .files import FolderSource

        return FolderSource(Path(where), wanted)
    path, found, topic = where.rpartition(":/")
    # A drive of Windows has one letter before the same signs.
    named = bool(found) and len(path) > 1
    file, name = Path(path if named else where), f"/{topic}" if named else None
    if kind == "bag":
        from .files import BagSource

        return BagSource(file, name, wanted)
    from .replay import ReplaySource

    return ReplaySource(file, name, wanted=wanted)


def open_sources(
    texts: Sequence[str],
    *,
    domain: int | None = None,
    interface: str | None = None,
    senders: Collection[str] = (),
    wanted: Sequence[Wanted] = (USUAL, USUAL),
) -> list[Source]:
    """Open a source for each LiDAR, as `source_of` takes them; all or none.

    What is wanted is for each of its own.

    Raises
    ------
    UsageError, ReadError, MissingExtraError
        As `source_of`; where two are the same; and where senders are named, and none sends
        packets.
    """
    makers = tuple(f"{maker}:" for maker in (*MAKERS, "ouster"))
    if senders and not any(text.startswith(makers) for text in texts):
        raise UsageError(
            "--from gives the sender of packets: use it with velodyne:PORT or ouster:PORT:FILE"
        )
    for text in set(texts):
        if texts.count(text) > 1:
            raise UsageError(f"both LiDARs are {text}: name two sources")
    opened: list[Source] = []
    try:
        for text, own in zip(texts, wanted, strict=True):
            opened.append(
                source_of(text, domain=domain, interface=interface, senders=senders, wanted=own)
            )
    except RetropoleError:
        for source in opened:
            source.close()
        raise
    return opened


def names_of(texts: Sequence[str], otherwise: Sequence[str]) -> tuple[str, ...]:
    """Name LiDARs in words by topic or path: ``front``, ``rear`` of ``ros2:/front/points``, ….

    Parameters
    ----------
    texts
        What `source_of` takes.
    otherwise
        Their names where that does not distinguish them.
    """
    paths = [Path(text.rpartition(":")[2]) for text in texts]
    # The folder where we are has no name.
    parts = [(path.with_suffix("") if path.name else path).parts for path in paths]
    for own in zip(*parts, strict=False):
        if len(set(own)) == len(texts) and not any(each.replace(",", "").isdigit() for each in own):
            return own
    return tuple(otherwise)


def _port(text: str, port: str) -> int:
    # Python reads no more than some thousand digits.
    if not (port.isascii() and port.isdigit() and len(port) < 20):
        raise UsageError(f"{text!r}: {port!r} is not a port, a number from 1 to 65535")
    return int(port)
