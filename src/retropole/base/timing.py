"""How long each step of a run took."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

Step = Callable[[str], AbstractContextManager[None]]
"""Names a step that starts, and times it until it ends."""


@contextmanager
def timed(seconds: dict[str, float], progress: Callable[[str], None], name: str) -> Iterator[None]:
    """Name a step that starts, and note how long it took, also if it ends in a refusal."""
    progress(name)
    start = time.perf_counter()
    try:
        yield
    finally:
        seconds[name] = seconds.get(name, 0.0) + time.perf_counter() - start
