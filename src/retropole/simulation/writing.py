"""Simulated pairs as files that the command line reads."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

from ..files import write_together
from ..io.pcd import pcd_of
from .insertion import InsertedPair
from .recording import SimulatedPair


def write_pair(pair: SimulatedPair | InsertedPair, out: Path) -> None:
    """Write ``lidar0.pcd`` (target), ``lidar1.pcd`` (source) and ``truth.json`` to a folder.

    The three are never of two runs. Of poles in recordings, the world's frame is the target's.
    """
    truth = {
        "T_target_source": pair.T_target_source.tolist(),
        "T_world_target": pair.T_world_target.tolist(),
        "T_world_source": pair.T_world_source.tolist(),
        "target": "lidar0.pcd",
        "source": "lidar1.pcd",
        "sensors": [sensor.name if sensor else "auto" for sensor in pair.sensors],
        **(
            {
                "noise": asdict(pair.noise),
                "devices": {
                    role: device.as_dict()
                    for role, device in zip(("target", "source"), pair.devices, strict=True)
                },
            }
            if isinstance(pair, SimulatedPair)
            else {}
        ),
        "poles": [
            {
                "point_world_m": pole.centre.tolist(),
                "direction_world": pole.axis.tolist(),
                "radius_m": pole.radius,
                "length_m": pole.length,
                "returns_target": returns[0],
                "returns_source": returns[1],
            }
            for pole, returns in zip(pair.poles, pair.returns_on_poles, strict=True)
        ],
    }
    write_together(
        {
            out / "truth.json": json.dumps(truth, indent=1).encode() + b"\n",
            out / "lidar0.pcd": pcd_of(pair.target),
            out / "lidar1.pcd": pcd_of(pair.source),
        }
    )
