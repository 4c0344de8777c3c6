"""The command ``retropole paper``."""

from __future__ import annotations

from pathlib import Path

import click

from .common import CONTEXT, OUT, progress_on_terminal, show


@click.command(context_settings=CONTEXT)
@click.option(
    "--out",
    type=OUT,
    default=Path("retropole-paper"),
    show_default=True,
    help="Folder for the tables (.md, .csv) and figures (.png, .svg).",
)
@click.option(
    "--seeds",
    type=click.IntRange(1, 10_000),
    default=100,
    show_default=True,
    help="Simulated scenes of each experiment; 100 take minutes.",
)
@click.option(
    "--data",
    type=click.Path(path_type=Path, file_okay=False, exists=True),
    help="Folder of the real recordings pandaset and planes_top_front.  [default: left out]",
)
@click.option("-q", "--quiet", is_flag=True, help="Print nothing but errors.")
def paper(out: Path, seeds: int, data: Path | None, quiet: bool) -> int:
    """Reproduce the tables and figures of the method's paper, its figures beside ours.

    Equations, tables, figures and failures of Xue et al. 2019: each a table as Markdown and CSV,
    and a figure as PNG and SVG. index.md holds all tables. 100 seeds take about ten minutes.

    \b
    Examples:
      retropole paper --out paper
      retropole paper --seeds 10 --data recordings/
    """
    from ..errors import printable
    from ..evaluation.paper import reproduce, write_exhibit
    from ..files import write_atomically

    with progress_on_terminal(quiet) as progress:
        exhibits = reproduce(seeds, data, progress)
        progress("write")
        written = [path for exhibit in exhibits for path in write_exhibit(exhibit, out)]
    pages = []
    for exhibit in exhibits:
        picture = "" if exhibit.draw is None else f"\n![{exhibit.title}]({exhibit.name}.png)\n"
        pages.append(exhibit.markdown().replace("# ", "## ", 1) + picture)
    index = out / "index.md"
    write_atomically(index, "\n".join(["# Xue et al. 2019, reproduced\n", *pages]).encode())
    if not quiet:
        show(f"written: {printable(str(index))} and {len(written)} tables and figures beside it")
    return 0
