"""Help that fits on a screen: options that few need are listed by --help-all alone."""

from __future__ import annotations

from functools import partial
from inspect import cleandoc
from typing import Any

import click

HELP_ALL = "retropole.help-all"
"""Set in a context's `meta` where the whole help is wanted."""


class Option(click.Option):
    """An option; with `more`, --help-all alone lists it."""

    def __init__(self, *names: Any, more: bool = False, **settings: Any) -> None:
        super().__init__(*names, **settings)
        self.more = more

    def get_help_record(self, ctx: click.Context) -> tuple[str, str] | None:
        """Give what the help lists, where it does."""
        return None if self.more and HELP_ALL not in ctx.meta else super().get_help_record(ctx)


more_option = partial(click.option, cls=Option, more=True)
"""Make an option that --help-all alone lists."""


class Brief(click.Command):
    """A command whose --help ends at a form feed in its text; --help-all shows the rest as well."""

    def __init__(self, *args: Any, **settings: Any) -> None:
        super().__init__(*args, **settings)
        words = "Show all options and examples, and exit."
        flag: dict[str, Any] = {"is_flag": True, "is_eager": True, "expose_value": False}
        self.params.append(
            Option(["--help-all"], more=True, callback=_help_all, help=words, **flag)
        )

    def format_help_text(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the text, up to the form feed or all of it."""
        text = cleandoc(self.help or "")
        is_all = HELP_ALL in ctx.meta
        formatter.write_paragraph()
        with formatter.indentation():
            formatter.write_text(text.replace("\f\n", "") if is_all else text.partition("\f")[0])

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options, and how many more there are."""
        super().format_options(ctx, formatter)
        # The one that shows them is none of them.
        more = sum(getattr(each, "more", False) for each in self.params) - 1
        if more and HELP_ALL not in ctx.meta:
            formatter.write(f"\n--help-all: {more} more\n")


def _help_all(context: click.Context, option: click.Parameter, is_wanted: bool) -> None:
    if is_wanted and not context.resilient_parsing:
        context.meta[HELP_ALL] = True
        click.echo(context.get_help())
        context.exit()
