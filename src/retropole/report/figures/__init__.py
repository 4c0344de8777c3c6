"""Pictures for people: what was detected in a cloud, and two clouds before and after."""

from .canvas import BLUE, GREEN, GREY, ORANGE, RED, new_figure, save_figure
from .detection import draw_detection
from .result import draw_result, result_figure

__all__ = [
    "BLUE",
    "GREEN",
    "GREY",
    "ORANGE",
    "RED",
    "draw_detection",
    "draw_result",
    "new_figure",
    "result_figure",
    "save_figure",
]
