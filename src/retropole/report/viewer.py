"""View clouds live: move the threshold, and see which poles are found and what is rejected.

The page is served to this machine alone (127.0.0.1), below an address that cannot be guessed, by
viser.
"""

from __future__ import annotations

import io
import re
import secrets
import threading
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, redirect_stdout
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..base.datatypes import Array, Detection, PointCloud, Pole
from ..base.errors import MissingExtraError, printable
from ..base.quantities import counted
from .viewer_access import guarded

if TYPE_CHECKING:
    import viser

HOST = "127.0.0.1"

DEBOUNCE_SECONDS = 0.15
"""Seconds that a slider has to rest before the poles are searched for again."""

MAX_DRAWN_POINTS = 300_000
"""Points of a cloud that are drawn; poles are searched for in all."""

SLIDER_STEPS = 400
"""Steps of the threshold slider, from the median intensity to the largest."""

MAX_LABELS, MAX_LINES = 40, 12
"""Rejected clusters that get a label in the scene, and a line in the panel: the largest ones."""

RETRO_COLOUR, POLE_COLOUR, REJECTED_COLOUR = (255, 196, 0), (0, 190, 110), (235, 75, 75)
"""Of retro-reflective points, of poles, and of rejected clusters."""


@dataclass(frozen=True, eq=False)
class Shown:
    """A cloud to view.

    Attributes
    ----------
    name
        What to call it, its file for example.
    cloud
        Points with intensity.
    find
        Finds the poles from a threshold up; None for the one that the sensor or the cloud has.
    threshold
        Where the slider starts; None as for `find`.
    """

    name: str
    cloud: PointCloud
    find: Callable[[float | None], Detection]
    threshold: float | None = None


@dataclass(frozen=True, eq=False)
class Viewer:
    """A running server, the secret part of its address, and of each cloud the slider and text."""

    server: viser.ViserServer
    token: str
    sliders: tuple[Any, ...]
    texts: tuple[Any, ...]

    @property
    def url(self) -> str:
        """Where the page is."""
        return f"http://{HOST}:{self.server.get_port()}/{self.token}/"

    def stop(self) -> None:
        """Stop serving."""
        with _silence():
            self.server.stop()


@dataclass(frozen=True)
class SliderRange:
    """Lowest and highest threshold of a slider, and its step, on the cloud's scale of intensity."""

    low: float
    high: float
    step: float


def slider_range(intensity: Array, threshold: float) -> SliderRange:
    """Span a slider from the median intensity to the largest, and to the threshold in any case."""
    low, high = np.quantile(intensity, [0.5, 1.0])
    low, high = min(float(low), threshold), max(float(high), threshold)
    step = 10.0 ** np.floor(np.log10((high - low) / SLIDER_STEPS)) if high > low else 1.0
    step = next(
        s for s in (step, 2 * step, 5 * step, 10 * step) if (high - low) / s <= SLIDER_STEPS
    )
    return SliderRange(float(np.floor(low / step) * step), float(np.ceil(high / step) * step), step)


def colours(intensity: Array, threshold: float) -> NDArray[np.uint8]:
    """Colour points (N,) → (N, 3): grey by intensity, yellow from the threshold up."""
    low, high = np.quantile(intensity, [0.01, 0.99])
    level = np.clip((intensity - low) / max(float(high - low), 1e-9), 0.0, 1.0)
    shaded = np.repeat((70 + 110 * np.sqrt(level))[:, None], 3, axis=1).astype(np.uint8)
    shaded[intensity >= threshold] = RETRO_COLOUR
    return shaded


def segments(poles: Sequence[Pole]) -> Array:
    """Both ends (K, 2, 3) of every pole."""
    ends = [pole.point + np.outer([-0.5, 0.5], pole.length * pole.direction) for pole in poles]
    return np.array(ends).reshape(-1, 2, 3)


