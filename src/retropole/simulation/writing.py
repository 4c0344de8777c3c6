"""Simulated pairs and sites as files that the command line reads, and the truth about them."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from itertools import compress
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from ..base.datatypes import PointCloud
from ..base.files import write_atomically, write_together
from ..io.pcd import pcd_of, write_pcd
from .pairs import SimulatedPair
from .raycast import Cylinder
from .sites import SimulatedSite
from .walks import SimulatedWalk


def write_pair(pair: SimulatedPair, out: Path) -> tuple[str, str]:
    """Write ``lidar0.pcd`` (target), ``lidar1.pcd`` (source) and ``truth.json`` to a folder.

    The three are never of two runs. Of several sweeps each has a file in ``lidar0`` and ``lidar1``.

    Returns
    -------
    tuple of str
        The names of both recordings.
    """
    target, source = pair.devices
    several = pair.target.frame is not None
    names = ("lidar0", "lidar1") if several else ("lidar0.pcd", "lidar1.pcd")
    truth = {
        "T_target_source": pair.T_target_source,
        "T_world_target": pair.T_world_target,
        "T_world_source": pair.T_world_source,
        "target": names[0],
        "source": names[1],
        "sensors": [sensor.name for sensor in pair.sensors],
        "noise": asdict(pair.noise),
        "devices": {"target": target.as_dict(), "source": source.as_dict()},
        "poles": truth_of_poles(pair.poles, pair.returns_on_poles),
    }
    clouds = {out / name: own for name, own in zip(names, (pair.target, pair.source), strict=True)}
    _write(out / "truth.json", _json(truth), clouds)
    return names


def write_walk(walk: SimulatedWalk, out: Path, seed: int) -> tuple[str, ...]:
    """Write ``lidar0`` (target) and ``lidar1`` (source), a file for each sweep, and ``truth.json``.

    Of more than two LiDARs ``lidar2`` and so on as well, and ``site.toml``.

    Parameters
    ----------
    walk
        What is recorded, sweep by sweep: all of them fit into no memory.
    out
        A folder; of a walk before, what is there goes first.
    seed
        Of what is random in both recordings.

    Returns
    -------
    tuple of str
        The names of all recordings.
    """
    names = tuple(f"lidar{k}" for k in range(len(walk.recorders)))
    truth = {
        "T_target_source": walk.T_target_source,
        "clock_offset_s": walk.clock_offset(),
        "clock_drift": -walk.recorders[1].drift,
        "target": names[0],
        "source": names[1],
        "sensors": [each.sensor.name for each in walk.recorders],
        "noise": asdict(walk.recorders[0].noise),
        "radius_m": walk.walks[0].size[0],
        "devices": {
            role: each.device.as_dict()
            for role, each in zip(("target", "source"), walk.recorders, strict=False)
        },
    }
    site = None
    if len(names) > 2:
        each = zip(names, walk.recorders, strict=True)
        lidars = [(name, recorder.sensor.name, [name]) for name, recorder in each]
        lines = _keys({"name": "simulated walk", "placements": ["walk"], "carried": True})
        radius = {"radius_m": walk.walks[0].size[0]}
        site = _tables(lines, [("\n[poles]", radius), *_lidar_tables(lidars)])
        truth["lidars"] = [
            {
                "name": name,
                "sensor": recorder.sensor.name,
                "T_world_lidar": recorder.T_world_sensor,
                "clock_offset_s": walk.clock_offset(k),
                "clock_drift": -recorder.drift,
                "device": recorder.device.as_dict(),
            }
            for k, (name, recorder) in enumerate(zip(names, walk.recorders, strict=True))
        ]
    (out / "truth.json").unlink(missing_ok=True)
    for lidar, name in enumerate(names):
        for left in (out / name).glob("[0-9]*.pcd"):
            left.unlink()
        for k, cloud in enumerate(walk.record(lidar, np.random.default_rng([seed, lidar]))):
            write_pcd(out / name / f"{k:04}.pcd", cloud)
    write_atomically(out / "truth.json", _json(truth))
    if site is not None:
        write_atomically(out / "site.toml", site.encode())
    return names


def _write(first: Path, content: bytes, clouds: Mapping[Path, PointCloud]) -> None:
    """Write recordings, and before them the file that describes them.

    Of several sweeps a recording is a folder, out of which those of a run before are taken.
    """
    files = {first: content}
    for path, cloud in clouds.items():
        if cloud.frame is None:
            files[path] = pcd_of(cloud)
            continue
        sweeps = np.unique(cloud.frame)
        own = {path / f"{k:03}.pcd": pcd_of(cloud.select(cloud.frame == k)) for k in sweeps}
        for left in path.glob("[0-9][0-9][0-9].pcd"):
            if left not in own:
                left.unlink()
        files.update(own)
    write_together(files)


def _json(truth: Mapping[str, Any]) -> bytes:
    return json.dumps(truth, indent=1, default=np.ndarray.tolist).encode() + b"\n"


def truth_of_pole(pole: Cylinder) -> dict[str, Any]:
    """Give where a pole is, and its size, as ``truth.json`` has them."""
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
    recordings = {
        out / _file(site, lidar, placement): cloud
        for lidar, own in enumerate(site.clouds)
        for placement, cloud in enumerate(own)
        if cloud is not None
    }
    truth = _json({**_truth(site), **(more or {})})
    _write(out / "truth.json", truth, recordings)
    write_together({out / "site.toml": _site_file(site).encode()})


def _file(site: SimulatedSite, lidar: int, placement: int) -> str:
    """Name of the file of a recording; empty if there is none."""
    cloud = site.clouds[lidar][placement]
    if cloud is None:
        return ""
    end = ".pcd" if cloud.frame is None else ""
    return f"{site.names[lidar]}_{site.placements[placement]}{end}"


def _truth(site: SimulatedSite) -> dict[str, Any]:
    lidars = zip(site.names, site.sensors, site.T_world_lidar, site.devices, strict=True)
    placements = zip(site.placements, site.poles, site.seen, strict=True)
    return {
        "kind": site.kind,
        "lidars": [
            {"name": name, "sensor": sensor.name, "T_world_lidar": T, "device": device.as_dict()}
            for name, sensor, T, device in lidars
        ],
        "placements": [
            {
                "name": name,
                "poles": [
                    {**truth_of_pole(pole), "seen_by": [*compress(site.names, by)]}
                    for pole, by in zip(poles, zip(*seen, strict=True), strict=True)
                ],
            }
            for name, poles, seen in placements
        ],
        "surveyed": {
            pole.name: {"foot_m": pole.foot, "top_m": pole.top} for pole in site.true_surveyed
        },
        "control_points": {point.name: point.at for point in site.true_points},
        "noise": asdict(site.noise),
    }


def _site_file(site: SimulatedSite) -> str:
    """Give the site file as TOML: strings of JSON are strings of TOML, and numbers are numbers."""
    surveyed = bool(site.surveyed or site.points)
    tables: list[tuple[str, dict[str, Any]]] = [
        ("\n[poles]", {"radius_m": site.radius}),
        ("\n[reference]", {"frame": "local"} if surveyed else {"lidar": site.names[0]}),
    ]
    tables += _lidar_tables(
        (name, sensor.name, [_file(site, k, p) for p in range(len(site.placements))])
        for k, (name, sensor) in enumerate(zip(site.names, site.sensors, strict=True))
    )
    for pole in site.surveyed:
        named = {"placement": site.placements[pole.placement]}
        tables.append(("\n[[surveyed_pole]]", {**_plain(pole), **named}))
    for point in site.points:
        keys = _plain(point)
        seen = keys.pop("seen")
        tables.append(("\n[[control_point]]", keys))
        for own in seen:
            named = {"lidar": site.names[own["lidar"]]}
            tables.append(("[[control_point.seen]]", {**own, **named}))
    lines = _keys({"name": f"simulated {site.kind}", "placements": site.placements})
    return _tables(lines, tables)


def _lidar_tables(
    lidars: Iterable[tuple[str, str, list[str]]],
) -> list[tuple[str, dict[str, Any]]]:
    """Give the tables of LiDARs by their names, sensors and recordings."""
    keys = "name", "sensor", "recordings"
    return [("\n[[lidar]]", dict(zip(keys, each, strict=True))) for each in lidars]


def _tables(lines: list[str], tables: Iterable[tuple[str, dict[str, Any]]]) -> str:
    """Write tables, by their heads, below the first lines."""
    lines = [*lines, *(line for head, keys in tables for line in (head, *_keys(keys)))]
    return "\n".join(lines) + "\n"


def _plain(surveyed: msgspec.Struct) -> dict[str, Any]:
    """Give surveyed values by their names in a site file."""
    keys: dict[str, Any] = msgspec.to_builtins(surveyed, enc_hook=np.ndarray.tolist)
    return keys


def _keys(values: Mapping[str, Any]) -> list[str]:
    return [f"{key} = {json.dumps(value)}" for key, value in values.items()]
