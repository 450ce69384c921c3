"""``mclass report``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from mclass.commands.completion import FileType
from mclass.commands.console import console
from mclass.commands.options import LOG, overwrite_option

if TYPE_CHECKING:
    from mclass.places import Place


@click.command(short_help="Write a result as one HTML page to send around.")
@click.argument("out", type=LOG)
@click.option(
    "-o",
    "--output",
    type=FileType(".html"),
    metavar="PAGE.html",
    help="Where to write.  [default: OUT-stem.html beside OUT]",
)
@overwrite_option
@click.pass_context
def report(ctx: click.Context, out: Place, output: Path | None, overwrite: bool) -> None:
    """Write the results in OUT as one HTML page that any browser opens, offline.

    The page has the map, the objects with their orientations, a slider over the measurements,
    what was skipped and why, and the model. Maps over time are in it if `estimate` wrote them
    (--every). Exit code 3 says that OUT is damaged and what was lost.

    \b
    Examples:
      mclass report drive.mclass.mcap
      mclass report drive.mclass.mcap -o report.html --overwrite
    """
    from mclass.report.page import write_report
    from mclass.text.terminal import Terminal
    from mclass.text.values import count_text

    with console() as tell:
        written = write_report(out, output, overwrite=overwrite, progress=tell.progress)
    terminal = Terminal.of(sys.stdout)
    click.echo(
        f"{terminal.clean(str(written.path), 1000)}: {count_text(written.objects, 'object')}, "
        f"{count_text(written.measurements, 'measurement')}, {count_text(written.maps, 'map')}, "
        f"{written.size / 1e6:.2f} MB"
    )
    if written.damage:
        for sentence in written.damage:
            click.echo(f"damaged: {terminal.clean(sentence, 1000)}", err=True)
        ctx.exit(3)
