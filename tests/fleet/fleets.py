"""A small fleet on disk: one pair with an answer, and others that end in each other way."""

from __future__ import annotations

import random
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TypeVar

import numpy as np

from retropole.fleet.batch import Doing
from retropole.fleet.process import done
from retropole.fleet.sites import FleetSite
from retropole.fleet.work import Outcome, Task
from retropole.io import write_pcd
from retropole.simulation import simulate_pair
from tests.api.site_files import recorded, write_site

Of = TypeVar("Of")

ENDS = {
    "ok": ("good",),
    "refused": ("small/1", "small/2", "small/3", "yard"),
    "error": ("absent", "damaged", "slip"),
}


def write_fleet(folder: Path) -> Path:
    """Write recordings, a site file, and a list of them all."""
    pair = simulate_pair(
        "street", np.random.default_rng(1), sensor_target="VLP-16", sensor_source="VLP-16"
    )
    (folder / "good").mkdir(parents=True)
    write_pcd(folder / "good/target.pcd", pair.target)
    write_pcd(folder / "good/source.pcd", pair.source)
    for k in (1, 2, 3):
        (folder / f"small/{k}").mkdir(parents=True)
        write_pcd(folder / f"small/{k}/target.pcd", recorded(2 * k))
        write_pcd(folder / f"small/{k}/source.pcd", recorded(2 * k + 1))
    (folder / "damaged.pcd").write_bytes(b"VERSION .7\nPOINTS 3\n")
    (folder / "yard").mkdir()
    write_site(folder / "yard")
    small = "small/1/target.pcd"
    lines = [
        "id,target,source,site,radius_m,sensor_target,latitude_deg,longitude_deg",
        "good,good/target.pcd,good/source.pcd,,0.02,VLP-16,52.5,13.4",
        *(f"small/{k},small/{k}/target.pcd,small/{k}/source.pcd,,,,," for k in (1, 2, 3)),
        "yard,,,yard/site.toml,,,,",
        f"absent,{small},nothing.pcd,,,,,",
        f"damaged,damaged.pcd,{small},,,,,",
        f"slip,{small},{small},,two,,,",
    ]
    path = folder / "sites.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def here(tasks: Iterator[Task]) -> Iterator[Outcome]:
    """Do tasks in this process."""
    return map(done, tasks)


def in_disorder(seed: int) -> Doing:
    """Do tasks in this process, in another order."""

    def doing(tasks: Iterator[Task]) -> Iterator[Outcome]:
        return map(done, shuffled(tasks, seed))

    return doing


def shuffled(given: Iterable[Of], seed: int) -> list[Of]:
    """Put things in another order."""
    return random.Random(seed).sample(them := list(given), len(them))


def bytes_of(out: Path) -> dict[str, bytes]:
    """Read all partitions of the answers."""
    return {path.name: path.read_bytes() for path in sorted((out / "answers").iterdir())}


def ids_of(sites: Iterable[FleetSite]) -> list[str]:
    """Name sites."""
    return [site.id for site in sites]
