"""``mclass init``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from mclass.commands.console import console
from mclass.commands.options import FILE, LOG, overwrite_option

if TYPE_CHECKING:
    from mclass.places import Place


@click.command(short_help="Write a commented model file for a log.")
@click.argument("log", type=LOG)
@click.option(
    "-o",
    "--output",
    type=FILE,
    metavar="MODEL.yaml",
    help="Where to write; - for stdout.  [default: mclass.yaml beside the log]",
)
@overwrite_option
def init(log: Place, output: Path | None, overwrite: bool) -> None:
    """Look at LOG and write a commented model file for it.

    The file names the topics found and has a class for every label seen, with viewpoints that
    are a first guess. Edit them, then `mclass check` the file and `mclass estimate` the log.

    \b
    Examples:
      mclass init drive.mcap
      mclass init drive.mcap -o boxes.yaml
      mclass init drive.mcap -o -
    """
    from mclass.initialise import template_for, write_model_file
    from mclass.text.terminal import Terminal

    with console() as tell:
        text = template_for(log, tell.progress)
    if output is not None and str(output) == "-":
        click.echo(text, nl=False)
        return
    path = write_model_file(text, log, output, overwrite=overwrite)
    shown = Terminal.of(sys.stdout).clean(str(path), 1000)
    click.echo(f"wrote {shown}; edit it, then: mclass check {shown}")
