"""Objects from above: places, orientations and what they are."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse

from mclass.outputs.colors import class_color
from mclass.plot.labels import place_texts, text_size
from mclass.plot.plane import ARROW, Limits, draw_scene, label_plane, limits_of
from mclass.plot.style import (
    BACKGROUND_COLOR,
    CLASS_MARKERS,
    add_scale_bar,
    drawable,
    halo,
    named_legend,
    styled,
)
from mclass.records import FloatArray, PoseTrack
from mclass.results import ObjectEstimate
from mclass.text.values import probability_text

_LABELLED_MASS = 0.05
_CROWD = 12


@styled
def objects_figure(
    objects: Sequence[ObjectEstimate],
    class_names: Sequence[str],
    frame: str,
    track: PoseTrack | None = None,
) -> Figure:
    """Objects from above: place with its two-sigma ellipse, an arrow a mode, class, P.

    Args:
        objects: Latest estimate of each.
        class_names: Without the background.
        frame: World frame.
        track: Where the sensor or robot went.
    """
    # Room at the sides for texts that are longer than arrows.
    limits = limits_of(None, objects, track, None, narrowest=0.75)
    width, height = limits[1] - limits[0], limits[3] - limits[2]
    side = min(7.0, 7.0 * width / height)
    figure = Figure(figsize=(side + 0.6, side * height / width + 1.4), layout="constrained")
    axes = figure.subplots()
    figure.suptitle(f"Objects in {drawable(frame)}")
    if not objects:
        axes.text(0.5, 0.5, "no objects", ha="center", va="center", transform=axes.transAxes)
    handles = draw_scene(axes, limits, track, None, BACKGROUND_COLOR)
    size = object_size(len(objects))
    texts = [_object_text(one, class_names, short=len(objects) > _CROWD) for one in objects]
    places = text_places(objects, texts, limits, size, side)
    for estimate, text, place in zip(objects, texts, places, strict=True):
        name = drawable(class_names[estimate.class_index])
        color = class_color(estimate.class_index)
        marker = CLASS_MARKERS[estimate.class_index % len(CLASS_MARKERS)]
        draw_object(axes, estimate, limits, size, color=color, marker=marker)
        write_text(axes, estimate, text, place, size)
        handles[name] = Line2D([], [], color=color, marker=marker, linestyle="")
    add_scale_bar(axes, "m", above=True)
    label_plane(np.array([[axes]]), 1)
    if handles:
        named_legend(
            figure, list(handles.values()), list(handles), loc="outside lower center", ncols=4
        )
    return figure


def draw_object(
    axes: Axes,
    estimate: ObjectEstimate,
    limits: Limits,
    size: float,
    *,
    color: str | tuple[float, float, float],
    marker: str,
) -> None:
    """An arrow a mode, as opaque as it is heavy; with a marker also its place.

    The place is the marker and a two-sigma ellipse; without a marker it is a ring.
    """
    x, y = estimate.position
    length = _arrow_length(limits, size)
    spread_x, spread_y = 4.0 * estimate.position_std
    if marker and (spread_x > 0.0 or spread_y > 0.0):
        axes.add_patch(
            Ellipse((x, y), spread_x, spread_y, fill=False, edgecolor=color, linewidth=0.8)
        )
    for mode in estimate.modes:
        axes.annotate(
            "",
            xy=(x + length * math.cos(mode.orientation), y + length * math.sin(mode.orientation)),
            xytext=(x, y),
            arrowprops={
                "arrowstyle": "-|>",
                "color": color,
                "alpha": float(np.clip(mode.mass, 0.1, 1.0)),
                "linewidth": 1.5 * size,
                "mutation_scale": 10.0 * size,
                "shrinkA": 0.0 if marker else 3.5 * size,
                "shrinkB": 0.0,
            },
        )
    if marker:
        axes.plot(x, y, marker, color=color, markersize=6.0 * size, path_effects=halo())
    else:
        axes.plot(x, y, "o", color=color, markersize=7.0 * size, fillstyle="none")


def _arrow_length(limits: Limits, size: float) -> float:
    """Of a mode's arrow [m]."""
    return size * ARROW * max(limits[1] - limits[0], limits[3] - limits[2])


def _font_size(size: float) -> float:
    return max(8.0 * size, 5.0)


def _object_text(estimate: ObjectEstimate, class_names: Sequence[str], *, short: bool) -> str:
    """An object's id and, unless short, its class and how probable that is."""
    text = drawable(estimate.object_id)
    if short:
        return text
    if estimate.unexplained:
        return f"{text}\nunexplained"
    tie = "tie: " if estimate.tie else ""
    probability = probability_text(estimate.class_probabilities[estimate.class_index + 1])
    return f"{text}\n{tie}{drawable(class_names[estimate.class_index])} {probability}"


def text_places(
    objects: Sequence[ObjectEstimate],
    texts: Sequence[str],
    limits: Limits,
    size: float,
    inches: float,
) -> FloatArray:
    """Where the objects' texts go, from their places [point], (n, 2); axes as wide as told."""
    corner, extent = np.array(limits[::2]), np.array([limits[1] - limits[0], limits[3] - limits[2]])
    scale = 72.0 * inches / extent[0]
    anchors = np.array([estimate.position for estimate in objects]).reshape(-1, 2)
    along = np.linspace(0.25, 1.0, 4)[:, None] * _arrow_length(limits, size)
    arrows = [
        estimate.position + along * (math.cos(mode.orientation), math.sin(mode.orientation))
        for estimate in objects
        for mode in estimate.modes
        if mode.mass >= _LABELLED_MASS
    ]
    points = np.concatenate([anchors, *arrows])[len(anchors) :]
    width, height = scale * extent
    return place_texts(
        scale * (anchors - corner),
        [text_size(text, _font_size(size)) for text in texts],
        scale * (points - corner),
        (float(width), float(height)),
        6.0 * size,
    )


def write_text(
    axes: Axes, estimate: ObjectEstimate, text: str, place: FloatArray, size: float
) -> None:
    """An object's text, its lower left corner at a place from the object [point]."""
    x, y = estimate.position
    axes.annotate(
        text,
        xy=(x, y),
        xytext=(float(place[0]), float(place[1])),
        textcoords="offset points",
        ha="left",
        va="bottom",
        fontsize=_font_size(size),
        path_effects=halo(),
    )


def object_size(count: int) -> float:
    """How large objects are drawn: 1, less in a crowd."""
    return min(1.0, math.sqrt(_CROWD / max(count, 1)))
