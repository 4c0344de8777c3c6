"""The options of a run: what each is called, of which type and within which bounds, and its help.

The command line makes its options of these fields and the Python interface checks its keywords by
them, so that bounds, defaults and help are here alone.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple, get_args

import msgspec
from msgspec import Meta, inspect

from ..base.bounded import ShareOfSome, Text
from ..base.datatypes import DEFAULT_RADIUS, MAX_RADIUS, MIN_RADIUS
from ..base.errors import UsageError
from ..base.systematic import MAP_SIGMA
from ..base.uncertainty.confirmation import DECEIVING, TOGETHER
from ..base.uncertainty.purpose import DEFAULT_AT, FARTHEST, LARGEST_NEED, Need
from ..io.fields import METRES, USUAL, MapPlace, Unit, Wanted
from ..io.recordings import LEAST_POINTS, MAX_POINTS

UNITS = get_args(Unit)
"""That coordinates may have."""

LARGEST_WHOLE = 2**53
"""Of a whole number: JSON of other programs has none beyond."""

MIN_POLES = 0
"""The surroundings give what poles do not determine; without poles, all (docs/method.md, One pole
or none)."""

MaxPoints = Annotated[int, Meta(ge=LEAST_POINTS, le=LARGEST_WHOLE)]
Radius = Annotated[float, Meta(ge=MIN_RADIUS, le=MAX_RADIUS)]
RadiusSigma = Annotated[float, Meta(ge=0, le=MAX_RADIUS)]
Intensity = Annotated[float, Meta(gt=0, le=1e9)]
Angle = Annotated[float, Meta(ge=-360, le=360)]
Poles = Annotated[int, Meta(ge=MIN_POLES, le=LARGEST_WHOLE)]
NeededError = Annotated[float, Meta(gt=0, le=LARGEST_NEED)]
Coordinate = Annotated[float, Meta(ge=-1e8, le=1e8)]
Distance = Annotated[float, Meta(gt=0, le=FARTHEST)]
PriorSigma = Annotated[float, Meta(gt=0, le=180)]
MastSway = Annotated[float, Meta(gt=0, le=1)]
Frames = tuple[int | None, int | None, int | None]

THINNEST = 0.005
"""Radius from which poles are common, metres: a radius that was given in another unit is one."""


def radius_in_metres(given: float) -> str:
    """Report the probable unit of a radius above the limit, and the value to give.

    Empty if it is not above, or no radius of a pole in centimetres or millimetres.
    """
    meant = {unit: given * METRES[unit] for unit in ("mm", "cm")}
    likely = {unit: r for unit, r in meant.items() if THINNEST <= r <= MAX_RADIUS}
    if given <= MAX_RADIUS or not likely:
        return ""
    # Of two, the one nearer to the usual radius.
    unit = min(likely, key=lambda unit: abs(math.log(likely[unit] / DEFAULT_RADIUS)))
    return f"{given:g} m is not the radius of a pole; {given:g} {unit}? give {likely[unit]:g}"


def describe(text: str) -> Meta:
    """Describe an option, in the text of the command line's help."""
    return Meta(description=text)


def rare(text: str) -> Meta:
    """Mark an option that few need: the command line lists it by --help-all alone."""
    return Meta(description=text, extra={"rare": True})


SAME = describe("The same for SOURCE.")


def frames_named(text: str) -> slice | None:
    """Parse frames as typed, ``A:B``, ``A:B:STEP`` or ``N``; None for anything else."""
    try:
        parts = [int(part) if part.strip() else None for part in text.split(":")]
    except ValueError:
        return None
    if any(abs(part or 0) > LARGEST_WHOLE for part in parts):
        return None
    if len(parts) == 1 and parts[0] is not None:
        return slice(parts[0], parts[0] + 1 or None)
    step = parts[2] if len(parts) == 3 else None
    if len(parts) not in (2, 3) or (step is not None and step < 1):
        return None
    return slice(*parts)


def slice_of(frames: Frames | None) -> slice | None:
    """Convert frames of a document to a slice; None for those evenly spread."""
    return None if frames is None else slice(*frames)


class Reading(NamedTuple):
    """How the recordings of one LiDAR are read.

    Attributes
    ----------
    sensor
        Name of the sensor, or ``auto``.
    threshold
        Intensity from which a return is treated as retro-reflective; None to find it.
    topic, frames
        Of a recording, the topic of a bag and the frames, as `io.read_cloud` takes them.
    max_points
        Of a cloud with more, this many are kept, as `io.read_cloud` does.
    unit
        Of the coordinates: ``m``, ``cm``, ``mm``, ``ft`` or ``in``.
    wanted
        Field of the intensity, and of packets the angles of the unit.
    """

    sensor: str = "auto"
    threshold: float | None = None
    topic: str | None = None
    frames: slice | None = None
    max_points: int = MAX_POINTS
    unit: Unit = "m"
    wanted: Wanted = USUAL


