"""Every example runs as it stands, says something, and is short."""

from __future__ import annotations

import json
import re
import runpy
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from retropole.export.recording import TOPICS
from tests.paths import ROOT
from tests.tiers import first_of

pytestmark = pytest.mark.full

EXAMPLES = ROOT / "examples"
LAUNCH_FILES = sorted(EXAMPLES.glob("*.launch.py"))
SCRIPTS = sorted(set(EXAMPLES.glob("*.py")) - set(LAUNCH_FILES))
NOTEBOOKS = sorted(EXAMPLES.glob("*.ipynb"))
OTHERS = {"draw_result": ["result.png"]}
"""What those take that have no ``--out``."""

MAX_LINES = 50
"""Of an example, blank ones aside."""


def run(words: list[str], folder: Path) -> str:
    """Run Python in a folder; give what it printed."""
    done = subprocess.run([sys.executable, *words], capture_output=True, text=True, cwd=folder)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return done.stdout


FIRST = "calibrate"
"""The example that runs by default; the others in the full tier."""


@pytest.mark.parametrize(
    "script",
    first_of(sorted(SCRIPTS, key=lambda p: p.stem != FIRST)),
    ids=lambda p: p.stem,
)
def test_example_runs(script: Path, tmp_path: Path) -> None:
    if script.stem in ("draw_result", "plot_placement"):
        pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    words = OTHERS.get(script.stem, ["--out", "made"])
    assert len(run([str(script), *words], tmp_path)) > 10
    assert any(tmp_path.rglob("*.*"))


@pytest.mark.parametrize("script", [*SCRIPTS, *LAUNCH_FILES], ids=lambda p: p.stem)
def test_example_is_short(script: Path) -> None:
    lines = [line for line in script.read_text(encoding="utf-8").splitlines() if line.strip()]
    assert len(lines) <= MAX_LINES
    assert lines[0].startswith('"""')


class Action:
    """What stands for any class of ROS 2's launch: it keeps what it is made of."""

    def __init__(self, *given: Any, **named: Any) -> None:
        self.given, self.named = given, named


@pytest.mark.parametrize("launch_file", LAUNCH_FILES, ids=lambda p: p.stem)
def test_launch_file_is_made_as_ros_2_would(
    launch_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # ROS 2 is not on PyPI. Names and arguments are its own; what they do, only ROS 2 can tell.
    modules = ("actions", "conditions", "launch_description_sources", "substitutions")
    for name in ("launch", "launch_ros", "launch_ros.actions", *(f"launch.{m}" for m in modules)):
        module: Any = ModuleType(name)
        module.__getattr__ = lambda wanted: type(wanted, (Action,), {})
        monkeypatch.setitem(sys.modules, name, module)
    made = runpy.run_path(str(launch_file))["generate_launch_description"]().given[0]
    kinds = [type(action).__name__ for action in made]
    assert {"IncludeLaunchDescription", "ExecuteProcess", "Node"} <= set(kinds)
    declared = {action.given[0] for action in made if type(action).__name__.startswith("Declare")}
    used = set(re.findall(r'LaunchConfiguration\("(\w+)"\)', launch_file.read_text()))
    assert used == declared
    (played,) = [action for action in made if type(action).__name__ == "ExecuteProcess"]
    assert set(TOPICS.values()) <= {word for word in played.named["cmd"] if isinstance(word, str)}


def cells_of(notebook: Path) -> list[dict[str, Any]]:
    cells: list[dict[str, Any]] = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    return cells


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda p: p.stem)
def test_notebook_runs_cell_by_cell(notebook: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    cells = ["".join(cell["source"]) for cell in cells_of(notebook) if cell["cell_type"] == "code"]
    assert cells
    # As a kernel does: all cells in one namespace.
    kernel = "import json, sys\nfor cell in json.load(sys.stdin):\n    exec(cell, globals())\n"
    (tmp_path / "kernel.py").write_text(kernel)
    done = subprocess.run(
        [sys.executable, "kernel.py"],
        input=json.dumps(cells),
        capture_output=True,
        text=True,
        cwd=tmp_path,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert any(tmp_path.rglob("report.html"))


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda p: p.stem)
def test_notebook_is_sound_and_holds_no_outputs(notebook: Path) -> None:
    document = json.loads(notebook.read_text(encoding="utf-8"))
    assert (document["nbformat"], document["nbformat_minor"]) == (4, 5)
    assert {"kernelspec", "language_info"} <= document["metadata"].keys()
    cells = cells_of(notebook)
    assert len({cell["id"] for cell in cells}) == len(cells)
    for cell in cells:
        code = {"execution_count", "outputs"} if cell["cell_type"] == "code" else set()
        assert cell.keys() == {"cell_type", "id", "metadata", "source"} | code
        assert not cell.get("outputs")
        assert cell.get("execution_count") is None
    shown = [cell for cell in cells if cell["cell_type"] == "code"]
    assert sum(len(cell["source"]) for cell in shown) <= MAX_LINES
    assert "".join(cells[0]["source"]).startswith("# ")
