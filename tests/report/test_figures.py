"""Pictures for notebooks are whole, whatever was found, and leave matplotlib as it was."""

import io
import subprocess
import sys
from collections.abc import Sequence

import numpy as np
import pytest

from retropole.base.datatypes import Array, Pole
from retropole.base.errors import MissingExtraError
from retropole.extraction.poles import extract_poles
from retropole.report.figures import result_figure
from retropole.simulation import SimulatedPair, simulate_pair

pytestmark = pytest.mark.full

matplotlib = pytest.importorskip("matplotlib")


@pytest.fixture(scope="module")
def pair() -> SimulatedPair:
    return simulate_pair("street", np.random.default_rng(1), sensor_target="VLP-16")


def pixels(
    pair: SimulatedPair,
    T: Array,
    poles: tuple[Sequence[Pole], Sequence[Pole]] = ((), ()),
    contradicting: tuple[Array, Array] | None = None,
) -> Array:
    """The picture as a notebook has it."""
    from PIL import Image

    figure = result_figure(pair.target, pair.source, T, poles, contradicting=contradicting)
    png: bytes = figure._repr_png_()  # type: ignore[attr-defined]
    assert png[:8] == b"\x89PNG\r\n\x1a\n"
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"), dtype=float)


def near(image: Array, color: tuple[int, int, int]) -> int:
    return int(np.count_nonzero(np.abs(image - color).max(axis=2) < 12))


BLUE, ORANGE, GREEN, RED = (0, 114, 178), (230, 159, 0), (0, 158, 115), (213, 94, 0)


def test_result_shows_both_clouds_and_the_poles(pair: SimulatedPair) -> None:
    ours, theirs = extract_poles(pair.target).poles, extract_poles(pair.source).poles
    count = min(len(ours), len(theirs))
    image = pixels(pair, pair.T_target_source, (ours[:count], theirs[:count]))
    assert image.shape[1] == 1600
    assert all(near(image, color) > 200 for color in (BLUE, ORANGE, GREEN))
    assert pixels(pair, np.eye(4)).std() > 5


def test_what_contradicts_the_result_is_red(pair: SimulatedPair) -> None:
    line = np.c_[np.linspace(-9, 9, 200), np.zeros((200, 2))]
    nothing = np.zeros((0, 3))
    seen = [
        near(pixels(pair, pair.T_target_source, contradicting=(points, nothing)), RED)
        for points in (line, line + np.array([0.0, 500.0, 0.0]), nothing)
    ]
    assert seen[0] > 500
    assert max(seen[1:]) < 50


def test_matplotlib_is_imported_late_and_its_state_left_alone() -> None:
    code = (
        "import sys, retropole.report.figures as f; assert 'matplotlib' not in sys.modules; "
        "f.new_figure(2, 2); assert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_missing_matplotlib_names_the_extra(
    monkeypatch: pytest.MonkeyPatch, pair: SimulatedPair
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.backends.backend_agg", None)
    with pytest.raises(MissingExtraError, match=r"retropole\[figures\]") as caught:
        result_figure(pair.target, pair.source, np.eye(4), ((), ()))
    assert caught.value.extra == "figures"
