"""Names of all methods that `comparison.compare` runs, without loading any."""

from __future__ import annotations

from .rivals import RIVALS

OURS = {"poles": "retropole, the poles alone", "poles+scene": "retropole, poles and scene"}
"""Our own, and what each is."""

ALL_METHODS: tuple[str, ...] = (*OURS, *RIVALS)
"""Our own, then the rivals."""
