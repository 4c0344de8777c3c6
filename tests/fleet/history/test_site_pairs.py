"""Of a site of many LiDARs every pair that shared poles is watched by itself."""

from pathlib import Path

import msgspec
import pytest
from msgspec.structs import replace

from retropole.fleet.history.check import check_site, watched_pairs
from retropole.fleet.sites import FleetSite, find_sites
from retropole.result import encode
from retropole.result.decoding import decode_site
from tests.api.site_files import write_site
from tests.fleet.history.test_check import CHECK
from tests.report.site.made_up import document_of, made_up_site

pytestmark = pytest.mark.full


@pytest.fixture
def quay(tmp_path: Path) -> FleetSite:
    """A site file with recordings, and a stored result beside it."""
    folder = tmp_path / "quay"
    folder.mkdir()
    write_site(folder)
    document = document_of(made_up_site(lidars=3, placements=2, count=40))
    (folder / "site-result.json").write_bytes(encode(document))
    (site,) = find_sites([str(folder / "site.toml")])
    return site


def test_a_pair_is_itself() -> None:
    site = FleetSite(id="a", kind="pair", target="t.pcd", source="s.pcd")
    (pair,) = watched_pairs(site)
    assert (pair.site, pair.origin, pair.lidars) == (site, "a", None)


def test_each_pair_has_its_recordings_and_options(quay: FleetSite) -> None:
    pairs = {pair.site.id: pair for pair in watched_pairs(quay)}
    assert len(pairs) > 1
    pair = pairs["quay/mast-a/mast-b"]
    folder = Path(quay.site).parent
    assert (pair.origin, pair.lidars) == ("quay", ("mast-a", "mast-b"))
    assert pair.site.target == str(folder / "mast-a/1.pcd")
    assert pair.site.source == str(folder / "mast-b/1.pcd")
    assert pair.site.result == str(folder / "site-result.json")
    assert (pair.site.fault, pair.site.config.radius_m) == ("", 0.02)


def test_each_lidar_is_read_as_its_file_says_or_else_as_for_the_result(quay: FleetSite) -> None:
    folder = Path(quay.site).parent
    path, stored = Path(quay.site), decode_site((folder / "site-result.json").read_bytes())
    wanted = {0: {"angles": "a.csv", "intensity": "echo"}, 1: {"angles": "b.csv"}}
    inputs = [replace(each, **wanted.get(each.lidar, {})) for each in stored.inputs]
    (folder / "site-result.json").write_bytes(encode(replace(stored, inputs=inputs)))
    named = 'name = "mast-b"\nangles = "new.csv"'
    path.write_text(path.read_text().replace('name = "mast-b"', named))
    pairs = {pair.site.id: pair.site.config for pair in watched_pairs(quay)}
    config = pairs["quay/mast-a/mast-b"]
    assert config.of_target.wanted[:2] == ("echo", str(folder / "a.csv"))
    assert config.of_source.wanted[:2] == ("", str(folder / "new.csv"))


def test_a_pair_is_held_against_the_result_of_the_site(quay: FleetSite) -> None:
    (pair, *_) = watched_pairs(quay)
    one = check_site(pair.site, msgspec.structs.replace(CHECK, lidars=pair.lidars))
    assert one is not None
    # Points at random show neither poles nor surfaces; what is stored was read.
    assert (one.status, one.id) == ("cannot_tell", pair.site.id)
    assert one.stored_sha256


def test_what_cannot_be_watched_says_why(quay: FleetSite) -> None:
    folder = Path(quay.site).parent
    text = (folder / "site.toml").read_text()
    (folder / "site.toml").write_text(text.replace('"mast-b"', '"mast-c"'))
    faults = {pair.site.id: pair.site.fault for pair in watched_pairs(quay)}
    assert "it has no LiDARs mast-a and mast-b" in faults["quay/mast-a/mast-b"]
    (folder / "site.toml").write_text(
        text.replace('name = "mast-b"', 'name = "mast-b"\nframes = "1:3"')
    )
    faults = {pair.site.id: pair.site.fault for pair in watched_pairs(quay)}
    assert "a check needs whole recordings" in faults["quay/mast-a/mast-b"]
    (folder / "site-result.json").unlink()
    (pair,) = watched_pairs(quay)
    assert (pair.site.id, "site-result.json" in pair.site.fault) == ("quay", True)
