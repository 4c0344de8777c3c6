"""One site for all tests: simulated and adjusted once, without and with a survey."""

import pytest

from retropole.adjustment.answer import SiteCalibration
from retropole.pipeline import calibrate_site
from retropole.simulation.sites import SimulatedSite, Survey
from tests.adjustment.adjusting import Steps, made, steps_of


@pytest.fixture(scope="session")
def simulated() -> SimulatedSite:
    """Three LiDARs, two placements of three poles; nothing is surveyed."""
    return made()


@pytest.fixture(scope="session")
def steps(simulated: SimulatedSite) -> Steps:
    return steps_of(simulated.as_site())


@pytest.fixture(scope="session")
def found(simulated: SimulatedSite) -> SiteCalibration:
    return calibrate_site(simulated.as_site())


@pytest.fixture(scope="session")
def simulated_survey() -> SimulatedSite:
    """The same with the poles of one placement and four control points surveyed."""
    return made(survey=Survey((0,), 4))


@pytest.fixture(scope="session")
def surveyed(simulated_survey: SimulatedSite) -> Steps:
    return steps_of(simulated_survey.as_site())


@pytest.fixture(scope="session")
def pair_site() -> SimulatedSite:
    """Two LiDARs and one placement of three poles: a pair."""
    return made(seed=1, lidars=2, placements=1)


@pytest.fixture(scope="session")
def pair_steps(pair_site: SimulatedSite) -> Steps:
    return steps_of(pair_site.as_site())
