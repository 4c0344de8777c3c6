"""Simulated sites as files: recordings, the site file and the truth."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ..base.datatypes import Array
from ..base.files import write_together
from ..io.pcd import pcd_of
from .sites import SimulatedSite
from .writing import truth_of_pole


def write_site(site: SimulatedSite, out: Path, more: Mapping[str, Any] | None = None) -> None:
    """Write ``truth.json``, ``site.toml`` and ``LIDAR_PLACEMENT.pcd`` of each recording.

    They are never of two runs.

    Parameters
    ----------
    site
        What was simulated.
    out
        A folder.
    more
        What else ``truth.json`` says.
    """
    truth = {**_truth(site), **(more or {})}
    write_together(
        {
            out / "truth.json": json.dumps(truth, indent=1).encode() + b"\n",
            out / "site.toml": _site_file(site).encode(),
            **{
                out / _file(site, lidar, placement): pcd_of(cloud)
                for lidar, own in enumerate(site.clouds)
                for placement, cloud in enumerate(own)
                if cloud is not None
            },
        }
    )


def _file(site: SimulatedSite, lidar: int, placement: int) -> str:
    """Name of the file of a recording; empty where there is none."""
    if site.clouds[lidar][placement] is None:
        return ""
    return f"{site.names[lidar]}_{site.placements[placement]}.pcd"


def _truth(site: SimulatedSite) -> dict[str, Any]:
    return {
        "kind": site.kind,
        "lidars": [
            {
                "name": name,
                "sensor": sensor.name,
                "T_world_lidar": pose.tolist(),
                "device": device.as_dict(),
            }
            for name, sensor, pose, device in zip(
                site.names, site.sensors, site.T_world_lidar, site.devices, strict=True
            )
        ],
        "placements": [
            {
                "name": name,
                "poles": [
                    {
                        **truth_of_pole(pole),
                        "seen_by": [
                            lidar
                            for lidar, view in zip(site.names, site.seen[p], strict=True)
                            if view[k]
                        ],
                    }
                    for k, pole in enumerate(site.poles[p])
                ],
            }
            for p, name in enumerate(site.placements)
        ],
        "surveyed": {
            pole.name: {"foot_m": _list(pole.foot), "top_m": _list(pole.top)}
            for pole in site.true_surveyed
        },
        "control_points": {point.name: point.at.tolist() for point in site.true_points},
        "noise": asdict(site.noise),
    }


def _list(values: Array | None) -> Any:
    return None if values is None else values.tolist()


def _site_file(site: SimulatedSite) -> str:
    """Give the site file as TOML: strings of JSON are strings of TOML, and numbers are numbers."""
    surveyed = bool(site.surveyed or site.points)
    lines = [
        *_keys(name=f"simulated {site.kind}", placements=list(site.placements)),
        "\n[poles]",
        *_keys(radius_m=site.radius),
        "\n[reference]",
        *(_keys(frame="local") if surveyed else _keys(lidar=site.names[0])),
    ]
    for k, (name, sensor) in enumerate(zip(site.names, site.sensors, strict=True)):
        recordings = [_file(site, k, p) for p in range(len(site.placements))]
        lines += ["\n[[lidar]]", *_keys(name=name, sensor=sensor.name, recordings=recordings)]
    for pole in site.surveyed:
        lines += [
            "\n[[surveyed_pole]]",
            *_keys(
                name=pole.name,
                placement=site.placements[pole.placement],
                foot_m=_list(pole.foot),
                top_m=_list(pole.top),
                sigma_m=pole.sigma,
            ),
        ]
    for point in site.points:
        lines += [
            "\n[[control_point]]",
            *_keys(name=point.name, at_m=point.at.tolist(), sigma_m=point.sigma),
        ]
        for own in point.seen:
            lines += [
                "[[control_point.seen]]",
                *_keys(lidar=site.names[own.lidar], at_m=own.at.tolist(), sigma_m=own.sigma),
            ]
    return "\n".join(lines) + "\n"


def _keys(**values: Any) -> Iterable[str]:
    return (f"{key} = {json.dumps(value)}" for key, value in values.items())
