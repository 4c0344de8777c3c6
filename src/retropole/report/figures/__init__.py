"""Pictures for people: what was detected in a cloud, and two clouds before and after."""

from .canvas import BLUE as BLUE
from .canvas import GREEN as GREEN
from .canvas import GREY as GREY
from .canvas import ORANGE as ORANGE
from .canvas import RED as RED
from .canvas import for_notebooks as for_notebooks
from .canvas import new_figure as new_figure
from .canvas import save_figure as save_figure
from .detection import draw_detection as draw_detection
from .result import draw_result as draw_result
from .result import result_figure as result_figure
from .site import site_figure as site_figure
