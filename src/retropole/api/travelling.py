"""Files that a document names, as seen from its folder: both may be moved together."""

from __future__ import annotations

import os
from pathlib import Path, PurePath
from typing import TypeVar

from msgspec.structs import replace

from ..base.files import path_in_text, path_of_text
from ..base.sensors import is_sensor_file, name_from
from ..result import InputDoc, ResultDoc, RunConfig
from ..result.site import SiteDoc

AnyDoc = TypeVar("AnyDoc", ResultDoc, SiteDoc)


def named_from(document: AnyDoc, folder: Path, beside: Path) -> AnyDoc:
    """Name the files of a document by their paths from the folder that it is written to.

    Parameters
    ----------
    document
        Of a pair or of a site.
    folder
        Where it is going to be.
    beside
        Folder that its paths count from now; else they are those from here.

    Returns
    -------
    AnyDoc
        What is no file that is there, as an array, and what is on another drive, keeps its name.
    """

    def name(text: str) -> str:
        return _name(text, folder, beside)

    def sensor(text: str) -> str:
        return name(text) if is_sensor_file(text) else text

    inputs = [
        replace(each, path=name(each.path), sensor=sensor(each.sensor)) for each in document.inputs
    ]
    if isinstance(document, SiteDoc):
        config = replace(document.config, site_file=name(document.config.site_file))
        lidars = [replace(each, sensor=sensor(each.sensor)) for each in document.lidars]
        return replace(document, inputs=inputs, config=config, lidars=lidars)
    options = document.config
    sensors = {key: sensor(getattr(options, key)) for key in ("sensor_target", "sensor_source")}
    return replace(document, inputs=inputs, config=replace(options, **sensors))


def with_sensors_from(document: ResultDoc, folder: Path) -> ResultDoc:
    """Give the sensors that a document names by files so that they mean the same from anywhere.

    Parameters
    ----------
    document
        Of a pair.
    folder
        That holds it.
    """
    inputs: list[InputDoc] = [
        replace(each, sensor=name_from(folder, each.sensor)) for each in document.inputs
    ]
    config: RunConfig = replace(
        document.config,
        sensor_target=name_from(folder, document.config.sensor_target),
        sensor_source=name_from(folder, document.config.sensor_source),
    )
    return replace(document, inputs=inputs, config=config)


def _name(text: str, folder: Path, beside: Path) -> str:
    given = path_of_text(text) if text else None
    place = next((p for p in (given and beside / given, given) if p and p.exists()), None)
    if place is None:
        return text
    # Links to folders are followed, as the system does where it goes up from one; a link to the
    # file is not: it is what is beside the document.
    real = Path(os.path.realpath(place.parent), place.name)
    try:
        relative = os.path.relpath(real, os.path.realpath(folder))
    except ValueError:
        return path_in_text(real)
    return path_in_text(PurePath(relative).as_posix())
