"""Where the tests find the project, and the recordings beside it."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "src" / "retropole"
SHARED = ROOT.parent / "shared" / "data"
