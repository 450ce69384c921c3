"""``mclass check``."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from mclass.commands.options import FILE, echo_json, format_option


@click.command(short_help="Validate a model file.")
@click.argument("model", type=FILE)
@format_option
def check(model: Path, output_format: str) -> None:
    """Validate MODEL and report where a confusion exceeds the class's own label.

    Every fault of the file is reported in one run, with its line and column; exit code 2 then.
    The paper's inequality (12) is checked between the grid's ranges: where it is violated the
    model still works, but a class is likelier to be called by a wrong name there. Only places
    that matter are looked at: where the class returns one of the two labels with at least a
    tenth of the peak density of its own. Far from all viewpoints a ratio says nothing.

    \b
    Examples:
      mclass check boxes.yaml
      mclass check boxes.yaml --format json
    """
    from mclass.checks import find_violations
    from mclass.config.model_file import load_model
    from mclass.model import LENGTH_UNITS
    from mclass.text.checks import check_json, check_text
    from mclass.text.terminal import Terminal

    loaded = load_model(model)
    grid = loaded.grid
    violations = find_violations(loaded.classes, grid.min_range, grid.max_range)
    if output_format == "json":
        echo_json({"model": loaded.name, "valid": True, **check_json(violations)})
        return
    terminal, names = Terminal.of(sys.stdout), loaded.classes
    click.echo(
        f"{terminal.clean(loaded.name)} is valid: {len(names.class_names)} classes, "
        f"{len(names.label_names)} labels, lengths in {loaded.length_unit}, "
        f"preset {loaded.inference.preset}"
    )
    unit = (loaded.length_unit, LENGTH_UNITS[loaded.length_unit])
    click.echo(check_text(violations, terminal, unit))
