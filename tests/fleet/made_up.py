"""Datasets of fleets that were never calibrated: rows as a city of many sites would have them."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np

from retropole.base.datatypes import Array
from retropole.fleet.dataset import (
    InputEntry,
    LidarEntry,
    Row,
    Run,
    Status,
    Step,
    partition_of,
    write_partition,
)
from retropole.result import BudgetEntry, ErrorAtRange, ReasonDoc, encode
from tests.results import result_of

HOW: tuple[tuple[Status, str, str, float], ...] = (
    ("ok", "", "", 0.85),
    ("warn", "small_margin", "the chosen hypothesis leads by 0.061 only", 0.07),
    ("refused", "ambiguous", "the scene does not tell 2 hypotheses apart", 0.05),
    ("error", "unreadable", "post/target.pcd: truncated", 0.02),
    ("error", "time_limit", "not done within 900 s", 0.01),
)
"""Status, code, message, and how often."""


FIRST = "part-00.parquet"


def names_in_first(count: int) -> list[str]:
    """Give ids of sites that are all of one partition, the first."""
    names = (f"post-{k}" for k in itertools.count())
    return list(itertools.islice((n for n in names if partition_of(n) == FIRST), count))


def made_up_row(name: str, rng: np.random.Generator, *, placed: bool = True) -> Row:
    """Make the row of a site, within 10 km of the middle of a city."""
    k = int(rng.choice(len(HOW), p=[share for *_, share in HOW]))
    status, code, message, _ = HOW[k]
    sigma = float(np.exp(rng.normal(np.log(0.012), 0.5)))
    T = np.eye(4)
    T[:3, 3] = rng.normal(size=3)
    lidar = LidarEntry(
        name="source",
        sensor="VLP-16",
        T=T.ravel().tolist(),
        covariance=np.diag(np.full(6, 1e-6)).ravel().tolist(),
        predicted_error=[ErrorAtRange(10.0, sigma / 2), ErrorAtRange(30.0, sigma)],
        budget=[
            BudgetEntry("range offset", "source", 0.01, "m", None, 0.7),
            BudgetEntry("scatter of the surfaces", None, 0.003, "m", None, 0.3),
        ],
    )
    answered = status in ("ok", "warn")
    east, north = rng.uniform(-1e4, 1e4, 2) / 6.371e6
    return Row(
        id=name,
        kind="pair",
        status=status,
        codes=[code] if code else [],
        messages=[message] if message else [],
        inputs=[InputEntry(lidar="target", placement="1", path=f"{name}/target.pcd")],
        latitude_rad=float(np.radians(52.52) + north) if placed else None,
        longitude_rad=float(np.radians(13.405) + east / 0.608) if placed else None,
        frame="target" if answered else None,
        lidars=[lidar] if answered else [],
        sigma_30m_m=sigma if answered else None,
        document=_document(code, message, T) if answered else None,
        key="0" * 64,
        version="1.2.3",
        libraries="numpy 2, scipy 1",
    )


def _document(code: str, message: str, T: Array) -> str:
    """Write the document of a pair that was answered as it is written today."""
    reasons = [ReasonDoc(code, message, {})] if code else []
    covariance = np.diag(np.full(6, 1e-6))
    return encode(result_of("warn" if code else "ok", reasons, T, covariance)).decode()


def made_up_run(name: str, rng: np.random.Generator) -> Run:
    """Make how a row came about."""
    return Run(
        id=name,
        key="0" * 64,
        started=f"2026-03-0{rng.integers(1, 9)}T12:00:00.000+00:00",
        seconds=float(rng.uniform(1, 9)),
        steps=[Step("read", 0.1)],
        host="worker-1",
        memory_bytes=100_000_000,
    )


def write_made_up(out: Path, rows: list[Row], seed: int = 0) -> Path:
    """Write rows as a dataset."""
    rng = np.random.default_rng(seed)
    parts: dict[str, list[Row]] = {}
    for row in rows:
        parts.setdefault(partition_of(row.id), []).append(row)
    for part, of_part in parts.items():
        write_partition(str(out), part, of_part, [made_up_run(row.id, rng) for row in of_part])
    return out


def write_city(out: Path, count: int, seed: int = 0) -> Path:
    """Write the dataset of a city of so many sites, about forty in each partition."""
    rng = np.random.default_rng(seed)
    most = f"part-{min(255, count // 40):02x}.parquet"
    names = (f"post-{k:05d}" for k in itertools.count())
    ids = itertools.islice((name for name in names if partition_of(name) <= most), count)
    return write_made_up(
        out, [made_up_row(name, rng, placed=k % 50 > 0) for k, name in enumerate(ids)], seed
    )
