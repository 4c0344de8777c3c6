"""Calibrate LiDARs to each other with poles wrapped in retro-reflective tape.

    import retropole as rp

    result = rp.calibrate("target.pcd", "source.pcd")
    result.save("retropole-out")

Names are looked up when they are first used: importing the package takes no time. Read
`retropole.pipeline` first to see the method on one page.
"""

from importlib import import_module

from .base.version import __version__

# Type checkers know the name; to import typing takes longer than all the rest.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from .api.calibration import calibrate, calibrate_site
    from .api.detection import detect
    from .api.evaluation import evaluate
    from .api.planning import plan
    from .api.result import CalibrationResult, SiteResult, load_result, load_site_result
    from .api.simulation import simulate
    from .base.datatypes import PointCloud
    from .base.errors import MissingExtraError, ReadError, Refusal, RetropoleError, UsageError
    from .io import read_cloud
    from .result import RunConfig

_MODULES = {
    "CalibrationResult": "api.result",
    "MissingExtraError": "base.errors",
    "PointCloud": "base.datatypes",
    "ReadError": "base.errors",
    "Refusal": "base.errors",
    "RetropoleError": "base.errors",
    "RunConfig": "result",
    "SiteResult": "api.result",
    "UsageError": "base.errors",
    "calibrate": "api.calibration",
    "calibrate_site": "api.calibration",
    "detect": "api.detection",
    "evaluate": "api.evaluation",
    "load_result": "api.result",
    "load_site_result": "api.result",
    "plan": "api.planning",
    "read_cloud": "io",
    "simulate": "api.simulation",
}
"""From a public name to the module that has it."""

__all__ = [
    "CalibrationResult",
    "MissingExtraError",
    "PointCloud",
    "ReadError",
    "Refusal",
    "RetropoleError",
    "RunConfig",
    "SiteResult",
    "UsageError",
    "__version__",
    "calibrate",
    "calibrate_site",
    "detect",
    "evaluate",
    "load_result",
    "load_site_result",
    "plan",
    "read_cloud",
    "simulate",
]


def __getattr__(name: str) -> object:
    """Import what a public name refers to, once."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f".{_MODULES[name]}", __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """List the public names, used yet or not."""
    return sorted(__all__)
