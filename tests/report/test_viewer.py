"""The live viewer: what it says and draws is what extraction finds, and it serves this machine."""

from __future__ import annotations

import importlib.util
import socket
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from retropole.base.datatypes import Array, PointCloud
from retropole.base.errors import MissingExtraError, Refusal
from retropole.extraction.poles import extract_poles
from retropole.report.viewer import (
    RETRO_COLOUR,
    SLIDER_STEPS,
    Shown,
    Viewer,
    colours,
    debounced,
    describe,
    segments,
    serve,
    slider_range,
)

HAS_VISER = importlib.util.find_spec("viser") is not None
needs_viser = pytest.mark.skipif(not HAS_VISER, reason="viser is not installed (extra 'view')")


def two_poles(dim: float = 120.0) -> PointCloud:
    """A wall, a bright pole and one whose tape returns ``dim``."""
    rng = np.random.default_rng(0)
    wall = np.c_[np.full(4000, 9.0), rng.uniform(-6, 6, 4000), rng.uniform(-1, 2, 4000)]
    parts, levels = [wall], [rng.uniform(5, 60, 4000)]
    for y, level in ((-1.0, 250.0), (1.0, dim)):
        z = np.repeat(np.linspace(-0.8, 0.8, 33), 4)
        jitter = 0.004 * rng.standard_normal((2, len(z)))
        parts.append(np.c_[5.0 + jitter[0], y + 0.1 * z + jitter[1], z])
        levels.append(np.full(len(z), level))
    return PointCloud(np.concatenate(parts), np.concatenate(levels))


def shown(name: str, cloud: PointCloud, threshold: float | None = None) -> Shown:
    """A cloud with what finds its poles."""
    return Shown(name, cloud, lambda level: extract_poles(cloud, threshold=level), threshold)


def wait_for(said: Callable[[], str], words: str) -> None:
    until = time.monotonic() + 20
    while words not in said():
        assert time.monotonic() < until, f"{words!r} never came, only {said()!r}"
        time.sleep(0.05)


@pytest.mark.parametrize(
    ("intensity", "threshold"),
    [
        (np.linspace(0, 255, 500), 200.0),
        (np.linspace(0, 1, 500), 0.75),
        (np.linspace(0, 65535, 500), 70_000.0),
        (np.array([0.0, 0, 0, 7]), 3.5),
        (np.full(5, 3.0), 3.0),
    ],
)
def test_slider_spans_threshold_and_brightest(intensity: Array, threshold: float) -> None:
    span = slider_range(intensity, threshold)
    assert span.low <= threshold <= span.high
    assert span.high >= intensity.max()
    assert span.step > 0
    assert (span.high - span.low) / span.step <= SLIDER_STEPS + 2


def test_bright_points_are_coloured() -> None:
    cloud = two_poles()
    assert cloud.intensity is not None
    for threshold in (100.0, 200.0):
        is_retro = (colours(cloud.intensity, threshold) == RETRO_COLOUR).all(axis=1)
        assert np.array_equal(is_retro, cloud.intensity >= threshold)


def test_threshold_decides_which_poles_are_said_and_drawn() -> None:
    cloud = two_poles()
    for threshold, count in ((200.0, 1), (100.0, 2), (254.0, 0)):
        found = extract_poles(cloud, threshold=threshold)
        assert f"**{count} pole" in describe(found)
        lines = segments(found.poles)
        assert lines.shape == (count, 2, 3)
        lengths = np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1)
        assert np.allclose(lengths, [p.length for p in found.poles])


def test_rejected_clusters_are_said_with_their_reason() -> None:
    found = extract_poles(two_poles(), threshold=40.0)
    assert found.rejected
    assert f"**{len(found.rejected)} rejected:**" in describe(found)
    assert max(found.rejected, key=lambda r: len(r.index)).reason in describe(found)


def test_debounced_runs_once_after_the_last_call() -> None:
    runs: list[float] = []
    done = threading.Event()

    def action() -> None:
        runs.append(time.monotonic())
        done.set()

    ask = debounced(action, 0.2)
    for _ in range(20):
        ask()
    assert done.wait(10)
    time.sleep(0.3)
    assert len(runs) == 1


@pytest.mark.skipif(HAS_VISER, reason="viser is installed")
def test_without_viser_the_extra_is_named() -> None:
    with pytest.raises(MissingExtraError, match=r"retropole\[view\]"):
        serve([shown("x", two_poles())])


@needs_viser
def test_no_intensity_is_refused() -> None:
    with pytest.raises(Refusal, match="no intensity"):
        serve([shown("x", PointCloud(np.ones((5, 3))))])


@pytest.fixture
def viewer() -> Iterator[Viewer]:
    clouds = shown("<script>a</script>", two_poles(), 200.0), shown("b", two_poles(90.0))
    viewer = serve(clouds, port=8950)
    yield viewer
    viewer.stop()


@needs_viser
def test_serves_this_machine_alone(viewer: Viewer) -> None:
    assert viewer.server.get_host() == "127.0.0.1"
    with urllib.request.urlopen(viewer.url, timeout=20) as answer:
        assert answer.status == 200
        assert b"<html" in answer.read().lower()
    other = socket.socket()
    other.settimeout(2)
    with other, pytest.raises(OSError, match=r"refused|timed out"):
        other.connect(("127.0.0.2", viewer.server.get_port()))


@needs_viser
def test_moving_the_slider_searches_again(viewer: Viewer) -> None:
    slider, text = viewer.sliders[0], viewer.texts[0]
    assert "**1 pole**" in text.content
    slider.value = 100.0
    wait_for(lambda: text.content, "**2 poles**")
    slider.value = 253.0
    wait_for(lambda: text.content, "**0 poles**")
    assert "**2 poles**" in viewer.texts[1].content or "**1 pole**" in viewer.texts[1].content


@needs_viser
def test_opens_no_tunnel(viewer: Viewer) -> None:
    assert viewer.server.request_share_url() is None
