from pathlib import Path

import pytest

from tests.fleet.fleets import write_fleet
from tests.report.conftest import browser, phone

__all__ = ["browser", "phone"]

pytest.importorskip("distributed", reason="needs the extra fleet")
pytest.importorskip("pyarrow", reason="needs the extra fleet")


@pytest.fixture(scope="session")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """List of a small fleet; whoever changes a file takes a copy."""
    return write_fleet(tmp_path_factory.mktemp("fleet"))
