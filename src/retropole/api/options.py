"""Options of a run as Python takes them: by the names of `RunConfig`, whose unit is left out.

``radius`` is `RunConfig.radius_m`. Only there is stated what a value may be.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping
from pathlib import Path

import msgspec
from msgspec import inspect
from msgspec.structs import replace

from ..base.errors import UsageError, said
from ..base.sensors import name_from
from ..hypotheses.choice import is_hypothesis_name
from ..hypotheses.prior import pose_prior
from ..result import DEFAULT_CONFIG, RunConfig
from ..result.options import OPTIONS, PAIRS, UNITS, radius_in_metres


def keyword(field: str) -> str:
    """Name an option as a keyword of Python."""
    return field.removesuffix("_m")


def run_config(options: Mapping[str, object], others: RunConfig = DEFAULT_CONFIG) -> RunConfig:
    """Make options from their keywords, and refuse other ones; NumPy's numbers are accepted.

    Options that are not there are taken of `others`.

    Raises
    ------
    UsageError
        Naming the option and what is expected.
    """
    named = {f: options[keyword(f)] for f in RunConfig.__struct_fields__ if keyword(f) in options}
    frames = named.get("frames")
    if isinstance(frames, slice):
        named["frames"] = frames.start, frames.stop, frames.step
    return checked_options(replace(others, **named))


def with_keywords(
    options: RunConfig, keywords: Mapping[str, object], older: Mapping[str, object]
) -> RunConfig:
    """Replace options by the keywords that are not None.

    Those of `PAIRS` have one value, or target's and source's. `older` keywords are given by
    `options` now; they still work, with a warning.

    Raises
    ------
    UsageError, TypeError
        As `checked_options`; for a keyword that is not an option.
    """
    if not isinstance(options, RunConfig):
        raise UsageError(f"options is {options!r}, expected a RunConfig")
    given = {name: value for name, value in keywords.items() if value is not None}
    for name in PAIRS.keys() & given:
        value = given.pop(name)
        given |= PAIRS[name].fields(*(value if isinstance(value, tuple | list) else (value,)))
    if unknown := older.keys() - set(map(keyword, RunConfig.__struct_fields__)):
        raise TypeError(f"unexpected keyword argument: {', '.join(unknown)}")
    if older:
        message = (
            f"{', '.join(older)}: give them through options, or as sensor, threshold, topic or unit"
        )
        warnings.warn(message, DeprecationWarning, stacklevel=3)
    return run_config({**given, **older}, options)


def checked_options(config: RunConfig) -> RunConfig:
    """Refuse options that make no sense, before anything is read.

    Returns
    -------
    RunConfig
        The same, in Python's built-in types: the result document has no others. Files of sensors
        and of angles have their whole paths.

    Raises
    ------
    UsageError
        Naming the option and what is expected.
    """
    try:
        plain = msgspec.to_builtins(config, enc_hook=lambda value: value.tolist())
        config = msgspec.convert(plain, RunConfig, strict=False)
    except msgspec.ValidationError as error:
        raise UsageError(_in_words(str(error), config)) from None
    except (TypeError, AttributeError, OverflowError) as error:
        raise UsageError(f"an option has a value of the wrong type: {said(error)}") from None
    if config.at_m is not None and config.need_m is None:
        raise UsageError("at is the distance up to which the accuracy need must hold: give both")
    if config.hypothesis is not None and not is_hypothesis_name(config.hypothesis):
        raise UsageError(f"hypothesis is {config.hypothesis!r}, expected {LETTER}")
    spare = [f for f in NOT_OF_WALKS if getattr(config, f) != getattr(DEFAULT_CONFIG, f)]
    if config.carried and spare:
        names = ", ".join(keyword(field) for field in spare)
        raise UsageError(f"{names} cannot be used with a pole that is carried: leave it out")
    pose_prior(config.up, config.prior_rpy_deg, config.prior_sigma_deg)
    if config.prior_xyz is not None and not config.map:
        raise UsageError("prior_xyz (--prior-xyz) is a position in a map: give map (--map) as well")
    if config.map_sigma_m != DEFAULT_CONFIG.map_sigma_m and not config.map:
        raise UsageError("map_sigma_m (--map-sigma-m) describes a map: give map (--map) as well")
    if config.map and not config.refine:
        raise UsageError(
            "in a map the pose is determined by surfaces: leave out refine (--no-refine)"
        )
    sensors = (name_from(Path(), name) for name in (config.sensor_target, config.sensor_source))
    named = dict(zip(("sensor_target", "sensor_source"), sensors, strict=True))
    files = (("angles", config.angles), ("angles_source", config.angles_source))
    named |= {name: str(Path(file).resolve()) for name, file in files if file is not None}
    return replace(config, **named)


NOT_OF_WALKS = (
    *("radius_sigma_m", "up", "prior_rpy_deg", "prior_sigma_deg", "hypothesis", "poles"),
    *("trust_poles", "deceiving_share", "mast_sway_deg", "map", "prior_xyz"),
)
"""Options of poles that are set up that give no information about one that is carried."""

LETTER = "a letter from the list of hypotheses, such as a"


def _in_words(message: str, config: RunConfig) -> str:
    """Report which option is wrong, and what is expected."""
    what, _, where = message.partition(" - at `$.")
    field = re.split(r"\W", where)[0]
    given, kind = f"{keyword(field)} is {getattr(config, field)!r}", OPTIONS[field].kind
    if isinstance(kind, inspect.LiteralType):
        return f"{given}, expected {', '.join(UNITS)}"
    if field == "hypothesis":
        return f"{given}, expected {LETTER}"
    if "got" in what or not isinstance(kind, inspect.FloatType | inspect.IntType):
        return f"{given}, of the wrong type: {what[0].lower()}{what[1:]}"
    unit = " m" if field.endswith("_m") else ""
    if field == "radius_m" and (fault := radius_in_metres(float(config.radius_m))):
        return f"{given}: {fault}"
    if isinstance(kind, inspect.IntType):
        return f"{given}, expected a number from {kind.ge} to {kind.le}"
    if kind.ge is None:
        return f"{given}, expected a number above {kind.gt:g}, {kind.le:g}{unit} at most"
    return f"{given}, expected a number from {kind.ge:g} to {kind.le:g}{unit}"
