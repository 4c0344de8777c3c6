"""The names of the methods are light: nothing is loaded to list them."""

import subprocess
import sys

from retropole.evaluation.rivals import ALL_METHODS, OURS, RIVALS


def test_our_own_come_first_and_no_name_is_used_twice() -> None:
    assert (*OURS, *RIVALS) == ALL_METHODS
    assert len(set(ALL_METHODS)) == len(ALL_METHODS)


def test_listing_the_methods_loads_no_solver() -> None:
    heavy = ["numpy", "scipy", "small_gicp", "open3d", "kiss_matcher"]
    code = "import sys, retropole.evaluation.rivals; print([m for m in %r if m in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-c", code % heavy], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"
