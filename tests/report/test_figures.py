"""Pictures are whole, whatever was found, and leave matplotlib as it was."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import Array, Detection, PointCloud
from retropole.base.errors import MissingExtraError
from retropole.extraction.poles import extract_poles
from retropole.report.figures import draw_detection, draw_result
from retropole.simulation import SimulatedPair, simulate_pair
from tests.tiers import first_of

pytestmark = pytest.mark.full

matplotlib = pytest.importorskip("matplotlib")


@pytest.fixture(scope="module")
def pair() -> SimulatedPair:
    return simulate_pair("street", np.random.default_rng(1), sensor_target="VLP-16")


def pixels(path: Path) -> Array:
    from PIL import Image

    assert path.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    return np.asarray(Image.open(path).convert("RGB"), dtype=float)


def near(image: Array, color: tuple[int, int, int]) -> int:
    return int(np.count_nonzero(np.abs(image - color).max(axis=2) < 12))


BLUE, ORANGE, GREEN = (0, 114, 178), (230, 159, 0), (0, 158, 115)
RED = (213, 94, 0)


def test_detection_shows_poles_and_what_was_rejected(pair: SimulatedPair, tmp_path: Path) -> None:
    found = extract_poles(pair.target)
    assert found.poles
    draw_detection(pair.target, found, tmp_path / "new" / "d.png", title="a scan")
    image = pixels(tmp_path / "new" / "d.png")
    assert image.shape[1] == 1600
    without = replace(found, poles=())
    draw_detection(pair.target, without, tmp_path / "without.png", title="a scan")
    assert near(image, BLUE) > near(pixels(tmp_path / "without.png"), BLUE) + 500
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["d.png"], "nothing half written"


@pytest.mark.parametrize(
    "case", first_of(["nothing bright", "nothing rejected", "far from its origin"])
)
def test_any_detection_can_be_drawn(case: str, pair: SimulatedPair, tmp_path: Path) -> None:
    cloud, found = pair.target, extract_poles(pair.target)
    if case == "nothing bright":
        found = Detection((), (), 1e9, "given", 0)
    elif case == "nothing rejected":
        found = replace(found, rejected=())
    else:
        T = se3.from_rt(np.eye(3), np.array([4e5, 5e6, 300.0]))
        cloud = replace(cloud.transformed(T), origin=np.zeros(3))
        found = extract_poles(cloud)
        assert found.poles
    draw_detection(cloud, found, tmp_path / "d.png", title=case)
    assert pixels(tmp_path / "d.png").std() > 5


def test_many_poles_are_drawn(pair: SimulatedPair, tmp_path: Path) -> None:
    found = extract_poles(pair.target)
    draw_detection(
        pair.target, replace(found, poles=found.poles * 20), tmp_path / "d.png", title="many"
    )
    assert pixels(tmp_path / "d.png").std() > 5


def test_result_shows_both_clouds_and_the_poles(pair: SimulatedPair, tmp_path: Path) -> None:
    ours, theirs = extract_poles(pair.target).poles, extract_poles(pair.source).poles
    count = min(len(ours), len(theirs))
    draw_result(
        pair.target,
        pair.source,
        pair.T_target_source,
        (ours[:count], theirs[:count]),
        tmp_path / "r.png",
    )
    image = pixels(tmp_path / "r.png")
    assert image.shape[1] == 1600
    assert all(near(image, color) > 200 for color in (BLUE, ORANGE, GREEN))
    draw_result(pair.target, pair.source, np.eye(4), ((), ()), tmp_path / "none.png")
    assert pixels(tmp_path / "none.png").std() > 5


def test_what_contradicts_the_result_is_red(pair: SimulatedPair, tmp_path: Path) -> None:
    line = np.c_[np.linspace(-9, 9, 200), np.zeros((200, 2))]
    nothing, poles = np.zeros((0, 3)), ((), ())
    seen: list[int] = []
    for points in (line, line + np.array([0.0, 500.0, 0.0]), nothing):
        path = tmp_path / f"{len(seen)}.png"
        T = pair.T_target_source
        draw_result(pair.target, pair.source, T, poles, path, contradicting=(points, nothing))
        seen.append(near(pixels(path), RED))
    assert seen[0] > 500
    assert max(seen[1:]) < 50


def test_same_input_gives_the_same_picture(pair: SimulatedPair, tmp_path: Path) -> None:
    found = extract_poles(pair.target)
    for name in ("a.png", "b.png"):
        draw_detection(pair.target, found, tmp_path / name, title="twice")
    np.testing.assert_array_equal(pixels(tmp_path / "a.png"), pixels(tmp_path / "b.png"))


def test_matplotlib_is_imported_late_and_its_state_left_alone() -> None:
    code = (
        "import sys, retropole.report.figures as f; assert 'matplotlib' not in sys.modules; "
        "f.new_figure(2, 2); assert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_missing_matplotlib_names_the_extra(
    monkeypatch: pytest.MonkeyPatch, pair: SimulatedPair, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.backends.backend_agg", None)
    cloud: PointCloud = pair.target
    with pytest.raises(MissingExtraError, match=r"retropole\[figures\]") as caught:
        draw_detection(cloud, extract_poles(cloud), tmp_path / "d.png", title="none")
    assert caught.value.extra == "figures"
    assert list(tmp_path.iterdir()) == []
