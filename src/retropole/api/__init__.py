"""What ``import retropole as rp`` gives: the steps for users, from paths, arrays or clouds.

`retropole` itself looks these names up when they are used, so that importing it costs nothing.
"""

from ..datatypes import PointCloud
from ..errors import MissingExtraError, ReadError, Refusal, RetropoleError, UsageError
from ..io import read_cloud
from .calibration import calibrate
from .detection import detect
from .evaluation import evaluate
from .result import CalibrationResult, load_result
from .simulation import simulate

__all__ = [
    "CalibrationResult",
    "MissingExtraError",
    "PointCloud",
    "ReadError",
    "Refusal",
    "RetropoleError",
    "UsageError",
    "calibrate",
    "detect",
    "evaluate",
    "load_result",
    "read_cloud",
    "simulate",
]
