"""Put taped poles into two real recordings, along the recordings' own beams.

Writes lidar0.pcd (the target), lidar1.pcd (the source) and truth.json to a folder, as
`retropole simulate` does for a scene. docs/evidence/real.md says what is done.

example:
  python benchmarks/insert.py front.pcd rear.pcd --transform retropole-out --out s
  retropole calibrate s/lidar0.pcd s/lidar1.pcd
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from insertion import InsertedPair, insert_poles, write_inserted
from retropole.api.inputs import CloudSource, read_pair
from retropole.api.options import checked_options
from retropole.base.datatypes import DEFAULT_RADIUS, MAX_POLES, Array
from retropole.base.errors import RetropoleError, UsageError, printable
from retropole.export import read_transform
from retropole.result import RunConfig


def insert(
    target: CloudSource,
    source: CloudSource,
    transform: str | Path | Array,
    seed: int = 0,
    *,
    sensors: tuple[str, str] = ("auto", "auto"),
    poles: int = 2,
    radius: float = DEFAULT_RADIUS,
) -> InsertedPair:
    """Put taped poles into two real recordings.

    Parameters
    ----------
    target, source
        Files, clouds or arrays, each in its sensor's frame. The z axis of the target points up.
    transform
        ``T_target_source``, (4, 4), or a file that `read_transform` reads.
    seed
        Of everything random; equal seeds give equal pairs.
    sensors
        Names of the sensors of the target and the source; ``auto`` where they are not known.
    poles
        How many taped poles.
    radius
        Of the poles, metres.

    Returns
    -------
    InsertedPair
        Its `target` and `source` are clouds, its `T_target_source` is the given transform.

    Raises
    ------
    ReadError, UsageError
        For a file that cannot be read, an unknown sensor, and poles that nobody has.
    SimulationError
        Where no poles are found that both LiDARs see on the ground of the recordings.
    """
    if not 1 <= poles <= MAX_POLES:
        raise UsageError(f"poles is {poles}, expected a number from 1 to {MAX_POLES}")
    config = RunConfig(radius_m=radius, sensor_target=sensors[0], sensor_source=sensors[1])
    given = read_pair(target, source, checked_options(config))
    if isinstance(transform, str | Path):
        transform = read_transform(Path(transform)).T_parent_child
    return insert_poles(
        given[0].cloud,
        given[1].cloud,
        np.asarray(transform, dtype=float),
        np.random.default_rng(seed),
        sensors=(given[0].sensor, given[1].sensor),
        poles=poles,
        radius=radius,
    )


def main(words: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("target", type=Path, help="recording of the target LiDAR")
    parser.add_argument("source", type=Path, help="recording of the source LiDAR")
    parser.add_argument(
        "--transform",
        type=Path,
        required=True,
        help="T_target_source, as a result or in any format that retropole export writes",
    )
    parser.add_argument("--out", type=Path, default=Path("retropole-simulated"), help="folder")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--sensor-target", default="auto", help="sensor's name, or auto")
    parser.add_argument("--sensor-source", default="auto", help="the same for the source")
    parser.add_argument("--poles", type=int, default=2, help=f"1 to {MAX_POLES}, 2 if not said")
    parser.add_argument(
        "--radius", type=float, default=DEFAULT_RADIUS, help="of the poles, m, tape included"
    )
    given = parser.parse_args(words)
    try:
        pair = insert(
            given.target,
            given.source,
            given.transform,
            given.seed,
            sensors=(given.sensor_target, given.sensor_source),
            poles=given.poles,
            radius=given.radius,
        )
        write_inserted(pair, given.out)
    except (RetropoleError, OSError) as error:
        parser.exit(2, f"{parser.prog}: error: {printable(str(error))}\n")
    names = ("lidar0.pcd", "lidar1.pcd", "truth.json")
    print("written:", ", ".join(printable(str(given.out / name)) for name in names))


if __name__ == "__main__":
    main()
