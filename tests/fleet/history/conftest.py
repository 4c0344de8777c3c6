from pathlib import Path

import pytest

from retropole.fleet.batch import calibrate_fleet
from retropole.fleet.sites import find_sites
from tests.fleet.fleets import here


@pytest.fixture(scope="session")
def answers(fleet: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    """Dataset of the small fleet."""
    out = str(tmp_path_factory.mktemp("answers"))
    calibrate_fleet(find_sites([str(fleet)]), out, here)
    return out


@pytest.fixture(scope="session")
def city(fleet: Path) -> Path:
    """The same sites, recorded at a known time."""
    lines = fleet.read_text().splitlines()
    path = fleet.with_name("tonight.csv")
    path.write_text(
        "".join(
            f"{line},{'time' if k == 0 else '2026-11-02T03:00'}\n" for k, line in enumerate(lines)
        )
    )
    return path
