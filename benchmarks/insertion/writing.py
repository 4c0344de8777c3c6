"""Pairs of recordings with poles put into them, as files that the command line reads."""

from __future__ import annotations

import json
from pathlib import Path

from retropole.base.files import write_together
from retropole.io.pcd import pcd_of
from retropole.simulation.writing import truth_of_poles

from .inserting import InsertedPair


def write_inserted(pair: InsertedPair, out: Path) -> None:
    """Write ``lidar0.pcd`` (target), ``lidar1.pcd`` (source) and ``truth.json`` to a folder.

    The three are never of two runs. The world's frame is the target's.
    """
    truth = {
        "T_target_source": pair.T_target_source.tolist(),
        "T_world_target": pair.T_world_target.tolist(),
        "T_world_source": pair.T_world_source.tolist(),
        "target": "lidar0.pcd",
        "source": "lidar1.pcd",
        "sensors": [sensor.name if sensor else "auto" for sensor in pair.sensors],
        "poles": truth_of_poles(pair.poles, pair.returns_on_poles),
    }
    write_together(
        {
            out / "truth.json": json.dumps(truth, indent=1).encode() + b"\n",
            out / "lidar0.pcd": pcd_of(pair.target),
            out / "lidar1.pcd": pcd_of(pair.source),
        }
    )
