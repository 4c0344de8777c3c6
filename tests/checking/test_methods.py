"""The names of the methods are light: nothing is loaded to list them."""

import subprocess
import sys

import pytest

from retropole.checking import methods
from retropole.checking.methods import ALL_METHODS, OURS, RIVALS, missing_extra


def test_our_own_come_first_and_no_name_is_used_twice() -> None:
    assert (*OURS, *RIVALS) == ALL_METHODS
    assert len(set(ALL_METHODS)) == len(ALL_METHODS)


def test_listing_the_methods_loads_no_solver() -> None:
    heavy = ["numpy", "scipy", "small_gicp", "open3d", "kiss_matcher"]
    code = "import sys, retropole.checking.methods; print([m for m in %r if m in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-c", code % heavy], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"


def test_the_extra_is_missing_where_its_module_is_not_found(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(methods, "find_spec", lambda module: None)
    assert {name: missing_extra(name) for name in RIVALS} == {
        name: rival.extra for name, rival in RIVALS.items()
    }
