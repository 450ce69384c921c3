"""Orientation densities, over the angle (paper figures 4 to 6, 9 to 11) and as a rose."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.projections.polar import PolarAxes
from matplotlib.ticker import MaxNLocator

from mclass.classes import BACKGROUND
from mclass.outputs.colors import class_color
from mclass.plot.style import (
    BACKGROUND_COLOR,
    class_line,
    drawable,
    halo,
    named_legend,
    styled,
)
from mclass.records import FloatArray
from mclass.results import CellReport
from mclass.text.values import count_text, degrees_text, probability_text

_MOST_PANELS = 8
_MOST_CLASSES = 6
_NOTHING = 5e-5
_LABELLED_MODES = 4
_LABELLED_MASS = 0.02


@styled
def orientation_figure(
    history: Sequence[CellReport], class_names: Sequence[str], subject: str = ""
) -> Figure:
    """P(class) p(orientation | class) after each measurement, and faintly before it.

    A panel a measurement; of a long history some, evenly chosen, the first and last among
    them. A first report without measurements is the prior: it is what the next panel's
    faint lines show and has no panel of its own.

    Args:
        history: Reports of one cell or object, oldest first.
        class_names: Without the background.
        subject: Whose orientation, for the title: ``object o1``.
    """
    after = [i for i, step in enumerate(history) if step.measurements > 0 or len(history) == 1]
    if len(after) > _MOST_PANELS:
        chosen = np.linspace(0, len(after) - 1, _MOST_PANELS).round().astype(int)
        after = [after[i] for i in chosen]
    columns = 1 if len(after) <= 3 else 2
    rows = max(math.ceil(len(after) / columns), 1)
    figure = Figure(figsize=(6.5 * columns, 2.3 * rows + 0.7), layout="constrained")
    what = "P(class) p(orientation | class) after each measurement, faintly before it"
    figure.suptitle(f"{drawable(subject, 60)}\n{what}" if subject else what)
    panels = figure.subplots(rows, columns, sharex=True, squeeze=False).ravel()
    if not after:
        panels[0].set_axis_off()
        panels[0].text(0.5, 0.5, "no measurement", ha="center", va="center")
        return figure
    # The same classes in every panel.
    shown = _worth_drawing([history[index] for index in after])
    for axes, index in zip(panels, after, strict=False):
        before = history[index - 1] if index else None
        _density_panel(axes, history[index], before, shown, class_names)
    for axes in panels[len(after) :]:
        axes.set_axis_off()
    for axes in panels[max(len(after) - columns, 0) : len(after)]:
        axes.set_xlabel("orientation [deg]")
        axes.tick_params(labelbottom=True)
    for axes in panels[: len(after) : columns]:
        axes.set_ylabel("density [1/rad]")
    return figure


def _worth_drawing(reports: Sequence[CellReport]) -> list[int]:
    """Classes that are probable at some time: the likeliest few of them, in the model's order."""
    highest = np.max([report.class_probabilities[1:] for report in reports], axis=0)
    order = np.argsort(-highest, kind="stable")[:_MOST_CLASSES]
    return sorted(int(index) for index in order if index == order[0] or highest[index] > _NOTHING)


def _density_panel(
    axes: Axes,
    step: CellReport,
    before: CellReport | None,
    shown: Sequence[int],
    class_names: Sequence[str],
) -> None:
    """One measurement: every class's curve, its probability in the legend."""
    handles: list[Artist] = []
    level = step.class_probabilities[0] / (2.0 * np.pi)
    handles.append(axes.axhline(level, color=BACKGROUND_COLOR, linewidth=1.0, linestyle=":"))
    names = [f"{probability_text(step.class_probabilities[0])}  {BACKGROUND}"]
    for index in shown:
        if before is not None:
            angles, curve = _joint_density(before, index)
            axes.plot(angles, curve, **class_line(index), linewidth=0.8, alpha=0.45)
        angles, curve = _joint_density(step, index)
        handles += axes.plot(angles, curve, **class_line(index), linewidth=1.6)
        probability = probability_text(step.class_probabilities[index + 1])
        names.append(f"{probability}  {drawable(class_names[index])}")
    hidden = len(class_names) - len(shown)
    if hidden:
        handles.append(Line2D([], [], linestyle=""))
        names.append(f"{hidden} more not drawn")
    axes.set(xlim=(0.0, 360.0), xticks=range(0, 361, 45))
    axes.set_ylim(0.0, 1.2 * axes.dataLim.y1)
    _mark_modes(axes, step)
    labels = ", ".join(drawable(label, 30) for label in step.labels) or "no label"
    count = f"{step.measurements}: " if step.measurements else "prior"
    axes.set_title(count + (labels if step.measurements else ""), loc="left")
    named_legend(axes, handles, names, loc="center left", bbox_to_anchor=(1.0, 0.5))


