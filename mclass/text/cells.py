"""One cell's belief in the terminal, and how each measurement moved a cell or an object."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from mclass.classes import BACKGROUND
from mclass.records import FloatArray
from mclass.results import CellReport, ObjectEstimate, OrientationMode, is_flat
from mclass.text.terminal import Terminal, display_width, table, wrap
from mclass.text.values import (
    count_text,
    degrees_text,
    in_reading_order,
    list_text,
    mode_text,
    probability_text,
    seconds_text,
    share_text,
    stamp_text,
)

_CHART_COLUMNS = 72
_CHART_ROWS = 4
_CHARTED_CLASSES = 4
_LISTED_CLASSES = 12
_SHORTEST_LABELS = 16
_NEGLIGIBLE = 0.01
_TIE_TOLERANCE = 1e-6
_FLAT = 1e-3


def cell_text(
    report: CellReport,
    class_names: Sequence[str],
    frame: str,
    terminal: Terminal,
    object_id: str | None = None,
) -> str:
    """A cell's class probabilities as bars, its orientation densities as profiles.

    Args:
        report: The cell.
        class_names: Without the background.
        frame: World frame of the cell's centre.
        terminal: What the reader's terminal can show.
        object_id: Whose belief it is; None for the grid's.
    """
    names = [terminal.clean(name) for name in class_names]
    x, y = report.center
    size = report.grid.cell_size
    owner = "" if object_id is None else f"object {terminal.clean(object_id)}, "
    lines = [
        f"{owner}row {report.row}, column {report.column}, center ({x:.2f}, {y:.2f}) m in "
        f"{terminal.clean(frame)}, size {size:g} m"
    ]
    if report.measurements:
        last = (
            f"{count_text(report.measurements, 'measurement')}, "
            f"the last at {stamp_text(report.stamp_ns)}"
        )
        if report.labels:
            last += f": {', '.join(terminal.clean(label) for label in report.labels)}"
        lines += wrap(last, terminal, "  ")
    else:
        lines.append("no measurement: this is the prior")
    lines += ["", *_probability_bars(report, names, terminal)]
    charted, hidden = _charted_classes(report)
    for index in charted:
        lines += ["", *_density_chart(report, index, names[index], terminal)]
    if hidden:
        noun = "class" if hidden == 1 else "classes"
        lines += ["", f"{hidden} less probable {noun} not drawn"]
    return "\n".join(lines)


def _probability_bars(report: CellReport, names: Sequence[str], terminal: Terminal) -> list[str]:
    """Background first, then the classes by probability; ties said."""
    probabilities = report.class_probabilities
    order = 1 + np.argsort(-probabilities[1:], kind="stable")
    everything = (BACKGROUND, *names)
    rows = [
        [everything[i], probability_text(probabilities[i]), terminal.bar(probabilities[i], 40)]
        for i in (0, *order[:_LISTED_CLASSES])
    ]
    hidden = order[_LISTED_CLASSES:]
    if len(hidden):
        rest = float(probabilities[hidden].sum())
        rows.append([f"+ {len(hidden)} more", probability_text(rest), terminal.bar(rest, 40)])
    lines = table(["class", "P", ""], rows, "<><", terminal, elastic=(0,))
    tied = _tied_classes(probabilities)
    if not probabilities[1:].any():
        lines.append(terminal.paint("No class explains these labels.", "warning"))
    elif tied:
        sentence = f"{list_text([names[i] for i in tied])} are equally probable, a tie."
        lines += [terminal.paint(line, "warning") for line in wrap(sentence, terminal, "  ")]
    return lines


def _tied_classes(probabilities: FloatArray) -> list[int]:
    """Indices of the most probable classes when there are several, to 1e-6."""
    classes = probabilities[1:]
    tied = np.flatnonzero(classes >= classes.max() - _TIE_TOLERANCE)
    return tied.tolist() if len(tied) > 1 else []


def _charted_classes(report: CellReport) -> tuple[list[int], int]:
    """Classes worth a chart, most probable first, and how many are left out."""
    classes = report.class_probabilities[1:]
    order = np.argsort(-classes, kind="stable")
    worth = [int(i) for i in order[:_CHARTED_CLASSES] if classes[i] >= _NEGLIGIBLE]
    charted = worth or [int(order[0])]
    return charted, len(classes) - len(charted)


def _density_chart(report: CellReport, index: int, name: str, terminal: Terminal) -> list[str]:
    """One class's orientation density over 0 to 360 degrees, its modes below."""
    density = report.density[index]
    if np.ptp(density) <= _FLAT * density.max():
        return wrap(f"orientation given {name}: flat, nothing is known", terminal, "  ")
    peak = int(density.argmax())
    where = degrees_text(2.0 * np.pi * peak / len(density))
    columns = _resample(density, min(_CHART_COLUMNS, terminal.width - 4))
    modes = in_reading_order(report.modes[index])
    angles = "; ".join(mode_text(mode, terminal) for mode in modes[:4]) or "none"
    if len(modes) > 4:
        angles += f"; + {len(modes) - 4} more"
    return [
        *wrap(
            f"orientation given {name}: peak {density[peak]:.3g} per rad at {where} deg",
            terminal,
            "  ",
        ),
        *terminal.profile(columns, _CHART_ROWS),
        _ruler(len(columns)),
        *wrap(f"modes [deg]: {angles}", terminal, "  "),
    ]


