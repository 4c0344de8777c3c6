"""The tables and figures of Xue et al. 2019, reproduced, with the paper's figures beside ours."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from retropole.base.files import write_atomically
from retropole.base.quantities import step_of
from retropole.report.figures import new_figure
from studies.paper.beams import two_matlab
from studies.paper.choosing import choosing
from studies.paper.comparing import comparing_real, comparing_simulated
from studies.paper.equations import arc_points, arc_walk, transforms
from studies.paper.estimator import simulated_error
from studies.paper.exhibit import Exhibit
from studies.paper.failures import failures
from studies.paper.line_bias import line_bias
from studies.paper.norms import simulated_norms
from studies.paper.starts import eight_starts
from studies.paper.thresholds import thresholds
from studies.paper.trials import pole_lengths, ten_trials
from studies.paper.tried import table_two_tried

__all__ = ["Exhibit", "Experiment", "experiments", "reproduce", "write_exhibit"]

SET_UPS_PER_SEED = 2
"""Of the simulated error: it has a long tail, and a set-up takes little time."""

SLOW_SCENES, SEEDS_PER_SLOW_SCENE = 20, 5
"""Experiments that take seconds for each scene run on so many of the seeds that are asked for, or
on one in so many of them where that is more."""


class Experiment(NamedTuple):
    """What is run at once.

    Attributes
    ----------
    title
        What of the paper it reproduces.
    names
        Of the exhibits that it makes, in their order.
    run
        Makes them.
    scenes
        How many scenes it draws where these are fewer than the seeds; else None.
    """

    title: str
    names: tuple[str, ...]
    run: Callable[[], Iterable[Exhibit]]
    scenes: int | None = None


def experiments(seeds: int, data: Path | None) -> list[Experiment]:
    """List every experiment of the paper, without running any.

    Parameters
    ----------
    seeds
        Number of simulated scenes of each experiment that draws any; where a set-up takes little
        time `SET_UPS_PER_SEED` times as many, where it takes seconds `SLOW_SCENES` of many.
    data
        Folder of the real recordings; None leaves these out.
    """
    few = max(min(seeds, SLOW_SCENES), seeds // SEEDS_PER_SLOW_SCENE)
    told = few if few < seeds else None
    set_ups = SET_UPS_PER_SEED * seeds
    listed = [
        Experiment("Table I", ("table1_sensors",), lambda: [thresholds()]),
        Experiment("Equations 3 and 4, points", ("eq3_4_points",), lambda: [arc_points()]),
        Experiment("Equations 3 and 4", ("eq3_4_arc_walk",), lambda: [arc_walk()]),
        Experiment("Section IV-A", ("sec4a_transforms",), lambda: [transforms()]),
        Experiment("Fig. 5", ("two_matlab",), lambda: [two_matlab()]),
        Experiment("Table II", ("table2_line_bias",), lambda: [line_bias()]),
        Experiment("Table II, tried", ("table2_tried",), lambda: [table_two_tried()]),
        Experiment("Fig. 4", ("fig4_hypotheses",), lambda: [eight_starts(seeds)]),
        Experiment("simulated e_rt", ("simulated_e_rt",), lambda: [simulated_error(set_ups)]),
        Experiment(
            "simulated error, plain norms",
            ("simulated_norms",),
            lambda: [simulated_norms(set_ups)],
        ),
        Experiment(
            "simulated error, ten trials", ("simulated_trials",), lambda: [ten_trials(few)], told
        ),
        Experiment(
            "simulated error, pole length",
            ("simulated_pole_length",),
            lambda: [pole_lengths(seeds)],
        ),
        Experiment(
            "Table III", ("table3_four_result", "table3_how_often"), lambda: choosing(seeds)
        ),
        Experiment("weaknesses", ("weaknesses",), lambda: [failures(few)], told),
        Experiment(
            "Table IV, simulated",
            ("table4_comparing", "table4_order", "table4_corridors"),
            lambda: comparing_simulated(few),
            told,
        ),
    ]
    if data is not None:
        listed.append(
            Experiment("Table IV, recorded", ("table4_recorded",), lambda: [comparing_real(data)])
        )
    return listed


def reproduce(
    seeds: int,
    data: Path | None,
    progress: Callable[[str], None] = lambda step: None,
    *,
    only: Sequence[str] = (),
) -> list[Exhibit]:
    """Run the experiments of the paper.

    Parameters
    ----------
    seeds, data
        As in `experiments`.
    progress
        Called with the title of each experiment as it starts, and which of how many it is.
    only
        Exhibits whose name contains one of these are made, and no others; none makes all.
    """

    def is_wanted(name: str) -> bool:
        return not only or any(part in name for part in only)

    wanted = [each for each in experiments(seeds, data) if any(map(is_wanted, each.names))]
    made: list[Exhibit] = []
    for k, experiment in enumerate(wanted, 1):
        progress(step_of(experiment.title, k, len(wanted)))
        made += [exhibit for exhibit in experiment.run() if is_wanted(exhibit.name)]
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
            figure.savefig(written[-1])
    return written
