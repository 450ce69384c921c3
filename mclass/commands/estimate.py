"""``mclass estimate``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from mclass.commands.console import console
from mclass.commands.options import (
    LOG,
    echo_json,
    format_option,
    model_option,
    overwrite_option,
    plot_option,
    time_options,
)

if TYPE_CHECKING:
    from mclass.places import Place


@click.command()
@click.argument("log", type=LOG)
@model_option
@click.option(
    "-o",
    "--output",
    type=LOG,
    metavar="OUT.mcap",
    help="Where to write.  [default: LOG-stem.mclass.mcap beside the log; of a URL, here]",
)
@time_options
@click.option(
    "--every",
    "every_s",
    type=click.FloatRange(min=0, min_open=True),
    metavar="SECONDS",
    help="Write maps and the full belief every SECONDS too, not only at the end.",
)
@click.option(
    "--prefix",
    default="/mclass",
    show_default=True,
    metavar="TOPIC",
    help="Prefix of the new topics.",
)
@overwrite_option
@click.option(
    "--only-new", is_flag=True, help="Write the new channels alone, without the log's own."
)
@click.option(
    "--in-place",
    is_flag=True,
    help="Append to LOG itself. If that is cut short, LOG is restored the next time that a "
    "command opens it, from the journal beside it.",
)
@click.option(
    "--threads",
    type=click.IntRange(min=1),
    metavar="N",
    help="Threads for the grid; results are the same for any number.  "
    "[default: one for each core, up to 8]",
)
@format_option
@plot_option
@click.pass_context
def estimate(
    ctx: click.Context,
    log: Place,
    model_path: Path | None,
    output: Place | None,
    start: str | None,
    end: str | None,
    every_s: float | None,
    prefix: str,
    overwrite: bool,
    only_new: bool,
    in_place: bool,
    threads: int | None,
    output_format: str,
    plot_path: Path | None,
) -> None:
    """Estimate class, orientation and position of every object in LOG.

    Reads odometry and detections, writes LOG plus the channels /mclass/... to OUT.mcap. The
    input is never touched, except with --in-place. Exit code 3 says that the log was damaged and
    what was lost.

    \b
    Examples:
      mclass estimate drive.mcap
      mclass estimate drive.mcap -c boxes.yaml -o result.mcap --every 10
      mclass estimate drive.mcap -S +30s -E +90s --format json
      mclass estimate drive.mcap --only-new
      mclass estimate s3://bucket/drive.mcap -o s3://bucket/out.mcap
    """
    if in_place and (output is not None or only_new):
        raise click.UsageError("--in-place writes into LOG: it goes with neither -o nor --only-new")
    from mclass.parallel import available_threads
    from mclass.pipeline import default_output
    from mclass.pipeline import estimate as estimate_log
    from mclass.text.reports import choices_text, run_facts

    if output is None and not in_place:
        output = default_output(log)
    threads = threads or available_threads()
    with console() as tell:
        found = estimate_log(
            log,
            model_path,
            output=output,
            start=start,
            end=end,
            every_s=every_s,
            prefix=prefix,
            overwrite=overwrite,
            only_new=only_new,
            in_place=in_place,
            threads=threads,
            progress=tell.progress,
        )
    tell.detail(choices_text(found, threads))
    facts = run_facts(found, str(log), found.output)
    facts["notes"] = () if tell.quiet and output_format == "text" else found.notes
    if output_format == "json":
        from mclass.text.documents import estimate_json

        echo_json(estimate_json(**facts))
    else:
        from mclass.text.reports import estimate_text
        from mclass.text.terminal import Terminal

        click.echo(estimate_text(**facts, terminal=Terminal.of(sys.stdout)))
    if plot_path is not None and found.maps is None:
        tell.warn("nothing to draw: no detection points anywhere on the grid")
    elif plot_path is not None:
        from mclass.plot.maps import estimate_figure
        from mclass.plot.style import save_figure

        save_figure(estimate_figure(found), plot_path)
    if found.damage:
        ctx.exit(3)
