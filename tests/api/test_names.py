"""What ``import retropole as rp`` gives, and that it loads nothing until it is used."""

import ast
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import retropole as rp
from tests.paths import PACKAGE


def test_every_name_is_there() -> None:
    assert dir(rp) == sorted(rp.__all__)
    for name in rp.__all__:
        assert getattr(rp, name) is not None


def test_a_type_checker_sees_the_names_where_they_are() -> None:
    tree = ast.parse((PACKAGE / "__init__.py").read_text())
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    seen = {
        alias.name: getattr(import_module(f"retropole.{node.module}"), alias.name)
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert {*seen, "__version__"} == set(rp.__all__)
    for name, thing in seen.items():
        assert getattr(rp, name) is thing


def test_other_names_are_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="'retropole' has no attribute 'calibrated'"):
        _ = rp.calibrated


def test_importing_alone_loads_nothing() -> None:
    code = (
        "import sys; before = set(sys.modules); import retropole; "
        "new = {m.partition('.')[0] for m in set(sys.modules) - before}; "
        "print(*sorted(new - set(sys.stdlib_module_names)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["retropole"]


def test_reading_does_not_load_the_method(tmp_path: Path) -> None:
    (tmp_path / "a.xyz").write_text("1 2 3\n")
    code = (
        f"import sys, retropole as rp; assert len(rp.read_cloud({str(tmp_path / 'a.xyz')!r})) == 1;"
        "print([m for m in ('retropole.pipeline', 'retropole.report') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.full
def test_the_interface_leaves_heavy_parts_alone() -> None:
    heavy = ["matplotlib", "laspy", "rich", "pandas", "scipy.stats", "rosbags", "yaml"]
    code = (
        "import sys, retropole as rp; rp.calibrate, rp.evaluate; "
        f"print([m for m in {heavy} if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
