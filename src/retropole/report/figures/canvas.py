"""Figures of matplotlib (the extra ``figures``) on a canvas of their own: no window, no pyplot.

Matplotlib is imported where a figure is made.
"""

from __future__ import annotations

import io
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from ...base.errors import MissingExtraError
from ...base.files import write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure

GREY, BLUE, ORANGE, RED, GREEN = "#9aa0a6", "#0072b2", "#e69f00", "#d55e00", "#009e73"
"""Okabe and Ito's colours, which colour-blind readers tell apart."""

MAX_FIGURE_POINTS = 40_000
"""Points of a cloud that are drawn."""


def new_figure(width: float, height: float) -> Figure:
    """Make an empty figure, inches, on a canvas of its own: no window, no state of pyplot's.

    Raises
    ------
    MissingExtraError
        Where matplotlib is not installed.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        raise MissingExtraError("figures", "drawing pictures") from None
    figure = Figure(figsize=(width, height), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure in the format of the path's suffix."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format=path.suffix.lstrip(".") or "png")
    write_atomically(path, buffer.getvalue())


def for_notebooks(figure: Figure) -> Figure:
    """Have a notebook draw a figure: by itself it does so only where pyplot was imported."""
    setattr(figure, "_repr_png_", partial(_png, figure))  # noqa: B010
    return figure


def _png(figure: Figure) -> bytes:
    picture = io.BytesIO()
    figure.savefig(picture, format="png")
    return picture.getvalue()
