"""The tables and figures of Xue et al. 2019, reproduced, with the paper's figures beside ours."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

from ...files import write_atomically
from ...quantities import step_of
from ...report.figures import new_figure, save_figure
from .beams import two_matlab
from .choosing import choosing
from .comparing import comparing_real, comparing_simulated
from .equations import arc_points, arc_walk, transforms
from .estimator import simulated_error
from .exhibit import Exhibit
from .failures import failures
from .line_bias import line_bias
from .starts import eight_starts
from .thresholds import thresholds
from .trials import pole_lengths, ten_trials
from .tried import table_two_tried

__all__ = ["Exhibit", "reproduce", "write_exhibit"]

SET_UPS_PER_SEED = 2
"""Of the simulated error: it has a long tail, and a set-up takes little time."""

SEEDS_PER_SLOW_SCENE = 5
"""Of the experiments that take seconds for each scene."""


def reproduce(
    seeds: int,
    data: Path | None,
    progress: Callable[[str], None] = lambda step: None,
) -> list[Exhibit]:
    """Run every experiment of the paper.

    Parameters
    ----------
    seeds
        Number of simulated scenes of each experiment that draws any; `SET_UPS_PER_SEED` and
        `SEEDS_PER_SLOW_SCENE` scale it.
    data
        Folder of the real recordings; None leaves these out.
    progress
        Called with the name of each experiment as it starts, and which of how many it is.
    """
    few = max(seeds // SEEDS_PER_SLOW_SCENE, 1)
    runs: list[tuple[str, Callable[[], Iterable[Exhibit]]]] = [
        ("Table I", lambda: [thresholds()]),
        ("Equations 3 to 5", lambda: [arc_points(), arc_walk()]),
        ("Section IV-A", lambda: [transforms()]),
        ("Figure two_matlab", lambda: [two_matlab()]),
        ("Table II", lambda: [line_bias(), table_two_tried()]),
        ("Fig. 4", lambda: [eight_starts(seeds)]),
        ("simulated e_rt", lambda: [simulated_error(SET_UPS_PER_SEED * seeds)]),
        ("simulated error, ten trials", lambda: [ten_trials(few)]),
        ("simulated error, pole length", lambda: [pole_lengths(seeds)]),
        ("Table III", lambda: choosing(seeds)),
        ("Sec. V", lambda: [failures(few)]),
        ("Table IV, simulated", lambda: comparing_simulated(few)),
    ]
    if data is not None:
        runs.append(("Table IV, recorded", lambda: [comparing_real(data)]))
    made: list[Exhibit] = []
    for k, (name, run) in enumerate(runs, 1):
        progress(step_of(name, k, len(runs)))
        made += run()
    return made


def write_exhibit(exhibit: Exhibit, out: Path) -> list[Path]:
    """Write an exhibit's table as ``.md`` and ``.csv``, its figure as ``.png`` and ``.svg``.

    Raises
    ------
    MissingExtraError
        Where it has a figure and matplotlib is not installed.
    """
    written = [out / f"{exhibit.name}.md", out / f"{exhibit.name}.csv"]
    write_atomically(written[0], exhibit.markdown().encode())
    write_atomically(written[1], exhibit.csv().encode())
    if exhibit.draw is not None:
        figure = new_figure(*exhibit.size)
        exhibit.draw(figure)
        for suffix in ("png", "svg"):
            written.append(out / f"{exhibit.name}.{suffix}")
            save_figure(figure, written[-1])
    return written
