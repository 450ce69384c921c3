"""Objects in the terminal."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from mclass.classes import BACKGROUND
from mclass.records import FloatArray
from mclass.results import ObjectEstimate, OrientationMode, is_flat
from mclass.text.terminal import Terminal, display_width, table, wrap
from mclass.text.values import (
    count_text,
    in_reading_order,
    list_text,
    mode_text,
    natural,
    probability_text,
    share_text,
    spread_text,
)

_ID_COLUMNS = 12
_LISTED_CLASSES = 5
_LISTED_MODES = 4
_NEGLIGIBLE = 0.001
_ENDLESS = 10_000


def objects_text(
    objects: Iterable[ObjectEstimate],
    class_names: Sequence[str],
    frame: str,
    terminal: Terminal,
) -> str:
    """Table of objects: class probabilities, position ± std, orientation modes.

    The named class comes first in each object's lines; position and orientations are given
    that class. Objects are in the natural order of their ids. Ties, and a background more
    probable than any class, are said below.

    Args:
        objects: Latest estimate of each object.
        class_names: Without the background.
        frame: World frame of the positions.
        terminal: What the reader's terminal can show.
    """
    estimates = sorted(objects, key=lambda estimate: natural(estimate.object_id))
    if not estimates:
        return "No objects: no measurement that was used carries an object id."
    names = [terminal.clean(name) for name in class_names]
    rows: list[Sequence[str]] = []
    for estimate in estimates:
        name = terminal.clean(estimate.object_id)
        # A long id keeps a line of its own, whole: people paste it into the next command.
        if display_width(name) > _ID_COLUMNS:
            rows.append([name])
            name = ""
        rows.append([name, *_object_cells(estimate, names, terminal)])
    lines = _object_table(rows, terminal)
    remarks = [
        terminal.paint(line, "warning")
        for estimate in estimates
        for remark in _remarks(estimate, names, terminal)
        for line in wrap(remark, terminal, "  ")
    ]
    title = f"{count_text(len(estimates), 'object')}, frame {terminal.clean(frame)}"
    return "\n".join([title, "", *lines, *([""] if remarks else []), *remarks])


def _object_table(rows: Sequence[Sequence[str]], terminal: Terminal) -> list[str]:
    """Position beside orientation or, on narrow terminals, above it."""
    headings = ["id", "class", "P", "position [m]", "orientation [deg]", "n"]
    full = [row for row in rows if len(row) > 1]
    natural_width = max(map(display_width, table(headings, full, "<<><<>", Terminal(_ENDLESS))))
    if natural_width <= terminal.width:
        return table(headings, rows, "<<><<>", terminal)
    stacked = [row if len(row) == 1 else [*row[:3], f"{row[3]}\n{row[4]}", row[5]] for row in rows]
    headings[3:5] = ["pose [m, deg]"]
    return table(headings, stacked, "<<><>", terminal, elastic=(0, 1))


def _object_cells(
    estimate: ObjectEstimate, names: Sequence[str], terminal: Terminal
) -> tuple[str, ...]:
    """The cells of an object's row after its id."""
    labels, values = _class_lines(
        estimate.class_probabilities, estimate.class_index, estimate.tie, names
    )
    place = "\n".join(
        f"{axis} {spread_text(value, std, 2, terminal)}"
        for axis, value, std in zip("xy", estimate.position, estimate.position_std, strict=True)
    )
    if estimate.unexplained:
        return BACKGROUND, probability_text(1.0), place, "unknown", str(estimate.measurements)
    modes = _mode_lines(estimate.modes, terminal)
    return labels, values, place, modes, str(estimate.measurements)


def _class_lines(
    probabilities: FloatArray, named: int, tie: Sequence[int], names: Sequence[str]
) -> tuple[str, str]:
    """Names and probabilities: the named class, then the others; ``=`` marks those that tie."""
    everything = (BACKGROUND, *names)
    rest = [i for i in np.argsort(-probabilities, kind="stable") if i != named + 1]
    listed = [named + 1, *rest[: _LISTED_CLASSES - 1]]
    hidden = rest[_LISTED_CLASSES - 1 :]
    tied = {index + 1 for index in tie}
    labels = [("= " if i in tied else "") + everything[i] for i in listed]
    values = [probability_text(probabilities[i]) for i in listed]
    if hidden:
        labels.append(f"+ {len(hidden)} more")
        values.append(probability_text(float(probabilities[hidden].sum())))
    return "\n".join(labels), "\n".join(values)


def _mode_lines(modes: Sequence[OrientationMode], terminal: Terminal) -> str:
    """One mode a line, heaviest first; those that hold next to nothing are counted."""
    if is_flat(modes):
        return "any (flat)"
    ordered = in_reading_order(modes)
    shown = [mode for mode in ordered[:_LISTED_MODES] if mode.mass >= _NEGLIGIBLE] or ordered[:1]
    lines = [mode_text(mode, terminal) for mode in shown]
    hidden = ordered[len(shown) :]
    if hidden:
        lines.append(f"+ {len(hidden)} more ({share_text(sum(mode.mass for mode in hidden))})")
    return "\n".join(lines)


def _remarks(estimate: ObjectEstimate, names: Sequence[str], terminal: Terminal) -> Iterable[str]:
    """Sentences on what the named class does not tell."""
    who = terminal.clean(estimate.object_id, 2 * _ID_COLUMNS)
    if estimate.unexplained:
        yield (
            f"{who}: no class explains these labels: each class is ruled out by at least one of "
            "them (--history of `mclass inspect objects` shows by which). Give the classes a "
            "clutter for it, or use the preset robust."
        )
        return
    if estimate.tie:
        tied = list_text([names[index] for index in estimate.tie])
        yield (
            f"{who}: {tied} are equally probable (=), a tie; "
            f"position and orientation are those given {names[estimate.class_index]}."
        )
    background = estimate.class_probabilities[0]
    if background > estimate.class_probabilities[estimate.class_index + 1]:
        yield (
            f"{who}: {BACKGROUND} (nothing there), P {probability_text(background)}, "
            "is more probable than any class."
        )
