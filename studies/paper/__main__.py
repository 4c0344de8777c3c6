"""The command ``python -m studies.paper``, run from a clone's root."""

from __future__ import annotations

import sys
from collections.abc import Collection, Sequence
from pathlib import Path

import click

from retropole.base.errors import Refusal, RetropoleError, printable
from retropole.base.files import write_atomically
from retropole.cli.common import CONTEXT, never_fail_to_encode, progress_on_terminal, show
from retropole.cli.errors import failure_of, report_failure
from retropole.cli.options import OUT
from studies.paper import Exhibit, Experiment, experiments, reproduce, write_exhibit

COMMAND = "python -m studies.paper"
"""As it is typed."""


@click.command(context_settings=CONTEXT)
@click.option(
    "--out",
    type=OUT,
    default=Path("retropole-paper"),
    show_default=True,
    help="Folder for the tables (.md, .csv) and figures (.png, .svg).",
)
@click.option(
    "--only",
    metavar="NAME",
    multiple=True,
    help="Make only the tables and figures whose file name contains it, and print the tables "
    "instead of index.md; several may be given.  [default: all]",
)
@click.option(
    "--seeds",
    type=click.IntRange(1, 10_000),
    default=100,
    show_default=True,
    help="Simulated scenes of each experiment; 100 take minutes. Of more than 20, experiments that "
    "take seconds for each scene run on 20 or on a fifth, and it is said which.",
)
@click.option(
    "--data",
    type=click.Path(path_type=Path, file_okay=False, exists=True),
    help="Folder of the real recordings pandaset and planes_top_front.  [default: left out]",
)
@click.option("-q", "--quiet", is_flag=True, help="Print nothing but errors.")
def paper(out: Path, only: tuple[str, ...], seeds: int, data: Path | None, quiet: bool) -> None:
    """Reproduce the tables and figures of the method's paper, its figures beside ours.

    Equations, tables, figures and failures of Xue et al. 2019: each a table as Markdown and CSV,
    and a figure as PNG and SVG. index.md holds all tables. 100 seeds take about ten minutes.

    \b
    Examples:
      python -m studies.paper --out paper
      python -m studies.paper --only table2
      python -m studies.paper --seeds 10 --data recordings/
    """
    listed = experiments(seeds, data)
    check_names(only, [name for each in listed for name in each.names])
    with progress_on_terminal(quiet) as progress:
        exhibits = reproduce(seeds, data, progress, only=only)
        progress("write")
        written = [path for exhibit in exhibits for path in write_exhibit(exhibit, out)]
    if only:
        if not quiet:
            show("\n".join(exhibit.markdown() for exhibit in exhibits))
        place = f"{len(written)} tables and figures in {printable(str(out))}"
    else:
        index = out / "index.md"
        said = fewer(listed, {exhibit.name for exhibit in exhibits}, seeds)
        write_atomically(index, index_of(exhibits, said).encode())
        place = f"{printable(str(index))} and {len(written)} tables and figures beside it"
    if not quiet:
        for line in fewer(listed, {exhibit.name for exhibit in exhibits}, seeds):
            show(line)
        show(f"written: {place}")


def check_names(only: Sequence[str], names: Sequence[str]) -> None:
    """Tell which names there are where one that was asked for is in none of them.

    Raises
    ------
    click.BadParameter
        Names it, and what there is.
    """
    for part in only:
        if not any(part in name for name in names):
            raise click.BadParameter(
                f"no table or figure has {part!r} in its name: {', '.join(names)}; "
                "table4_recorded with --data",
                param_hint="--only",
            )


def fewer(listed: Sequence[Experiment], made: Collection[str], seeds: int) -> list[str]:
    """Say which experiments that were made ran on fewer scenes than seeds were asked for."""
    return [
        f"{each.title}: {each.scenes} of {seeds} scenes, each takes seconds"
        for each in listed
        if each.scenes is not None and {*each.names} & {*made}
    ]


def index_of(exhibits: Sequence[Exhibit], said: Sequence[str] = ()) -> str:
    """Write all tables as one page of Markdown, each with its picture, and what is to be said."""
    pages = [f"{line[0].upper()}{line[1:]}.\n" for line in said]
    for exhibit in exhibits:
        picture = "" if exhibit.draw is None else f"\n![{exhibit.title}]({exhibit.name}.png)\n"
        pages.append(exhibit.markdown().replace("# ", "## ", 1) + picture)
    return "\n".join(["# Xue et al. 2019, reproduced\n", *pages])


def main() -> None:
    """Run the command, and end the process; an error is a line that says what to do."""
    never_fail_to_encode()
    try:
        paper(prog_name=COMMAND)
    except (RetropoleError, OSError) as error:
        refused = isinstance(error, Refusal)
        sys.exit(report_failure(failure_of(error, COMMAND), refused=refused, as_json=False))


if __name__ == "__main__":
    main()
