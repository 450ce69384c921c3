"""``mclass view``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from mclass.commands.completion import FileType
from mclass.commands.console import console
from mclass.commands.options import LOG, overwrite_option

if TYPE_CHECKING:
    from mclass.places import Place


@click.command(short_help="Open a result in the viewer Rerun.")
@click.argument("out", type=LOG)
@click.option(
    "--save",
    "save_path",
    type=FileType(".rrd"),
    metavar="FILE.rrd",
    help="Write a file that `rerun FILE.rrd` opens, instead of opening the viewer.",
)
@overwrite_option
@click.pass_context
def view(ctx: click.Context, out: Place, save_path: Path | None, overwrite: bool) -> None:
    """Show the results in OUT in Rerun: maps, track, detections, objects, over time.

    Each object has its class probabilities over time and its orientation density after each
    measurement. Maps over time are there if `estimate` wrote them (--every). Needs the extra
    mclass[view]. Exit code 3 says that OUT is damaged and what was lost.

    \b
    Examples:
      mclass view drive.mclass.mcap
      mclass view drive.mclass.mcap --save drive.rrd
    """
    from mclass.text.values import count_text
    from mclass.viewing import open_viewer, save_recording

    with console() as tell:
        if save_path is None:
            shown = open_viewer(out, progress=tell.progress)
        else:
            shown = save_recording(out, save_path, overwrite=overwrite, progress=tell.progress)
    contents = shown.contents
    click.echo(
        f"{'opened in Rerun' if save_path is None else save_path}: "
        f"{count_text(len(contents.objects), 'object')}, "
        f"{count_text(len(contents.measurements), 'measurement')}, "
        f"{count_text(len(contents.maps), 'map')}"
        + (f", {shown.size / 1e6:.2f} MB" if shown.size else "")
    )
    for note in () if tell.quiet else contents.notes:
        click.echo(f"note: {note}", err=True)
    for sentence in shown.damage:
        click.echo(f"damaged: {sentence}", err=True)
    if shown.damage:
        ctx.exit(3)
