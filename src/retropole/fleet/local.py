"""The files of a site on the machine that reads them; of URLs, copies in a folder of our own."""

from __future__ import annotations

import posixpath
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import msgspec

from ..base.errors import MissingExtraError, ReadError, Refusal, RetropoleError, printable
from ..result import InputDoc
from .dataset import InputEntry
from .sites import ROLES, FleetSite
from .storage import below, fetch, folder_of, is_url

Doc = TypeVar("Doc", bound=InputDoc)


class LocalFiles:
    """The files of a site as local paths.

    Attributes
    ----------
    folder
        Where copies go.
    pair
        Target and source of a pair; nothing of a site file.
    site
        The site file; None of a pair.

    Parameters
    ----------
    site
        What to take.
    folder
        An empty folder.

    Raises
    ------
    ReadError
        Where a file is not there.
    """

    def __init__(self, site: FleetSite, folder: Path) -> None:
        self.folder = folder
        self._given: dict[str, str] = {}
        self._site = site
        self.pair = [self._take(getattr(site, each), each) for each in ROLES if not site.site]
        self.site = None if not site.site else self._take(site.site, "site")
        if self.site is not None and self.site.is_dir():
            self.site /= "site.toml"

    def _take(self, place: str, into: str) -> Path:
        if not is_url(place):
            return Path(place)
        if into == "site" and not place.endswith(".toml"):
            place = below(place, "site.toml")
        path = fetch(place, self.folder / into)
        self._given[str(path)] = place
        return path

    def inputs(self) -> list[InputEntry]:
        """Hash the recordings; those beside a site file at a URL are copied first.

        Raises
        ------
        ReadError
            Where one cannot be read, or the site file is none.
        """
        if self.site is None:
            return [
                msgspec.structs.replace(entry, sha256=hash_of(path))
                for entry, path in zip(pair_inputs(self._site), self.pair, strict=True)
            ]
        from ..api.site_file import read_site_file

        file = read_site_file(self.site)
        return [
            self._recording(lidar.name, placement, name)
            for lidar in file.lidar
            for placement, name in zip(file.placements, lidar.recordings, strict=True)
            if name
        ]

    def _recording(self, lidar: str, placement: str, name: str) -> InputEntry:
        assert self.site is not None
        path, beside = self.site.parent / name, self._given.get(str(self.site))
        place = str(path)
        if beside is not None:
            inside = posixpath.normpath(name)
            if posixpath.isabs(inside) or inside.split("/")[0] == ".." or "\\" in name:
                raise ReadError(
                    f"{beside}: lidar {lidar}: {name}: the recordings of a site file at a URL "
                    "must lie in its folder or below"
                )
            place = below(folder_of(beside), inside)
            if not path.exists():
                fetch(place, path.parent)
            self._given[str(path)] = place
        return InputEntry(
            lidar=lidar, placement=placement, path=printable(place), sha256=hash_of(path)
        )

    def metadata(self) -> list[str]:
        """Hash the metadata that lie beside packets."""
        beside = [path.with_suffix(".json") for path in self.pair if path.suffix == ".pcap"]
        return [hash_of(path) for path in beside if path.is_file()]

    def renamed(self, text: str) -> str:
        """Call what lies in our own folder as it was given."""
        for path in sorted(self._given, key=len, reverse=True):
            text = text.replace(path, self._given[path])
        return text

    def keep(self, data: bytes, place: str) -> Path:
        """Write what was read of the stored result at a place into a folder of our own."""
        path = self.folder / "stored" / posixpath.basename(place.rstrip("/"))
        path.parent.mkdir()
        path.write_bytes(data)
        self._given[str(path)] = place
        return path

    def named(self, inputs: Sequence[Doc]) -> list[Doc]:
        """Call the inputs of a result document as they were given."""
        return [msgspec.structs.replace(each, path=self.renamed(each.path)) for each in inputs]


@contextmanager
def local_files(site: FleetSite) -> Iterator[LocalFiles]:
    """Bring the files of a site to this machine; what is wrong with one calls it as it was given.

    Raises
    ------
    ReadError
        Where a file is not there.
    """
    with tempfile.TemporaryDirectory(prefix="retropole-") as folder:
        local = LocalFiles(site, Path(folder))
        try:
            yield local
        except (Refusal, MissingExtraError):
            raise
        except RetropoleError as error:
            raise type(error)(local.renamed(str(error))) from None


def pair_inputs(site: FleetSite) -> list[InputEntry]:
    """Name the recordings of a pair; of a site file, what it names is not known yet."""
    roles = () if site.kind == "site" else ROLES
    return [
        InputEntry(lidar=role, placement="1", path=printable(getattr(site, role))) for role in roles
    ]


def hash_of(path: Path) -> str:
    """SHA-256 of a file or a folder; whoever only makes tasks has no need of what can read it."""
    from ..api.inputs import recording_hash

    return recording_hash(path)
