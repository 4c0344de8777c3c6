"""Sites whose steps are tested here are those of `tests/site`."""

from tests.site.conftest import (  # noqa: F401
    pair_site,
    pair_steps,
    simulated,
    simulated_survey,
    steps,
    surveyed,
)
