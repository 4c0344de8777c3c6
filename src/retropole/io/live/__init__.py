"""LiDARs that record now: topics, packets, folders and bags that grow, recordings played again.

A maker's driver is one class with what `Source` names, and one line in `source_of`.
"""

from __future__ import annotations

from typing import Protocol

from ..recordings import Frame


class Source(Protocol):
    """One LiDAR that records now.

    Attributes
    ----------
    name
        As it was asked for: ``ros2:/front/points``.
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
            Where what came is no sweep; the next call goes on.
        """
        ...

    def close(self) -> None:
        """Let go of ports, files and threads; again does nothing."""
        ...
