"""``retropole merge --live``: the loop until Ctrl-C, and what it prints."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from .common import say, show_written
from .watch import until_signal

if TYPE_CHECKING:
    from ..api.live_merging import LiveWish

PACE_SECONDS = 10.0
"""How often a line reports the rate of clouds, s."""


def merge_until_stopped(
    result: Path, sources: Mapping[str, str], wish: LiveWish, quiet: bool
) -> int:
    """Merge LiDARs that record now until a signal comes, or all have ended; gives the exit code."""
    from ..api.live_merging import merging_live
    from ..base.errors import printable

    with until_signal() as stopped:
        with merging_live(result, sources, wish) as merge:
            if not quiet:
                where = [f"on {wish.topic}"] * bool(wish.topic) + [f"to {wish.out}"] * bool(
                    wish.out
                )
                say(f"retropole: clouds go {' and '.join(where)}; Ctrl-C ends")
            due = time.monotonic() + PACE_SECONDS
            while not (stopped.is_set() or merge.has_ended):
                merge.step()
                for message in merge.new_messages():
                    say(f"retropole: {printable(message)}")
                if time.monotonic() >= due:
                    due += PACE_SECONDS
                    pace = merge.pace()
                    if not quiet:
                        say(f"retropole: {pace.text}")
        if wish.out is not None and not quiet:
            show_written(wish.out)
        return stopped.code or 0