def describe(detection: Detection) -> str:
    """Say what was found, as Markdown."""
    count = len(detection.poles)
    lines = [
        f"**{count} pole{'s' * (count != 1)}** in {detection.retro_points:,} bright points",
        "",
    ]
    lines += [
        f"- {k}: {counted(len(p.xyz), 'point')}, {counted(p.rings, 'ring')}, {p.length:.2f} m "
        f"long, "
        f"rms {1000 * p.rms:.0f} mm"
        for k, p in enumerate(detection.poles)
    ]
    if detection.rejected:
        by_code = Counter(r.code for r in detection.rejected).most_common()
        said = ", ".join(f"{number} × {_plain(code)}" for code, number in by_code)
        lines += ["", f"**{len(detection.rejected)} rejected:** {said}", ""]
        largest = _largest(detection)[:MAX_LINES]
        lines += [f"- ×{k}: {_plain(detection.rejected[k].reason)}" for k in largest]
        if len(detection.rejected) > MAX_LINES:
            lines += ["", f"The {MAX_LINES} largest are listed."]
    return "\n".join(lines)


def _plain(text: str) -> str:
    """Keep words from being read as Markdown, in which viser also takes HTML."""
    return re.sub(r"([\\`*{}\[\]<>&!#|~])", r"\\\1", text)


def debounced(action: Callable[[], None], wait: float = DEBOUNCE_SECONDS) -> Callable[[], None]:
    """Wrap an action so that it runs once, when no call has come for ``wait`` seconds."""
    one_at_a_time, scheduling = threading.Lock(), threading.Lock()
    timer: threading.Timer | None = None

    def run() -> None:
        with one_at_a_time:
            action()

    def request() -> None:
        nonlocal timer
        with scheduling:
            if timer is not None:
                timer.cancel()
            timer = threading.Timer(wait, run)
            timer.daemon = True
            timer.start()

    return request


def serve(shown: Sequence[Shown], *, port: int = 8080) -> Viewer:
    """Serve clouds with a threshold slider each, until the viewer's server is stopped.

    Parameters
    ----------
    shown
        The clouds; the first is visible at once, each in its own frame.
    port
        Port on 127.0.0.1; the next free one is taken where it is in use.

    Raises
    ------
    MissingExtraError
        Where viser is not installed.
    Refusal
        ``no_intensity``.
    """
    try:
        import viser
    except ImportError:
        raise MissingExtraError("view", "the live viewer") from None

    found = [each.find(each.threshold) for each in shown]
    token = secrets.token_urlsafe()
    with _silence(), guarded(token):
        server = viser.ViserServer(host=HOST, port=port, label="retropole view", verbose=False)
    # A page may ask viser to open a tunnel to a public address: nothing here leaves the machine.
    setattr(server, "request_share_url", lambda verbose=True: None)  # noqa: B010
    server.gui.configure_theme(
        dark_mode=True, show_logo=False, show_share_button=False, control_width="large"
    )
    server.gui.add_markdown(
        "Yellow: bright points. Green: poles. Red: rejected, with the reason. Move a threshold to "
        "search again."
    )
    parts = [_add(server, k, s, d) for k, (s, d) in enumerate(zip(shown, found, strict=True))]
    _look_at(server, shown[0].cloud, found[0])
    return Viewer(server, token, tuple(p[0] for p in parts), tuple(p[1] for p in parts))


def _silence() -> AbstractContextManager[object]:
    """Keep viser's greetings off stdout, which belongs to the caller."""
    return redirect_stdout(io.StringIO())


def _largest(detection: Detection) -> list[int]:
    """Order the rejected clusters by their points, the largest first."""
    return sorted(range(len(detection.rejected)), key=lambda k: -len(detection.rejected[k].index))