class RunConfig(msgspec.Struct, frozen=True, kw_only=True):
    """The options of a run, as the command line takes them.

    None means not given: any number of poles, no prior, the choice by the scene,
    the threshold of the sensor or the cloud, the only topic, frames evenly spread, no accuracy
    that is needed, for the source the unit of the target. Frames are start, stop and step.
    """

    radius_m: Annotated[
        Radius, describe("Radius of the poles, m: half their thickness, tape included.")
    ] = DEFAULT_RADIUS
    radius_sigma_m: Annotated[
        RadiusSigma, rare("1 sigma of the radius, m. At least 2 % of the radius is used.")
    ] = 0.0
    up: Annotated[
        bool, describe("Both LiDARs are roughly upright: exclude hypotheses that contradict this.")
    ] = False
    prior_rpy_deg: Annotated[
        tuple[Angle, Angle, Angle] | None,
        rare(
            "Expected roll, pitch and yaw of the source in the target's frame, to choose the "
            "hypothesis."
        ),
    ] = None
    prior_sigma_deg: Annotated[PriorSigma, rare("1 sigma of --up or --prior-rpy-deg.")] = 10.0
    map: Annotated[
        bool,
        rare("TARGET is a map: a cloud in any coordinates, merged from many positions."),
    ] = False
    prior_xyz: Annotated[
        tuple[Coordinate, Coordinate, Coordinate] | None,
        rare("Rough position of SOURCE in the map: E N H, from GNSS or a viewer."),
    ] = None
    prior_sigma_m: Annotated[Distance, rare("1 sigma of --prior-xyz, m.")] = 2.0
    map_sigma_m: Annotated[
        Distance, rare("1 sigma of positions in the map relative to each other, m.")
    ] = MAP_SIGMA
    hypothesis: Annotated[
        Text | None,
        rare(
            "Use this hypothesis from the list that the run prints without the option. The "
            "verdict is warn at best, and refused if the scene contradicts it."
        ),
    ] = None
    carried: Annotated[
        bool,
        describe(
            "A person carried one pole in view of both LiDARs while they recorded. "
            "Also gives the clock offset."
        ),
    ] = False
    poles: Annotated[
        Poles | None,
        rare(
            "Exact number of poles that both LiDARs see; 0: no poles, the scene only.  [default: "
            "any]"
        ),
    ] = None
    refine: Annotated[bool, rare("Use the poles only.")] = True
    trust_poles: Annotated[
        bool, rare("You watched the poles: accept two poles that the scene does not confirm.")
    ] = False
    deceiving_share: Annotated[
        ShareOfSome | None,
        rare(
            "Share of similar recordings with misleading poles: moved in between, or other "
            "objects detected as poles. Used to compute the chance of a wrong pose.  [default: "
            f"{DECEIVING:.2f}, or {TOGETHER:g} where both recorded at the same time]"
        ),
    ] = None
    need_m: Annotated[
        NeededError | None,
        describe(
            "Required accuracy, cm. The verdict says whether every point up to "
            f"{DEFAULT_AT:g} m away (--at-m) is within it, with 95 % probability."
        ),
    ] = None
    at_m: Annotated[
        Distance | None,
        rare(f"Distance up to which --need-cm must hold, m.  [default: {DEFAULT_AT:g}]"),
    ] = None
    mast_sway_deg: Annotated[
        MastSway | None,
        rare(
            "1 sigma of the angle by which the masts of both LiDARs sway. Needed for recordings "
            "of one or two sweeps, which do not show the sway.  [default: from the sweeps]"
        ),
    ] = None
    threshold_target: Annotated[
        Intensity | None,
        describe("Intensity from which a return is retro-reflective.  [default: auto]"),
    ] = None
    threshold_source: Annotated[Intensity | None, SAME] = None
    sensor_target: Annotated[Text, describe("Sensor, such as VLP-16, or a .toml file of one.")] = (
        "auto"
    )
    sensor_source: Annotated[Text, SAME] = "auto"
    target_topic: Annotated[
        Text | None, describe("Topic of the bag; needed if it has several topics of point clouds.")
    ] = None
    source_topic: Annotated[Text | None, SAME] = None
    frames: Annotated[
        Frames | None,
        describe(
            "Frames of a recording to read, as Python slices: 0:20, -50:, ::10, 7.  "
            "[default: evenly spread, about a million points]"
        ),
    ] = None
    max_points: Annotated[
        MaxPoints,
        rare(
            "Maximum number of points to read from a cloud. From a larger one fewer frames are "
            "read, or the brightest points and a sample of the others."
        ),
    ] = MAX_POINTS
    unit: Annotated[Unit, describe("Unit of coordinates; see 'retropole info'.")] = "m"
    unit_source: Annotated[Unit | None, SAME] = None
    intensity: Annotated[
        Text | None,
        rare("Field of the intensity, if there are several; 'retropole info' lists them."),
    ] = None
    intensity_source: Annotated[Text | None, SAME] = None
    angles: Annotated[
        Text | None,
        rare(
            "For packets, the file with the angles of the unit: Hesai's .csv, or .dat of an AT128."
        ),
    ] = None
    angles_source: Annotated[Text | None, SAME] = None

    @property
    def source_unit(self) -> Unit:
        """Unit of the source, or else that of the target."""
        return self.unit_source or self.unit

    @property
    def source_intensity(self) -> str | None:
        """Field of the source's intensity, empty for the usual, or else that of the target."""
        own = self.intensity_source
        return self.intensity if own is None else own

    @property
    def mast_sway(self) -> float | None:
        """1 σ of the sway that was stated, rad."""
        return None if self.mast_sway_deg is None else math.radians(self.mast_sway_deg)

    @property
    def need(self) -> Need | None:
        """The accuracy that is needed."""
        return None if self.need_m is None else Need(self.need_m, self.at_m or DEFAULT_AT)

    @property
    def of_target(self) -> Reading:
        """How recordings of the target are read."""
        sensor, threshold, topic = self.sensor_target, self.threshold_target, self.target_topic
        place = MapPlace(self.prior_xyz, self.map_sigma_m) if self.map else None
        wanted = Wanted(self.intensity, self.angles, place=place)
        return Reading(
            sensor, threshold, topic, slice_of(self.frames), self.max_points, self.unit, wanted
        )

    @property
    def of_source(self) -> Reading:
        """How recordings of the source are read."""
        sensor, threshold, topic = self.sensor_source, self.threshold_source, self.source_topic
        wanted = Wanted(self.source_intensity, self.angles_source)
        how = slice_of(self.frames), self.max_points, self.source_unit, wanted
        return Reading(sensor, threshold, topic, *how)


