"""What poles, pairs of poles, hypotheses and inputs are called, on the page and in a terminal."""

from __future__ import annotations

from pathlib import Path

from ..result import ResultDoc

LIDARS = ("target", "source")
"""The two LiDARs, in the order of every pair."""


def hypothesis_name(k: int) -> str:
    """Name the k-th hypothesis: a, b, c, … (Xue et al. 2019, Fig. 4)."""
    return chr(ord("a") + k) if k < 26 else f"h{k}"


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
