"""A log at a glance: where the robot went, and what was detected when."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mclass.logs.survey import Course, Survey
from mclass.outputs.colors import class_color
from mclass.plot.style import (
    BACKGROUND_COLOR,
    OBJECT_COLOR,
    TRACK_COLOR,
    add_scale_bar,
    drawable,
    halo,
    named_legend,
    styled,
)
from mclass.records import FloatArray
from mclass.text.values import stamp_text

_MOST_LABELS = 15
_MOST_POINTS = 5000


@styled
def log_figure(survey: Survey) -> Figure:
    """The track with the places where something was detected; each label over time.

    Args:
        survey: Of a log.
    """
    figure = Figure(figsize=(12.0, 5.2), layout="constrained")
    where, when = figure.subplots(1, 2, width_ratios=(1.0, 1.3))
    course = survey.course
    if course is None or not len(course.looks_ns) + len(course.track.stamps_ns):
        for axes in (where, when):
            axes.set_axis_off()
        figure.suptitle("no poses and no detections")
        return figure
    _draw_track(where, course, survey)
    _draw_labels(when, course, list(survey.labels))
    return figure


def _draw_track(axes: Axes, course: Course, survey: Survey) -> None:
    """From above, true to scale."""
    axes.set_aspect("equal", adjustable="datalim")
    track = course.track.poses_world_child[:: -(-len(course.track.stamps_ns) // _MOST_POINTS) or 1]
    if not len(track):
        axes.set_axis_off()
        axes.text(0.5, 0.5, "no poses", ha="center", va="center", transform=axes.transAxes)
        return
    x, y = track[:, :2].T
    handles = axes.plot(x, y, color=TRACK_COLOR, linewidth=1.2)
    names = [f"track of {drawable(survey.robot_frame or 'the robot')}, from its dot"]
    axes.plot(x[:1], y[:1], "o", color=TRACK_COLOR, markersize=7, path_effects=halo(3.0), zorder=5)
    seen = np.zeros(len(course.looks_ns), dtype=bool)
    seen[course.label_looks] = True
    for looks, color, marker, name in (
        (course.covered & ~seen, BACKGROUND_COLOR, ".", "frame without detection"),
        (course.covered & seen, OBJECT_COLOR, "o", "frame with detections"),
    ):
        if looks.any():
            places = course.poses_world_child[looks]
            handles += axes.plot(
                *places[:: -(-len(places) // _MOST_POINTS), :2].T,
                marker,
                color=color,
                markersize=3.0,
                path_effects=halo(),
                linestyle="",
            )
            names.append(name)
    _no_thinner_than(axes, 1.0)
    axes.set(xlabel="x [m]", ylabel="y [m]")
    axes.set_title(f"in {drawable(survey.world_frame or 'the world')}", loc="left")
    named_legend(axes, handles, names, loc="upper center", bbox_to_anchor=(0.5, -0.12))
    add_scale_bar(axes, "m", above=True)


def _no_thinner_than(axes: Axes, least: float) -> None:
    """Limits around the data with a margin, at least so wide [m]; set once and for all."""
    axes.autoscale_view()
    box = axes.dataLim
    half = max(0.54 * max(box.width, box.height), 0.5 * least)
    axes.set_aspect("equal", adjustable="box")
    x, y = 0.5 * (box.x0 + box.x1), 0.5 * (box.y0 + box.y1)
    axes.set(xlim=(x - half, x + half), ylim=(y - half, y + half))


def _draw_labels(axes: Axes, course: Course, labels: list[str]) -> None:
    """A row a label, a line a detection; what no pose covers is below."""
    stamps, track = course.looks_ns, course.track.stamps_ns
    both = np.concatenate([stamps, track])
    start = int(both.min())
    seconds = (stamps - start) / 1e9
    rows = labels[:_MOST_LABELS]
    names = [drawable(name, 20) for name in rows]
    for index in range(len(rows)):
        at = seconds[course.label_looks[course.labels == index]]
        _ticks(axes, at, index, class_color(index))
        names[index] += f"  {len(at)}"
    seen = np.zeros(len(stamps), dtype=bool)
    seen[course.label_looks] = True
    rest = [("frames without detection", ~seen), ("frames without pose", ~course.covered)]
    for name, chosen in rest:
        if chosen.any():
            _ticks(axes, seconds[chosen], len(names), BACKGROUND_COLOR)
            names.append(f"{name}  {int(chosen.sum())}")
    if len(track):
        ends = (track[[0, -1]] - start) / 1e9
        axes.axvspan(*ends, color=TRACK_COLOR, alpha=0.08, linewidth=0.0)
        axes.text(
            float(ends[0]), -0.75, " poses", color=TRACK_COLOR, fontsize=8, va="center", ha="left"
        )
    if len(labels) > len(rows):
        names.append(f"{len(labels) - len(rows)} more labels")
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.4, -1.1)
    last = (int(both.max()) - start) / 1e9
    margin = max(0.02 * last, 1e-3)
    axes.set_xlim(-margin, last + margin)
    axes.set_xlabel(f"time [s] since {stamp_text(start)}")
    axes.set_title("detections by label (numbers: how many)", loc="left")


def _ticks(
    axes: Axes, seconds: FloatArray, row: int, color: str | tuple[float, float, float]
) -> None:
    """A short line at each time, of very many at some."""
    step = math.ceil(len(seconds) / _MOST_POINTS) or 1
    axes.vlines(seconds[::step], row - 0.35, row + 0.35, colors=color, linewidth=0.9)
