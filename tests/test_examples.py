"""Every example runs as it stands, says something, and is short."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.paths import ROOT

EXAMPLES = ROOT / "examples"
SCRIPTS = sorted(EXAMPLES.glob("*.py"))
OTHERS = {"draw_result": ["result.png"]}
"""What those take that have no ``--out``."""


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda p: p.stem)
def test_example_runs(script: Path, tmp_path: Path) -> None:
    if script.stem in ("draw_result", "plot_placement"):
        pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    words = OTHERS.get(script.stem, ["--out", "made"])
    done = subprocess.run(
        [sys.executable, str(script), *words], capture_output=True, text=True, cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert len(done.stdout) > 10
    if words:
        assert any(tmp_path.rglob("*.*"))


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda p: p.stem)
def test_example_is_short(script: Path) -> None:
    lines = [line for line in script.read_text(encoding="utf-8").splitlines() if line.strip()]
    assert len(lines) <= 50
    assert lines[0].startswith('"""')
