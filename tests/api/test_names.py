"""What ``import retropole as rp`` gives, and that it costs nothing until it is used."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import retropole as rp
import retropole.api
from tests.paths import PACKAGE

MAX_SECONDS = 0.1
"""Of the import of the package alone."""


def test_every_name_is_there() -> None:
    assert set(rp.__all__) == {*retropole.api.__all__, "__version__"}
    assert dir(rp) == sorted(rp.__all__)
    for name in retropole.api.__all__:
        assert getattr(rp, name) is getattr(retropole.api, name)


def test_a_type_checker_sees_the_same_names() -> None:
    tree = ast.parse((PACKAGE / "__init__.py").read_text())
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    (names,) = (node for node in block.body if isinstance(node, ast.ImportFrom))
    assert {alias.name for alias in names.names} == set(retropole.api.__all__)


def test_other_names_are_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="'retropole' has no attribute 'calibrated'"):
        _ = rp.calibrated


def test_importing_alone_is_quick_and_loads_nothing() -> None:
    code = (
        "import sys, time; before = set(sys.modules); start = time.perf_counter(); "
        "import retropole; seconds = time.perf_counter() - start; "
        "new = {m.partition('.')[0] for m in set(sys.modules) - before}; "
        "print(seconds, *sorted(new - set(sys.stdlib_module_names)))"
    )
    outcomes = []
    for _ in range(3):
        done = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True
        )
        seconds, *loaded = done.stdout.split()
        outcomes.append(float(seconds))
        assert loaded == ["retropole"]
    assert min(outcomes) <= MAX_SECONDS


def test_reading_does_not_load_the_method(tmp_path: Path) -> None:
    (tmp_path / "a.xyz").write_text("1 2 3\n")
    code = (
        f"import sys, retropole as rp; assert len(rp.read_cloud({str(tmp_path / 'a.xyz')!r})) == 1;"
        "print([m for m in ('retropole.pipeline', 'retropole.report') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_the_interface_leaves_heavy_parts_alone() -> None:
    heavy = ["matplotlib", "laspy", "rich", "pandas", "scipy.stats", "viser", "rosbags", "yaml"]
    code = f"import sys, retropole.api; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