DEFAULT_CONFIG = RunConfig()


class Pair(NamedTuple):
    """Fields of what each LiDAR has: one value is of both, unless it is the target's `alone`.

    A second value that is None means `usual`: a source without a unit has the target's.
    """

    name: str
    target: str
    source: str
    alone: bool = False
    usual: object = None

    def fields(self, *values: object) -> dict[str, object]:
        """Give the values of both fields, of one value or those of target and source."""
        if len(values) > 2:
            raise UsageError(f"{self.name}: one value for both LiDARs, or target's and source's")
        second = self.usual if values[-1] is None else values[-1]
        first = {} if values[0] is None else {self.target: values[0]}
        return first | {self.source: None if len(values) == 1 and self.alone else second}


PAIRS = {
    "sensor": Pair("sensor", "sensor_target", "sensor_source", usual="auto"),
    "threshold": Pair("threshold", "threshold_target", "threshold_source"),
    "topic": Pair("topic", "target_topic", "source_topic"),
    "unit": Pair("unit", "unit", "unit_source", alone=True, usual="m"),
    "intensity": Pair("intensity", "intensity", "intensity_source", alone=True, usual=""),
    "angles": Pair("angles", "angles", "angles_source", alone=True),
}
"""By what the command line and Python call each."""


class Option(NamedTuple):
    """What an option may be: its type with the bounds, of several values that of each, and help."""

    kind: inspect.Type
    help: str
    is_rare: bool


def _option(kind: inspect.Type) -> Option:
    assert isinstance(kind, inspect.Metadata)
    schema, inner = kind.extra_json_schema or {}, kind.type
    if isinstance(inner, inspect.UnionType):
        inner = inner.types[0]
    if isinstance(inner, inspect.TupleType):
        inner = inner.item_types[0]
    return Option(inner, schema["description"], bool(kind.extra))


_RUN = inspect.type_info(RunConfig)
assert isinstance(_RUN, inspect.StructType)
OPTIONS = {field.name: _option(field.type) for field in _RUN.fields}
"""Every option of a run, by its field of `RunConfig`."""
