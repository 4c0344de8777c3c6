"""Imports point one way: data classes, steps, pipeline, then report and command line."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "src" / "retropole"
LAYERS = [
    {"datatypes", "errors", "se3", "files"},
    {
        *("io", "sensors", "extraction", "frames", "correspondence", "prior", "placements"),
        *("alignment", "beams", "pole_beams", "beam_model", "beam_alignment"),
        *("disambiguation", "registration", "refinement", "patches", "uncertainty"),
        *("verdict", "evaluation", "simulation", "figures", "clustering", "pole_test"),
        *("rivals", "recording", "viewer"),
    },
    {"pipeline"},
    {"result", "check", "comparison"},
    {"export"},
    {"summary", "report", "paper"},
    {"cli", "__main__"},
]


def layer_of(module: str) -> int:
    for level, names in enumerate(LAYERS):
        if module in names:
            return level
    raise AssertionError(f"{module} has no layer: give it one in this test")


def imported_modules(path: Path) -> set[str]:
    """Name the top modules of the package that a file imports."""
    depth = len(path.relative_to(PACKAGE).parts)
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level == depth:
            names |= {node.module.split(".")[0]} if node.module else {a.name for a in node.names}
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("retropole."):
            names.add((node.module or "").split(".")[1])
    return names - {"__version__"}


FILES = [p for p in sorted(PACKAGE.rglob("*.py")) if p != PACKAGE / "__init__.py"]


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_point_one_way(path: Path) -> None:
    own = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
    for name in imported_modules(path):
        assert layer_of(name) <= layer_of(own), f"{own} imports {name}"


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_modules_stay_small(path: Path) -> None:
    assert len(path.read_text().splitlines()) <= 360


def test_import_leaves_heavy_parts_alone() -> None:
    heavy = ["matplotlib", "laspy", "pypcd4", "rich", "pandas", "scipy.stats", "viser"]
    heavy += ["scipy.optimize", "rosbags", "mcap", "yaml"]
    ours = "import sys, retropole.pipeline, retropole.cli, retropole.report"
    code = f"{ours}; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