def _joint_density(step: CellReport, index: int) -> tuple[FloatArray, FloatArray]:
    """Angles [deg] from 0 to 360, both included, and P(class) p(orientation | class) there."""
    density = step.density[index]
    angles = np.linspace(0.0, 360.0, len(density) + 1)
    return angles, step.class_probabilities[index + 1] * np.append(density, density[0])


def _mark_modes(axes: Axes, step: CellReport) -> None:
    """Angles at the peaks of the most probable class."""
    named = int(step.class_probabilities[1:].argmax())
    angles, curve = _joint_density(step, named)
    for mode in step.modes[named][:_LABELLED_MODES]:
        if mode.mass < _LABELLED_MASS:
            continue
        at = math.degrees(mode.orientation) % 360.0
        axes.annotate(
            f"{degrees_text(mode.orientation)}°",
            xy=(at, float(np.interp(at, angles, curve))),
            xytext=(0, 5),
            textcoords="offset points",
            ha="left" if at < 15.0 else "right" if at > 345.0 else "center",
            fontsize=8,
            color=class_color(named),
            path_effects=halo(),
        )


@styled
def cell_figure(
    report: CellReport, class_names: Sequence[str], frame: str, object_id: str | None = None
) -> Figure:
    """Class probabilities as bars, orientation densities as a rose in the world frame.

    Args:
        report: The cell.
        class_names: Without the background.
        frame: World frame; 0° is its x axis, angles grow counter-clockwise.
        object_id: Whose belief it is; None for the grid's.
    """
    shown = _worth_drawing([report])
    figure = Figure(figsize=(8.0, 4.2), layout="constrained")
    bars, rose = figure.subplot_mosaic(
        [["bars", "rose"]], per_subplot_kw={"rose": {"projection": "polar"}}
    ).values()
    x, y = report.center
    owner = "" if object_id is None else f"object {drawable(object_id)}, "
    figure.suptitle(
        f"{owner}cell ({x:.2f}, {y:.2f}) m in {drawable(frame)}, "
        f"{count_text(report.measurements, 'measurement')}",
    )
    values = report.class_probabilities[[0, *(index + 1 for index in shown)]].tolist()
    colors = [BACKGROUND_COLOR, *(class_color(i) for i in shown)]
    names = [BACKGROUND, *(drawable(class_names[i]) for i in shown)]
    hidden = len(class_names) - len(shown)
    if hidden:
        values.append(1.0 - sum(values))
        colors.append("#d0d0d0")
        names.append(f"{hidden} others")
    drawn = bars.barh(range(len(values)), values, color=colors)
    bars.bar_label(drawn, [probability_text(value) for value in values], padding=3, fontsize=8)
    bars.set(xlim=(0.0, 1.15), xticks=np.linspace(0.0, 1.0, 6), xlabel="probability")
    bars.invert_yaxis()
    bars.set_yticks(range(len(values)), names)
    _rose(rose, report, shown)
    return figure


def _rose(axes: Axes, report: CellReport, shown: Sequence[int]) -> None:
    """p(orientation | class) around the circle."""
    assert isinstance(axes, PolarAxes)
    for index in shown:
        density = report.density[index]
        angles = np.linspace(0.0, 2.0 * np.pi, len(density) + 1)
        axes.plot(angles, np.append(density, density[0]), **class_line(index), linewidth=1.6)
    axes.set_ylim(bottom=0.0)
    axes.yaxis.set_major_locator(MaxNLocator(4))
    axes.set_title("p(orientation | class) [1/rad]")
    axes.set_rlabel_position(_emptiest_direction(report, shown))


def _emptiest_direction(report: CellReport, shown: Sequence[int]) -> float:
    """Degrees of the sector where the rose's curves are lowest: room for the radial labels."""
    highest = report.density[list(shown)].max(axis=0)
    bins = len(highest)
    width = max(bins // 8, 1)
    sector = np.array([np.roll(highest, -b)[:width].sum() for b in range(bins)])
    return 360.0 * (int(sector.argmin()) + 0.5 * (width - 1)) / bins
