"""What poles, pairs of poles, hypotheses and inputs are called, on the page and in a terminal."""

from __future__ import annotations

from pathlib import Path

from ..result import ResultDoc
from ..scene.choice import hypothesis_name

__all__ = ["LIDARS", "hypothesis_name", "input_names", "pair_name", "pole_name"]

LIDARS = ("target", "source")
"""The two LiDARs, in the order of every pair."""


def pole_name(lidar: str, k: int) -> str:
    """Name the k-th pole of a LiDAR: ``T0``, ``S1``."""
    return f"{lidar[0].upper()}{k}"


def pair_name(pair: tuple[int, int]) -> str:
    """Name a pair of a target pole and a source pole: ``T0–S1``."""
    return f"{pole_name('target', pair[0])}–{pole_name('source', pair[1])}"


def input_names(result: ResultDoc) -> list[str]:
    """Name the inputs by their files, and by their topics where they are in bags."""
    topics = (result.config.target_topic, result.config.source_topic)
    return [
        " ".join([Path(item.path).name, topics[k % 2] or ""]).strip()
        for k, item in enumerate(result.inputs)
    ]
