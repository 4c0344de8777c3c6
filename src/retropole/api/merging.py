"""One cloud of all LiDARs of a stored result, and how far the surfaces that they see differ."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain
from operator import itemgetter
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..base import se3
from ..base.datatypes import Array, PointCloud
from ..base.errors import ReadError, UsageError
from ..base.files import write_atomically
from ..base.projection import projected, unproject
from ..base.quantities import counted, step_of
from ..base.sensors import SWEEP_SECONDS
from ..base.world import in_projected, to_frame
from ..export.clouds import (
    LARGE,
    About,
    Rgb,
    by_lidar,
    by_value,
    cloud_writer,
    comments_of,
    surfel_file,
)
from ..export.tree import GROUND, MAP, SITE
from ..fusion import surfels as fusing
from ..fusion.merging import Points, fused, inside, is_static, usual_view, voxels
from ..fusion.surfels import Distance, SurfaceDistance, Surfels
from ..io import Frame, Recording, chosen_frames, open_recording
from ..io.fields import USUAL, in_metres
from ..io.recordings import is_unix
from ..result import LEVEL_FILE, Reading, ReasonDoc, ResultDoc, verdict_line
from ..result.level import level_of
from ..result.options import Frames, slice_of
from ..result.site import SiteDoc, as_site
from ..surfaces.static import MIN_FRAMES
from .checking import topic_for
from .inputs import SILENT, Listener, recording_hash
from .stored import find_recordings, loaded, with_poses, with_sensors_from

SWEEPS_FOR_STATIC = 31
"""Sweeps, spread over a recording, that show what a LiDAR usually sees: 16 MB of ranges. Something
that was in a direction for less than half of the time is absent from most of them."""

WRITE_BLOCK = 2**18
"""Points that are written at a time where they are in memory: 10 MB."""


class Opened(NamedTuple):
    """A recording of a LiDAR: its index, the frames to read, and how."""

    lidar: int
    recording: Recording
    numbers: range
    how: Reading


@dataclass(frozen=True, eq=False)
class Merged:
    """What was merged.

    Attributes
    ----------
    lidars
        Names.
    frame, epsg
        Frame of the coordinates, and the code of its projected system, or None.
    sweeps, points
        Read of each LiDAR.
    moving
        Points left out since something moved there.
    written
        Points, or surfels, in the file.
    surfels, apart, distances
        If they were requested: what all LiDARs see, and how far it differs, place by
        place and in numbers.
    notes
        Sentences on what is to be known.
    reasons
        What the calibration warns of.
    """

    lidars: tuple[str, ...]
    frame: str
    epsg: int | None
    sweeps: list[int]
    points: list[int]
    moving: int = 0
    written: int = 0
    surfels: Surfels | None = None
    apart: tuple[SurfaceDistance, ...] = ()
    distances: list[Distance] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    reasons: list[ReasonDoc] = field(default_factory=list)

    @property
    def surfaces(self) -> list[str]:
        """Describe the distances between surfaces, a line for each pair of LiDARs."""
        return fusing.in_words(self.distances, self.lidars)


class Placed(NamedTuple):
    """Where the LiDARs are in the frame of the output.

    Attributes
    ----------
    name, epsg
        Of the frame.
    poses
        (4, 4) of each LiDAR, in metres on the ground.
    finish
        From there (N, 3) to the coordinates of the frame.
    """

    name: str
    epsg: int | None
    poses: list[Array]
    finish: Callable[[Array], Array] | None = None

    def coordinates(self, xyz: Array) -> Array:
        """Give the coordinates of the frame (N, 3)."""
        return xyz if self.finish is None else self.finish(xyz)

    @property
    def origins(self) -> Array:
        """(L, 3) the LiDARs, in the coordinates of the frame."""
        return self.coordinates(np.array([pose[:3, 3] for pose in self.poses]))


def placed(
    document: ResultDoc | SiteDoc, file: Path, frame: str = "", epsg: int | None = None
) -> Placed:
    """Place the LiDARs of a result in a frame.

    Parameters
    ----------
    document, file
        Of a pair or of a site, with poses, and where it is.
    frame
        Name of a LiDAR, ``site``, ``map``: the coordinates that the survey is in, exactly; or
        ``ground``, by the `LEVEL_FILE` next to the result.
    epsg
        Of ``map``, another projected system than that of the survey.

    Raises
    ------
    UsageError
        If there is no such frame, nothing ties the site to the earth, or it was not leveled.
    MissingExtraError
        If a projected system needs pyproj.
    """
    site = as_site(document)
    names = [lidar.name for lidar in site.lidars]
    poses = [np.array(lidar.T_site_lidar, dtype=float) for lidar in site.lidars]
    if epsg is not None or frame == MAP:
        if frame not in ("", MAP):
            raise UsageError(f"--crs belongs to the frame map, not to {frame}")
        if epsg is None and not has_map(site):
            raise UsageError(
                f"the result has no frame map: its frame is {site.frame.name}; there are "
                f"{', '.join(names)}, and --crs if the survey is on the earth"
            )
        code = site.frame.epsg if epsg is None else epsg
        to_map = partial(to_frame, site.frame)
        if code is not None and code != site.frame.epsg:
            to_map = partial(in_projected, site.frame, epsg=code)
        found = Placed(MAP, code, poses, to_map)
        if code is not None:
            # Refuses what is far outside of where it is used.
            unproject(projected(code), found.origins)
        return found
    if frame in names:
        T_frame_site = se3.inverse(poses[names.index(frame)])
        return Placed(frame, None, [T_frame_site @ pose for pose in poses])
    if frame == GROUND:
        level_file = file.with_name(LEVEL_FILE)
        if not level_file.exists():
            raise UsageError(
                f"{level_file} does not exist: 'retropole level' finds the ground and writes it"
            )
        T_ground_site = loaded(level_file, lambda data: level_of(data, site.lidars)).T_ground_frame
        own = [T_ground_site @ pose for pose in poses]
        return Placed(GROUND, None, own)
    if frame not in ("", SITE) or (frame and isinstance(document, ResultDoc)):
        there = [*names, *[SITE] * isinstance(document, SiteDoc), *[MAP] * has_map(site), GROUND]
        raise UsageError(f"no frame is named {frame!r}; there are {', '.join(there)}")
    return Placed(SITE if isinstance(document, SiteDoc) else names[0], None, poses)


def warnings_of(document: ResultDoc | SiteDoc) -> list[str]:
    """Write the verdict of the calibration into a file."""
    lines = [f"warning ({each.code}): {each.message}" for each in document.reasons]
    return [verdict_line(document.status, document.reasons), *lines]


def has_map(site: SiteDoc) -> bool:
    """Whether a site has separate coordinates, other than those it counts from."""
    return site.frame.epsg is not None or bool(np.any(site.frame.offset))


def merge(
    result: str | Path,
    recordings: Sequence[Path] | Mapping[str, Path] = (),
    *,
    out: Path | None = None,
    frame: str = "",
    epsg: int | None = None,
    topics: Mapping[str, str] | None = None,
    frames: Frames | None = None,
    voxel: float | None = None,
    crop: Array | None = None,
    colour: str | None = None,
    static: bool = False,
    surfels: float | None = None,
    listener: Listener = SILENT,
) -> Merged:
    """Bring all sweeps of all LiDARs of a result into one frame, and write them.

    Sweeps are taken one at a time, in the order of their stamps. Nothing is corrected for the
    motion of a carrier.

    Parameters
    ----------
    result
        ``result.json``, ``site-result.json``, or its folder.
    recordings
        Other recordings of the same LiDARs by their names (of a pair ``target`` and ``source``);
        or where those of the run are now, as `stored.find_recordings` takes them. A pair of paths
        that are not those of the run are target and source.
    out
        File of one of `export.clouds.SUFFIXES`; with `surfels` a ``.ply`` of these, or None.
    frame, epsg
        As `placed` takes them. By default ``map`` for LAS and LAZ where the result has it, else
        ``site``, which is the frame of the target for a pair.
    topics
        Of bags, by the names of the LiDARs, where they are other than in the run.
    frames
        Of each recording, start, stop and step; None takes all.
    voxel
        Keep one point for each cube of this side, metres.
    crop
        (2, 3) corners of a box in the coordinates of the output; what is outside is left out.
    colour
        ``lidar``, ``intensity`` or ``height``, or None.
    static
        Leave out what moved: see `fusion.merging.is_static`. Only of LiDARs at rest.
    surfels
        Side of the cells, metres, to make surfels and compare LiDARs.
    listener
        Receives each sweep.

    Raises
    ------
    Refusal
        If the result was refused: it has no poses.
    ReadError, UsageError, MissingExtraError, OSError
        Where something cannot be read or written, or options do not go together.
    """
    file, document = with_poses(result)
    suffix = "" if out is None else out.suffix.lower()
    if surfels is not None and suffix not in ("", ".ply"):
        raise UsageError(f"{out}: surfels are written as .ply")
    if surfels is not None and (voxel is not None or colour is not None):
        raise UsageError(
            "surfels use all points and have separate colours: leave out voxels and colours"
        )
    if surfels is None and out is None:
        raise UsageError("give a file to write, or surfels to compare the LiDARs")
    if suffix == ".mcap" and (voxel is not None or colour is not None):
        raise UsageError(
            "MCAP stores the sweeps one by one, without colours: voxels and colours are for .ply, "
            ".pcd, .las and .laz"
        )
    site = with_sensors_from(as_site(document), file.parent)
    names = [lidar.name for lidar in site.lidars]
    if not frame and suffix in (".las", ".laz") and has_map(site):
        frame = MAP
    at = placed(document, file, frame, epsg)
    opened, notes = _opened(document, site, file, recordings, topics or {}, frames)
    if document.sways:
        notes.append("a LiDAR swayed while the calibration was recorded; no sweep is corrected")
    if static:
        notes.append("moving objects can be left out only if the LiDARs are at rest")
    stream = _Stream(opened, at, len(names), crop, static, listener)
    about = _about(stream, at, names, [*warnings_of(document), *notes, *stream.notes], colour)
    made = Merged(tuple(names), at.name, at.epsg, stream.sweeps, stream.points)
    written = 0
    if surfels is not None:
        moments = fusing.moments_of((points for points, _ in stream), surfels)
        is_level = at.name == GROUND or (site.frame.surveyed and at.name in (SITE, MAP))
        up = np.array([0.0, 0.0, 1.0]) if is_level else stream.up()
        origins = stream.origins()
        distances = tuple(fusing.surface_distances(moments, origins, up))
        found = fusing.surfels_of(moments, origins)
        written = len(found.centres)
        if out is not None:
            distance = fusing.distance_at(found, distances, surfels)
            write_atomically(out, surfel_file(found, distance, comments_of(about)))
        made = replace(made, surfels=found, apart=distances, distances=fusing.distances(distances))
    elif out is not None:
        with cloud_writer(out, about) as write:
            parts: Iterable[tuple[Points, float]] = stream
            if voxel is not None:
                every = voxels((points for points, _ in stream), voxel)
                blocks = range(0, len(every), WRITE_BLOCK)
                parts = ((every[k : k + WRITE_BLOCK], 0.0) for k in blocks)
            for points, when in parts:
                write(points, when)
                written += len(points)
            if not written:
                raise UsageError(
                    "no point is left: is the box of --crop given in the frame of the output?"
                )
    notes += stream.notes
    return replace(
        made, written=written, moving=stream.moving, notes=notes, reasons=document.reasons
    )


def _opened(
    document: ResultDoc | SiteDoc,
    site: SiteDoc,
    file: Path,
    given: Sequence[Path] | Mapping[str, Path],
    topics: Mapping[str, str],
    frames: Frames | None,
) -> tuple[list[Opened], list[str]]:
    """Open the recordings of the run, or those given, and give notes about them."""
    names, notes = [lidar.name for lidar in site.lidars], []
    if isinstance(document, ResultDoc) and not isinstance(given, Mapping) and len(given) == 2:
        given = dict(zip(names, given, strict=True))
    for name in [*(given if isinstance(given, Mapping) else ()), *topics]:
        if name not in names:
            raise UsageError(f"no LiDAR is called {name!r}; there are {', '.join(names)}")
    known = {item.lidar: item.reading(0) for item in reversed(site.inputs)}
    to_open: list[tuple[int, Path, Reading]] = []
    if isinstance(given, Mapping):
        hashes = {item.sha256 for item in site.inputs}
        others = [name for name, path in given.items() if recording_hash(path) not in hashes]
        if others:
            notes.append(
                f"{', '.join(others)}: not the recordings of the calibration; the clouds are "
                "aligned only if no LiDAR has moved since"
            )
        left = [name for name in names if name not in given]
        if left:
            notes.append(f"{', '.join(left)}: no recording is given, left out")
        for name, path in given.items():
            how = known.get(names.index(name), Reading())
            topic = topic_for(path, topics.get(name), how.topic)
            wanted = USUAL.or_known(how.wanted)
            lidar = names.index(name)
            to_open.append((lidar, path, how._replace(topic=topic, wanted=wanted)))
    else:
        for item, there, fault in find_recordings(document, file.parent, given):
            if fault:
                notes.append(f"{fault}; it is {'left out' if there is None else 'merged'}")
            if there is not None:
                how = item.reading(0)
                topic = topics.get(names[item.lidar], how.topic)
                to_open.append((item.lidar, there, how._replace(topic=topic)))
    if not to_open:
        raise ReadError(f"{file}: none of its recordings was found; give their paths")
    opened = []
    for lidar, path, how in to_open:
        recording = open_recording(path, topic=how.topic, wanted=how.wanted)
        numbers = chosen_frames(recording, slice_of(frames) or slice(None))
        opened.append(Opened(lidar, recording, numbers, how))
    return opened, notes


class _Stream:
    """Sweeps of all recordings in the frame of the output, by their stamps, one in memory each.

    It is gone through once. `heads` are the first sweeps with returns, which it starts with.
    """

    def __init__(
        self,
        opened: Sequence[Opened],
        at: Placed,
        lidars: int,
        crop: Array | None,
        static: bool,
        listener: Listener,
    ) -> None:
        self.opened, self.at, self.crop, self.listener = opened, at, crop, listener
        self.sweeps, self.points, self.moving = [0] * lidars, [0] * lidars, 0
        self.notes: list[str] = []
        self.views = [self._view(each) if static else None for each in opened]
        self._rest = [each.recording.read(each.numbers) for each in opened]
        self.heads: list[Frame] = []
        for each, frames in zip(opened, self._rest, strict=True):
            head = next((frame for frame in frames if len(frame.cloud)), None)
            if head is None:
                raise ReadError(f"{each.recording.path}: none of its frames has a return")
            self.heads.append(head)
        stamps = [head.stamp for head in self.heads]
        # One clock for all, so all or none by the recorder's.
        self.is_stamped = all(s is not None and 0 <= s < 2**31 for s in stamps)

    def _view(self, each: Opened) -> Array | None:
        if len(each.numbers) < MIN_FRAMES:
            self.notes.append(
                f"{each.recording.path}: {counted(len(each.numbers), 'sweep')} do not show what "
                f"moves, {MIN_FRAMES} are needed"
            )
            return None
        self.listener.progress(f"find moving objects: {each.recording.path.name}")
        some = each.numbers[:: -(-len(each.numbers) // SWEEPS_FOR_STATIC)]
        return usual_view(
            in_metres(frame.cloud, each.how.unit) for frame in each.recording.read(some)
        )

    def _timed(self, k: int) -> Iterator[tuple[float, int, PointCloud]]:
        when, unit = 0.0, self.opened[k].how.unit
        for frame in chain([self.heads[k]], self._rest[k]):
            # LiDARs turn ten times a second, mostly.
            own = frame.stamp if self.is_stamped else SWEEP_SECONDS * frame.number
            when = when if own is None else own
            yield when, k, in_metres(frame.cloud, unit)

    def origins(self) -> Array:
        """(L, 3) where the beams of each LiDAR start, in the coordinates of the output."""
        origins = np.array([pose[:3, 3] for pose in self.at.poses])
        for head, each in zip(self.heads, self.opened, strict=True):
            own = in_metres(head.cloud, each.how.unit).origin
            origins[each.lidar] = se3.apply(self.at.poses[each.lidar], own[None])[0]
        return self.at.coordinates(origins)

    def up(self) -> Array:
        """Find the vertical by the ground that the first LiDAR sees."""
        first = self.opened[0]
        head = in_metres(self.heads[0].cloud, first.how.unit)
        return fusing.up_by_ground(head, self.at.poses[first.lidar])

    def fused(self, cloud: PointCloud, lidar: int) -> Points:
        """Bring a sweep to the coordinates of the output."""
        points = fused(cloud, self.at.poses[lidar], lidar)
        if self.at.finish is not None and len(points):
            points["xyz"] = self.at.finish(points["xyz"])
        return points

    def __iter__(self) -> Iterator[tuple[Points, float]]:
        total = sum(len(each.numbers) for each in self.opened)
        timed = [self._timed(k) for k in range(len(self.opened))]
        merged = heapq.merge(*timed, key=itemgetter(0))
        for done, (when, k, cloud) in enumerate(merged, 1):
            self.listener.progress(step_of("merge: sweep", done, total))
            lidar, view = self.opened[k].lidar, self.views[k]
            self.sweeps[lidar] += 1
            self.points[lidar] += len(cloud)
            if view is not None and len(cloud):
                stays = is_static(cloud, view)
                self.moving += int(len(cloud) - stays.sum())
                cloud = cloud.select(stays)
            points = self.fused(cloud, lidar)
            yield points if self.crop is None else points[inside(points["xyz"], self.crop)], when


def _about(
    stream: _Stream, at: Placed, names: Sequence[str], comments: Sequence[str], colour: str | None
) -> About:
    """Describe a file by the first sweep of each LiDAR."""
    clouds = [
        in_metres(head.cloud, each.how.unit)
        for head, each in zip(stream.heads, stream.opened, strict=True)
    ]
    heads = [stream.fused(c, each.lidar) for c, each in zip(clouds, stream.opened, strict=True)]
    first = np.concatenate(heads)
    times = [cloud.time[0] for cloud in clouds if cloud.time is not None]
    bright = first["intensity"][np.isfinite(first["intensity"])]
    if colour == "intensity" and not len(bright):
        raise UsageError("no LiDAR has intensities for colours")
    low, high = np.percentile(bright, (2, 98)) if len(bright) else (0.0, 1.0)
    bottom, top = np.percentile(first["xyz"][:, 2], (1, 99))
    colours: dict[str, Callable[[Points], Rgb]] = {
        "lidar": by_lidar,
        "intensity": lambda points: by_value(points["intensity"], low, high),
        "height": lambda points: by_value(points["xyz"][:, 2], bottom, top),
    }
    wkt = "" if at.epsg is None else projected(at.epsg).crs.to_wkt("WKT1_GDAL")
    return About(
        names=names,
        frame=at.name if at.epsg is None else f"{at.name} (EPSG:{at.epsg})",
        comments=comments,
        has_intensity=bool(len(bright)),
        has_ring=any(cloud.ring is not None for cloud in clouds),
        has_time=bool(times),
        is_large=bool(np.abs(at.origins).max() > LARGE),
        middle=at.origins.mean(axis=0),
        is_unix=bool(times) and all(map(is_unix, times)),
        # On a scale of 0 to 1, whole numbers would be black and white.
        intensity_scale=65_535.0 if len(bright) and bright.max() <= 1.0 else 1.0,
        wkt=wkt,
        colour=None if colour is None else colours[colour],
    )
