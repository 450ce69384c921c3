"""``mclass inspect log|objects|cell|model``."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from mclass.commands.completion import object_ids
from mclass.commands.console import console
from mclass.commands.manual import OrderedGroup
from mclass.commands.options import (
    FILE,
    LOG,
    echo_json,
    end_damaged,
    format_option,
    model_option,
    plot_option,
)

if TYPE_CHECKING:
    from mclass.places import Place

history_option = click.option(
    "--history", is_flag=True, help="Also the same figures after each measurement, oldest first."
)


@click.group(cls=OrderedGroup, short_help="Look into a log, a result, a cell or a model.")
def inspect() -> None:
    """Look into a log, into the results in an output, or into a model file.

    \b
    Examples:
      mclass inspect log drive.mcap
      mclass inspect objects drive.mclass.mcap
      mclass inspect cell drive.mclass.mcap 4.05 -2.5
      mclass inspect model boxes.yaml
    """


@inspect.command("log", short_help="What is in a log and what of it is used.")
@click.argument("log", type=LOG)
@model_option
@click.option("--verify", is_flag=True, help="Read and check every byte of the log.")
@format_option
@plot_option
@click.pass_context
def inspect_log(
    ctx: click.Context,
    log: Place,
    model_path: Path | None,
    verify: bool,
    output_format: str,
    plot_path: Path | None,
) -> None:
    """Say what is in LOG, what `estimate` would use of it, and why not the rest.

    Exit code 3 says that the log is damaged.

    \b
    Examples:
      mclass inspect log drive.mcap
      mclass inspect log drive.mcap --verify --format json
      mclass inspect log drive.mcap --plot drive.png
    """
    from mclass.inspection import look_over
    from mclass.text.logs import log_json, log_text
    from mclass.text.terminal import Terminal

    with console() as tell:
        facts, survey = look_over(log, model_path, verify=verify, progress=tell.progress)
    if plot_path is not None:
        from mclass.plot.course import log_figure
        from mclass.plot.style import save_figure

        save_figure(log_figure(survey), plot_path)
    if output_format == "json":
        echo_json(log_json(facts, survey))
    else:
        if tell.quiet:
            survey = replace(survey, notes=())
        click.echo(log_text(facts, survey, Terminal.of(sys.stdout)))
    if facts.damage:
        ctx.exit(3)


@inspect.command("objects", short_help="Every object: class, position, orientation.")
@click.argument("out", type=LOG)
@history_option
@format_option
@plot_option
@click.pass_context
def inspect_objects(
    ctx: click.Context, out: Place, history: bool, output_format: str, plot_path: Path | None
) -> None:
    """Print every object in OUT: class probabilities, position, orientation modes.

    \b
    Examples:
      mclass inspect objects drive.mclass.mcap
      mclass inspect objects drive.mclass.mcap --history --format json
      mclass inspect objects drive.mclass.mcap --plot objects.png
    """
    from mclass.outputs.readback import OutputLog
    from mclass.text.cells import history_text
    from mclass.text.documents import objects_json
    from mclass.text.objects import objects_text
    from mclass.text.terminal import Terminal
    from mclass.text.values import natural

    with OutputLog.open(out) as output:
        objects, names, frame = output.objects(), output.class_names, output.frame
        past = output.history() if history else None
        damage = output.reader.damage.losses
    if plot_path is not None:
        from mclass.plot.objects import objects_figure
        from mclass.plot.style import save_figure

        save_figure(objects_figure(objects, names, frame), plot_path)
    if output_format == "json":
        echo_json(objects_json(objects, names, frame, past))
    else:
        terminal = Terminal.of(sys.stdout)
        click.echo(objects_text(objects, names, frame, terminal))
        for object_id, steps in sorted((past or {}).items(), key=lambda item: natural(item[0])):
            click.echo(f"\nobject {terminal.clean(object_id)}")
            click.echo(history_text(steps, names, terminal))
    end_damaged(ctx, damage)


@inspect.command(
    "cell",
    short_help="One cell's class probabilities and orientation density.",
    context_settings={"ignore_unknown_options": True},
)
@click.argument("out", type=LOG)
@click.argument("x", type=float)
@click.argument("y", type=float)
@click.option(
    "--object",
    "object_id",
    metavar="ID",
    shell_complete=object_ids("out"),
    help="That object's own belief.",
)
@history_option
@format_option
@plot_option
@click.pass_context
def inspect_cell(
    ctx: click.Context,
    out: Place,
    x: float,
    y: float,
    object_id: str | None,
    history: bool,
    output_format: str,
    plot_path: Path | None,
) -> None:
    """Print the belief of the cell of OUT that holds the point X Y [m].

    X and Y are in the world frame; negative numbers are typed as they are. With --history
    the belief after each measurement is computed anew from the measurements in OUT.

    \b
    Examples:
      mclass inspect cell drive.mclass.mcap 4.05 -2.5
      mclass inspect cell drive.mclass.mcap 4.05 -2.5 --object o1 --history
      mclass inspect cell drive.mclass.mcap 0.5 0.5 --plot cell.png
    """
    from mclass.inspection import look_into
    from mclass.text.cells import cell_text, history_text
    from mclass.text.documents import cell_json
    from mclass.text.terminal import Terminal

    found = look_into(out, x, y, object_id, history=history or plot_path is not None)
    names = found.class_names
    shown = found.history if history else None
    if plot_path is not None:
        from mclass.plot.orientation import cell_figure, orientation_figure
        from mclass.plot.style import save_figure

        if history:
            subject = f"cell ({x:g}, {y:g})" if object_id is None else f"object {object_id}"
            figure = orientation_figure((found.prior, *found.history), names, subject)
        else:
            figure = cell_figure(found.report, names, found.frame, object_id)
        save_figure(figure, plot_path)
    if output_format == "json":
        echo_json(cell_json(found.report, names, shown))
    else:
        terminal = Terminal.of(sys.stdout)
        click.echo(cell_text(found.report, names, found.frame, terminal, object_id))
        if shown is not None:
            click.echo("\n" + history_text(shown, names, terminal))
    end_damaged(ctx, found.damage)


@inspect.command("model", short_help="A model's likelihood fields.")
@click.argument("model", type=FILE)
@click.option(
    "--at",
    "place",
    type=float,
    nargs=3,
    metavar="X Y DEG",
    help="Draw for an object at X, Y, in the model's length unit, that faces DEG degrees.  "
    "[default: 0 0 0, its own frame]",
)
@format_option
@plot_option
def inspect_model(
    model: Path,
    place: tuple[float, float, float] | None,
    output_format: str,
    plot_path: Path | None,
) -> None:
    """Print what MODEL says each class returns and from where; draw it with --plot.

    \b
    Examples:
      mclass inspect model boxes.yaml
      mclass inspect model boxes.yaml --plot fields.png
      mclass inspect model boxes.yaml --at 2 1.5 45 --plot fields.png
    """
    from mclass.config.model_file import load_model
    from mclass.text.models import model_json, model_text
    from mclass.text.terminal import Terminal

    loaded = load_model(model)
    if plot_path is not None:
        from mclass.model import LENGTH_UNITS
        from mclass.plot.likelihood import likelihood_figure
        from mclass.plot.style import save_figure

        metres = LENGTH_UNITS[loaded.length_unit]
        x, y, degrees = place or (0.0, 0.0, 0.0)
        if not all(map(math.isfinite, (x, y, degrees))):
            raise click.BadParameter("is not a place", param_hint="--at")
        figure = likelihood_figure(
            loaded.classes,
            unit=(loaded.length_unit, metres),
            pose=(x * metres, y * metres, math.radians(degrees)),
        )
        save_figure(figure, plot_path)
    if output_format == "json":
        echo_json(model_json(loaded))
    else:
        click.echo(model_text(loaded, Terminal.of(sys.stdout)))
