"""Every example runs as it stands, says something, and is short."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.paths import ROOT

EXAMPLES = ROOT / "examples"
SCRIPTS = sorted(EXAMPLES.glob("*.py"))
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


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda p: p.stem)
def test_example_runs(script: Path, tmp_path: Path) -> None:
    if script.stem in ("draw_result", "plot_placement"):
        pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    words = OTHERS.get(script.stem, ["--out", "made"])
    assert len(run([str(script), *words], tmp_path)) > 10
    assert any(tmp_path.rglob("*.*"))


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda p: p.stem)
def test_example_is_short(script: Path) -> None:
    lines = [line for line in script.read_text(encoding="utf-8").splitlines() if line.strip()]
    assert len(lines) <= MAX_LINES
    assert lines[0].startswith('"""')


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
