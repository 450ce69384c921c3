"""Options that several commands share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import click

from mclass.commands.completion import FileType

Command = TypeVar("Command", bound=Callable[..., Any])


class PlaceType(FileType):
    """A path, or a URL that is left as it is."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """See `click.Path.convert`."""
        from mclass.places import Url, place_of

        place = place_of(value)
        return place if isinstance(place, Url) else super().convert(value, param, ctx)


LOG = PlaceType(".mcap")
"""A log's path or URL."""

FILE = FileType(".yaml", ".yml")
"""A model file, or another in YAML."""


def format_option(command: Command) -> Command:
    """``--format text|json``."""
    return click.option(
        "--format",
        "output_format",
        type=click.Choice(["text", "json"]),
        default="text",
        show_default=True,
        help="How results are printed to stdout.",
    )(command)


def _drawable(ctx: click.Context, parameter: click.Parameter, path: Path | None) -> Path | None:
    """Refuse a picture that cannot be drawn before any work is done."""
    if path is not None and not ctx.resilient_parsing:
        from mclass.plot.style import require_savable

        require_savable(path)
    return path


def plot_option(command: Command) -> Command:
    """``--plot FILE``."""
    return click.option(
        "--plot",
        "plot_path",
        type=FileType(".png", ".svg", ".pdf"),
        callback=_drawable,
        metavar="FILE",
        help="Also draw to FILE (.png, .svg or .pdf); needs the extra mclass[plot].",
    )(command)


def model_option(command: Command) -> Command:
    """``-c MODEL``."""
    return click.option(
        "-c",
        "--model",
        "model_path",
        type=FILE,
        metavar="MODEL.yaml",
        help="Model file. Without it: mclass.yaml beside the log, in the working directory, "
        "or attached to the log.",
    )(command)


def time_options(command: Command) -> Command:
    """``-S/--start`` and ``-E/--end``."""
    end = click.option(
        "-E", "--end", metavar="TIME", help="Ignore messages logged after TIME (as --start)."
    )
    start = click.option(
        "-S",
        "--start",
        metavar="TIME",
        help="Ignore messages logged before TIME: nanoseconds, RFC 3339, or +10s from the start.",
    )
    return start(end(command))


def overwrite_option(command: Command) -> Command:
    """``--overwrite``."""
    return click.option("--overwrite", is_flag=True, help="Replace an existing output.")(command)


def echo_json(document: Any) -> None:
    """Print a JSON document to stdout."""
    import json

    click.echo(json.dumps(document, allow_nan=False, indent=1))


def end_damaged(ctx: click.Context, damage: Sequence[str]) -> None:
    """Say what of the input was lost, and end with 3; nothing if nothing was."""
    for sentence in damage:
        click.echo(f"damaged: {sentence}", err=True)
    if damage:
        ctx.exit(3)
