"""The files of a site on the machine that reads them; of URLs, copies in a folder of our own."""

from __future__ import annotations

import posixpath
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from msgspec.structs import replace

from ..base.errors import MissingExtraError, ReadError, Refusal, RetropoleError, printable
from ..result import ResultDoc
from ..result.site import SiteDoc
from .dataset import InputEntry
from .sites import ROLES, FleetSite
from .storage import below, fetch, folder_of, is_url

Doc = TypeVar("Doc", ResultDoc, SiteDoc)


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
        return [
            InputEntry(
                lidar=lidar,
                placement=placement,
                path=printable(self._given.get(str(path), str(path))),
                sha256=hash_of(path),
            )
            for lidar, placement, path in self._recordings()
        ]

    def _recordings(self) -> Iterator[tuple[str, str, Path]]:
        """Give each recording with its LiDAR and placement."""
        if self.site is None:
            yield from zip(ROLES, ("1", "1"), self.pair, strict=True)
            return
        from ..api.site_file import read_site_file

        file = read_site_file(self.site)
        for lidar in file.lidar:
            for placement, name in zip(file.placements, lidar.recordings, strict=True):
                if name:
                    yield lidar.name, placement, self._beside(self.site, lidar.name, name)

    def _beside(self, site: Path, lidar: str, name: str) -> Path:
        """Bring a recording that a site file names."""
        path, given = site.parent / name, self._given.get(str(site))
        if given is not None:
            inside = posixpath.normpath(name)
            if posixpath.isabs(inside) or inside.split("/")[0] == ".." or "\\" in name:
                raise ReadError(
                    f"{given}: lidar {lidar}: {name}: the recordings of a site file at a URL "
                    "must lie in its folder or below"
                )
            place = below(folder_of(given), inside)
            if not path.exists():
                fetch(place, path.parent)
            self._given[str(path)] = place
        return path

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

    def named(self, document: Doc) -> Doc:
        """Call the files of a result document as they were given."""
        inputs = [replace(each, path=self.renamed(each.path)) for each in document.inputs]
        document = replace(document, inputs=inputs)
        if isinstance(document, SiteDoc):
            site_file = self.renamed(document.config.site_file)
            document = replace(document, config=replace(document.config, site_file=site_file))
        return document


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