def _add(server: viser.ViserServer, number: int, shown: Shown, first: Detection) -> tuple[Any, Any]:
    """Add a cloud, its slider and its text; it is searched again when the slider rests."""
    cloud, intensity = shown.cloud, shown.cloud.intensity
    assert intensity is not None
    drawn = np.arange(len(cloud))
    if len(cloud) > MAX_DRAWN_POINTS:
        drawn = np.sort(
            np.random.default_rng(0).choice(len(cloud), MAX_DRAWN_POINTS, replace=False)
        )
    span = slider_range(intensity, first.threshold)
    root = f"/cloud{number}"
    frame = server.scene.add_frame(root, show_axes=False, visible=number == 0)
    # A file's name need not be text, and viser ends the connection at what is none.
    with server.gui.add_folder(printable(shown.name)):
        seen = server.gui.add_checkbox("Show", initial_value=number == 0)
        slider = server.gui.add_slider(
            "Threshold", span.low, span.high, span.step, initial_value=first.threshold
        )
        drawn_of = f"{len(drawn):,} of {len(cloud):,} points drawn; the threshold started "
        server.gui.add_markdown(
            f"{drawn_of}at {first.threshold:g} ({_plain(first.threshold_source)})."
        )
        text = server.gui.add_markdown(describe(first))
    points = server.scene.add_point_cloud(
        f"{root}/points",
        cloud.xyz[drawn].astype(np.float32),
        colours(intensity, first.threshold)[drawn],
        point_size=0.02,
        precision="float32",
        point_shading="flat",
    )
    server.scene.add_frame(f"{root}/sensor", axes_length=0.5, axes_radius=0.01)
    labels: list[Any] = []

    def show(detection: Detection) -> None:
        with server.atomic():
            points.colors = colours(intensity, detection.threshold)[drawn]
            while labels:
                labels.pop().remove()
            labels.extend(_marks(server, root, detection))
            text.content = describe(detection)

    def search() -> None:
        show(shown.find(float(slider.value)))

    search_soon = debounced(search)

    def slider_moved(_: Any) -> None:
        text.content = "Searching …"
        search_soon()

    def visibility_changed(_: Any) -> None:
        frame.visible = seen.value

    slider.on_update(slider_moved)
    seen.on_update(visibility_changed)
    show(first)
    return slider, text


def _marks(server: viser.ViserServer, root: str, detection: Detection) -> list[Any]:
    """Draw poles, and the largest rejected clusters with their reason."""
    marks: list[Any] = []
    if detection.poles:
        lines = segments(detection.poles)
        marks.append(
            server.scene.add_line_segments(f"{root}/poles", lines, POLE_COLOUR, thickness=0.06)
        )
        for k, pole in enumerate(detection.poles):
            top = max(lines[k], key=lambda end: float(end[2]))
            name, text = f"{root}/pole{k}", f"pole {k}: {counted(len(pole.xyz), 'point')}"
            marks.append(server.scene.add_label(name, text, position=tuple(top)))
    if detection.rejected:
        centres = np.array([r.centre for r in detection.rejected], dtype=np.float32)
        marks.append(
            server.scene.add_point_cloud(
                f"{root}/rejected",
                centres,
                REJECTED_COLOUR,
                point_size=0.12,
                point_shape="diamond",
                precision="float32",
            )
        )
        for k in _largest(detection)[:MAX_LABELS]:
            cluster = detection.rejected[k]
            name, text = f"{root}/rejected{k}", f"×{k} {cluster.code}"
            position = tuple(cluster.centre)
            marks.append(
                server.scene.add_label(name, text, position=position, font_screen_scale=0.7)
            )
    return marks


def _look_at(server: viser.ViserServer, cloud: PointCloud, detection: Detection) -> None:
    """Start behind the sensor and above, looking at its poles."""
    near = [p.point for p in detection.poles] or [cloud.origin + np.array([5.0, 0.0, 0.0])]
    middle = np.mean(near, axis=0)
    away = middle - cloud.origin
    away[2] = 0.0
    away = away / max(float(np.linalg.norm(away)), 1e-9)
    eye = cloud.origin - 6.0 * away + np.array([0.0, 0.0, 5.0])
    server.initial_camera.position = tuple(eye)
    server.initial_camera.look_at = tuple(middle)