def _resample(density: FloatArray, columns: int) -> FloatArray:
    """Density at ``columns`` angles from 0, keeping every peak: the greatest of its bins."""
    bins = len(density)
    if bins <= columns:
        at = np.arange(columns) * (bins / columns)
        return np.asarray(np.interp(at, np.arange(bins + 1), np.append(density, density[0])))
    # Column c stands for angles within half a column of 360 c / columns, so that the last
    # bins belong to the first column.
    column = np.rint(np.arange(bins) * (columns / bins)).astype(int) % columns
    greatest = np.zeros(columns)
    np.maximum.at(greatest, column, density)
    return greatest


def _ruler(columns: int) -> str:
    """Degrees under a chart, each starting at its column."""
    line = ""
    for angle in (0, 90, 180, 270):
        line = line.ljust(columns * angle // 360) + str(angle)
    return line.ljust(columns) + "360"


def history_text(
    history: Sequence[ObjectEstimate] | Sequence[CellReport],
    class_names: Sequence[str],
    terminal: Terminal,
) -> str:
    """One line a measurement: its labels, the probabilities and orientation after it.

    Classes have a column each, those most probable in the end first, as many as fit.
    The orientation is given the class most probable at that moment.

    Args:
        history: An object's estimates or a cell's reports, oldest first.
        class_names: Without the background.
        terminal: What the reader's terminal can show.
    """
    if not history:
        return "No history: no measurement has touched this."
    names = [terminal.clean(name) for name in class_names]
    order = np.argsort(-history[-1].class_probabilities[1:], kind="stable")
    start_ns = history[0].stamp_ns
    fixed = {
        "n": [str(step.measurements) for step in history],
        "t [s]": [seconds_text(step.stamp_ns - start_ns) for step in history],
        "labels": [
            ", ".join(terminal.clean(label) for label in step.labels) or "none" for step in history
        ],
        BACKGROUND: [probability_text(step.class_probabilities[0]) for step in history],
        "orientation [deg]": [_orientation_summary(step) for step in history],
    }
    classes = [
        [names[i], *(probability_text(step.class_probabilities[1 + i]) for step in history)]
        for i in order
    ]
    shown = _fitting(fixed, classes, terminal)
    before, last = list(fixed)[:-1], list(fixed)[-1]
    headings = [*before, *(column[0] for column in shown), last]
    columns = [*(fixed[name] for name in before), *(column[1:] for column in shown), fixed[last]]
    rows = list(zip(*columns, strict=True))
    align = ">><>" + ">" * len(shown) + "<"
    lines = table(headings, rows, align, terminal, elastic=(2, *range(4, 4 + len(shown))))
    if len(shown) < len(names):
        lines.append(f"{len(names) - len(shown)} of {len(names)} classes not shown")
    return "\n".join([f"t = 0 at {stamp_text(start_ns)}", "", *lines])


def _fitting(
    fixed: Mapping[str, Sequence[str]], classes: Sequence[Sequence[str]], terminal: Terminal
) -> Sequence[Sequence[str]]:
    """As many class columns, headings first, as fit beside the others; at least one."""
    room = terminal.width
    for name, cells in fixed.items():
        width = max(map(display_width, (name, *cells)))
        # Labels may be shortened to make room for classes, though not to nothing.
        room -= 2 + (min(width, _SHORTEST_LABELS) if name == "labels" else width)
    count = 0
    for column in classes:
        room -= 2 + max(map(display_width, column))
        if room < -2:
            break
        count += 1
    return classes[: max(count, 1)]


def _orientation_summary(step: ObjectEstimate | CellReport) -> str:
    """The two heaviest modes of the most probable class: ``56.3 (50 %), 236.3 (50 %)``."""
    modes: Sequence[OrientationMode]
    if isinstance(step, ObjectEstimate):
        modes = step.modes
    else:
        modes = step.modes[int(step.class_probabilities[1:].argmax())]
    if is_flat(modes):
        return "any (flat)"
    shown = in_reading_order(modes)[:2]
    parts = [f"{degrees_text(mode.orientation)} ({share_text(mode.mass)})" for mode in shown]
    return ", ".join(parts) + (f", + {len(modes) - 2}" if len(modes) > 2 else "")
