"""The picture of a detection is whole, whatever was found, and runs nothing."""

from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import Detection, PointCloud
from retropole.extraction.poles import extract_poles
from retropole.report.detection import MAX_NUMBERED_POLES, draw_detection
from retropole.simulation import SimulatedPair, simulate_pair
from tests.report.made_up import HOSTILE
from tests.tiers import first_of

pytestmark = pytest.mark.full

SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture(scope="module")
def pair() -> SimulatedPair:
    return simulate_pair("street", np.random.default_rng(1), sensor_target="VLP-16")


def drawn(
    folder: Path, cloud: PointCloud, found: Detection, title: str = "a scan"
) -> ElementTree.Element:
    draw_detection(cloud, found, folder / "new" / "d.svg", title=title)
    assert [p.name for p in (folder / "new").iterdir()] == ["d.svg"], "nothing half written"
    return ElementTree.fromstring((folder / "new" / "d.svg").read_bytes())


def count(root: ElementTree.Element, kind: str) -> int:
    return sum(each.get("class") == kind for each in root.iter())


def dots(root: ElementTree.Element, kind: str) -> int:
    return sum(
        (each.get("d") or "").count("h0") for each in root.iter() if each.get("class") == kind
    )


def test_it_shows_poles_and_what_was_rejected(pair: SimulatedPair, tmp_path: Path) -> None:
    found = extract_poles(pair.target)
    assert found.poles
    assert found.rejected
    root = drawn(tmp_path, pair.target, found)
    panels = min(len(found.poles) + len(found.rejected), 6)
    assert count(root, "line pole") == 2 * len(found.poles)
    assert count(root, "frame pole") + count(root, "frame rejected") == panels
    assert dots(root, "all") > 1000
    assert dots(root, "rejected") > 0
    texts = [each.text or "" for each in root.iter(f"{SVG}text")]
    assert "pole 0" in texts
    assert any(each.startswith("threshold") for each in texts)
    assert found.rejected[0].code in "".join(root.itertext())


@pytest.mark.parametrize(
    "case", first_of(["nothing bright", "nothing rejected", "far from its origin", "one intensity"])
)
def test_any_detection_can_be_drawn(case: str, pair: SimulatedPair, tmp_path: Path) -> None:
    cloud, found = pair.target, extract_poles(pair.target)
    if case == "nothing bright":
        found = Detection((), (), 1e9, "given", 0)
    elif case == "nothing rejected":
        found = replace(found, rejected=())
    elif case == "one intensity":
        cloud = replace(cloud, intensity=np.full(len(cloud), 7.0))
        found = Detection((), (), 7.0, "given", 0)
    else:
        T = se3.from_rt(np.eye(3), np.array([4e5, 5e6, 300.0]))
        cloud = replace(cloud.transformed(T), origin=np.zeros(3))
        found = extract_poles(cloud)
        assert found.poles
    root = drawn(tmp_path, cloud, found, case)
    assert dots(root, "all") > 500
    assert "nan" not in ElementTree.tostring(root, encoding="unicode")


def test_of_many_poles_the_first_are_numbered(pair: SimulatedPair, tmp_path: Path) -> None:
    found = extract_poles(pair.target)
    root = drawn(tmp_path, pair.target, replace(found, poles=found.poles * 20))
    assert count(root, "name") == MAX_NUMBERED_POLES


def test_same_input_gives_the_same_picture(pair: SimulatedPair, tmp_path: Path) -> None:
    found = extract_poles(pair.target)
    one, two = (drawn(tmp_path / name, pair.target, found) for name in "ab")
    assert ElementTree.tostring(one) == ElementTree.tostring(two)


def test_no_text_runs(pair: SimulatedPair, tmp_path: Path) -> None:
    found = extract_poles(pair.target)
    hostile = replace(found, threshold_source=HOSTILE)
    root = drawn(tmp_path, pair.target, hostile, f"{HOSTILE}\x00\x1b")
    kinds = {each.tag.removeprefix(SVG) for each in root.iter()}
    assert kinds <= {"svg", "style", "text", "tspan", "path", "rect"}
    assert not any(name.startswith("on") for each in root.iter() for name in each.attrib)
