"""``mclass fuse``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from mclass.commands.completion import world_frames
from mclass.commands.console import console
from mclass.commands.options import (
    FILE,
    LOG,
    echo_json,
    format_option,
    overwrite_option,
    plot_option,
)

if TYPE_CHECKING:
    from mclass.places import Place


@click.command(short_help="Join results of several logs or robots in one map.")
@click.argument("outputs", nargs=-1, required=True, type=LOG, metavar="OUT...")
@click.option(
    "-o",
    "--output",
    type=LOG,
    metavar="MAP.mcap",
    required=True,
    help="Where to write; a log of the channels /mclass/... alone.",
)
@click.option(
    "--frames",
    type=FILE,
    metavar="FRAMES.yaml",
    help="Where each output's world lies in the common one: lines such as "
    "'hall: {x: 12.5, y: -3, heading_deg: 90}', by path, file name or stem. "
    "Without it all are in the same world.",
)
@click.option(
    "-c",
    "--model",
    "model_path",
    type=FILE,
    metavar="MODEL.yaml",
    help="Model to use instead of the outputs' own, which must otherwise be the same.",
)
@click.option(
    "--separate-ids",
    is_flag=True,
    help="Equal ids in different outputs are different objects: call them NAME/ID.",
)
@click.option(
    "--frame",
    metavar="NAME",
    shell_complete=world_frames("outputs"),
    help="Name of the common world.  [default: the outputs' own; map with --frames]",
)
@click.option(
    "--prefix", default="/mclass", show_default=True, metavar="TOPIC", help="Prefix of the topics."
)
@overwrite_option
@format_option
@plot_option
@click.pass_context
def fuse(
    ctx: click.Context,
    *,
    outputs: tuple[Place, ...],
    output: Place,
    frames: Path | None,
    model_path: Path | None,
    separate_ids: bool,
    frame: str | None,
    prefix: str,
    overwrite: bool,
    output_format: str,
    plot_path: Path | None,
) -> None:
    """Join the measurements in OUT... and estimate anew, as if all were of one log.

    The belief is exactly that of one log holding all measurements: the prior counts once, and
    looks from one place share one vote whichever log they are in. Objects of equal id are the
    same object. The map can be inspected, evaluated and fused again like any output.

    \b
    Examples:
      mclass fuse monday.mclass.mcap tuesday.mclass.mcap -o map.mcap
      mclass fuse r1.mclass.mcap r2.mclass.mcap -o map.mcap --frames frames.yaml
      mclass fuse results/*.mclass.mcap -o map.mcap --separate-ids
      mclass fuse results/*.mclass.mcap -o map.mcap --plot map.png
    """
    from mclass.fusion import fuse as fuse_outputs
    from mclass.text.documents import estimate_json
    from mclass.text.reports import choices_text, estimate_text, run_facts
    from mclass.text.terminal import Terminal

    with console() as tell:
        found = fuse_outputs(
            outputs,
            output,
            frames=frames,
            model=model_path,
            separate_ids=separate_ids,
            frame=frame,
            prefix=prefix,
            overwrite=overwrite,
            progress=tell.progress,
        )
    if plot_path is not None and found.maps is None:
        tell.warn("nothing to draw: no detection points anywhere on the grid")
    elif plot_path is not None:
        from mclass.plot.maps import estimate_figure
        from mclass.plot.style import save_figure

        save_figure(estimate_figure(found), plot_path)
    tell.detail(choices_text(found, threads=1))
    facts = run_facts(found, ", ".join(map(str, outputs)), output)
    if output_format == "json":
        echo_json({**estimate_json(**facts), "input": [str(path) for path in outputs]})
    else:
        click.echo(estimate_text(**facts, terminal=Terminal.of(sys.stdout)))
    if found.damage:
        ctx.exit(3)
