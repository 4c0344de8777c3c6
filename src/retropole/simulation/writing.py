"""Simulated pairs as files that the command line reads."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ..base.files import write_together
from ..io.pcd import pcd_of
from .raycast import Cylinder
from .recording import SimulatedPair


def write_pair(pair: SimulatedPair, out: Path) -> None:
    """Write ``lidar0.pcd`` (target), ``lidar1.pcd`` (source) and ``truth.json`` to a folder.

    The three are never of two runs.
    """
    truth = {
        "T_target_source": pair.T_target_source.tolist(),
        "T_world_target": pair.T_world_target.tolist(),
        "T_world_source": pair.T_world_source.tolist(),
        "target": "lidar0.pcd",
        "source": "lidar1.pcd",
        "sensors": [sensor.name for sensor in pair.sensors],
        "noise": asdict(pair.noise),
        "devices": {
            role: device.as_dict()
            for role, device in zip(("target", "source"), pair.devices, strict=True)
        },
        "poles": truth_of_poles(pair.poles, pair.returns_on_poles),
    }
    write_together(
        {
            out / "truth.json": json.dumps(truth, indent=1).encode() + b"\n",
            out / "lidar0.pcd": pcd_of(pair.target),
            out / "lidar1.pcd": pcd_of(pair.source),
        }
    )


def truth_of_pole(pole: Cylinder) -> dict[str, Any]:
    """Give where a pole stands, and its size, as ``truth.json`` has them."""
    return {
        "point_world_m": pole.centre.tolist(),
        "direction_world": pole.axis.tolist(),
        "radius_m": pole.radius,
        "length_m": pole.length,
    }


def truth_of_poles(
    poles: Iterable[Cylinder], returns: Iterable[tuple[int, int]]
) -> list[dict[str, Any]]:
    """Give poles as ``truth.json`` has them.

    Parameters
    ----------
    poles
        In the world's frame.
    returns
        Of each, how many points the target and the source have on it.
    """
    return [
        {**truth_of_pole(pole), "returns_target": target, "returns_source": source}
        for pole, (target, source) in zip(poles, returns, strict=True)
    ]
