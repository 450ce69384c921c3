"""The ground plane from above: class-probability maps (paper figures 8 and 12) and objects."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import matplotlib
import numpy as np
import numpy.typing as npt
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import Colormap
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse, Patch

from mclass.classes import BACKGROUND
from mclass.errors import UsageError
from mclass.findings import Estimate
from mclass.geometry import opening_angles
from mclass.outputs.colors import class_color
from mclass.plot.labels import place_texts, text_size
from mclass.plot.style import (
    BACKGROUND_COLOR,
    CLASS_MARKERS,
    OBJECT_COLOR,
    TRACK_COLOR,
    add_scale_bar,
    drawable,
    halo,
    named_legend,
    styled,
)
from mclass.records import FloatArray, LabelMeasurements, PoseTrack
from mclass.results import ClassMaps, ObjectEstimate
from mclass.text.values import probability_text

_UNTOUCHED_COLOR = "#f8dcb0"
_RAY_COLOR = "#009E73"
_MOST_PANELS = 12
_LABELLED_MASS = 0.05
_TRACK_POINTS = 5000
_CROWD = 12
_ARROW = 0.08  # of the larger side of the plane
Limits = tuple[float, float, float, float]


def ray_segments(
    measurements: LabelMeasurements,
    max_range: float,
    footprint: Literal["cone", "ray"] = "cone",
    most: int = 100,
) -> FloatArray:
    """Where detections pointed: a segment for a ray, both edges for a cone.

    Args:
        measurements: Those without direction are left out.
        max_range: Length of the segments [m].
        footprint: What a box is on the ground; a ray is at its middle.
        most: Of more detections, only so many, evenly chosen.

    Returns:
        Start and end points in the world frame [m], (segments, 2, 2).
    """
    rows = np.flatnonzero(np.isfinite(measurements.directions).all(axis=1))
    if len(rows) > most:
        rows = rows[np.linspace(0, len(rows) - 1, most).round().astype(int)]
    starts = measurements.frames.poses_world_sensor[measurements.frame_index[rows], :2]
    right, left = measurements.directions[rows].T
    width = opening_angles(measurements.directions[rows])
    if footprint == "ray":
        directions = right + 0.5 * width
    else:
        is_cone = width > 0.0
        directions = np.concatenate([right, left[is_cone]])
        starts = np.concatenate([starts, starts[is_cone]])
    ends = starts + max_range * np.stack([np.cos(directions), np.sin(directions)], axis=-1)
    return np.stack([starts, ends], axis=1)


@styled
def map_figure(
    maps: ClassMaps,
    class_names: Sequence[str],
    frame: str,
    *,
    objects: Sequence[ObjectEstimate] = (),
    track: PoseTrack | None = None,
    rays: FloatArray | None = None,
) -> Figure:
    """P(class) over the grid, a panel a class: white is 0, black is 1.

    Cells that no measurement touched, which keep the prior, are tinted.

    Args:
        maps: Class probabilities.
        class_names: Without the background.
        frame: World frame.
        objects: Drawn with their ids, an arrow a mode.
        track: Where the sensor or robot went.
        rays: Segments [m], (n, 2, 2), as from `ray_segments`.
    """
    limits = _limits(maps, objects, track, rays)
    width, height = limits[1] - limits[0], limits[3] - limits[2]
    # Of many classes those that are probable somewhere; the background always.
    highest = maps.class_probabilities[:, 1:].max(axis=0, initial=0.0)
    chosen = np.sort(np.argsort(-highest, kind="stable")[: _MOST_PANELS - 1])
    shown = [0, *(int(index) + 1 for index in chosen)]
    count = len(shown)
    columns, panel = _best_layout(count, width / height)
    rows = math.ceil(count / columns)
    figure = Figure(
        figsize=(panel * columns + 1.0, (panel * height / width + 0.35) * rows + 1.0),
        layout="constrained",
    )
    figure.suptitle(f"Class probabilities in {drawable(frame)}")
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    colors = matplotlib.colormaps["Greys"].with_extremes(bad=_UNTOUCHED_COLOR)
    # A title shares its line with the scale bar: about nine letters fit an inch.
    letters = max(int(9.0 * panel) - len("P(), prior 0.0000"), 8)
    names = (BACKGROUND, *(drawable(name, letters) for name in class_names))
    size = _object_size(len(objects))
    ids = [drawable(estimate.object_id) for estimate in objects]
    places = _text_places(objects, ids, limits, size, panel)
    for axes, index in zip(grid.ravel(), shown, strict=False):
        image = _draw_map(axes, maps, index, colors)
        axes.set_facecolor(_UNTOUCHED_COLOR)
        prior = probability_text(maps.untouched[index])
        axes.set_title(f"P({names[index]}), prior {prior}", loc="left")
        handles = _draw_scene(axes, limits, track, rays, TRACK_COLOR)
        for estimate, name, place in zip(objects, ids, places, strict=True):
            # Hollow and without ellipse: what the cells say there is the point of the map.
            _draw_object(axes, estimate, limits, size, color=OBJECT_COLOR, marker="")
            _write(axes, estimate, name, place, size)
            handles["objects, arrows where they face"] = Line2D([], [], color=OBJECT_COLOR)
        add_scale_bar(axes, "m", above=True)
    for axes in grid.ravel()[count:]:
        axes.set_axis_off()
    _label_plane(grid, count)
    figure.colorbar(image, ax=list(grid.ravel()), label="probability", aspect=40)
    handles["not seen: prior"] = Patch(facecolor=_UNTOUCHED_COLOR, edgecolor="#888888")
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=4)
    return figure


def estimate_figure(found: Estimate) -> Figure:
    """What `map_figure` draws of an estimate.

    Raises:
        UsageError: If it has no maps.
    """
    if found.maps is None:
        raise UsageError("nothing to draw: no detection points anywhere on the grid")
    grid = found.model.grid
    return map_figure(
        found.maps,
        found.class_names,
        found.frame,
        objects=found.objects,
        track=found.track,
        rays=ray_segments(found.measurements, grid.max_range, grid.footprint),
    )


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
    limits = _limits(None, objects, track, None, narrowest=0.75)
    width, height = limits[1] - limits[0], limits[3] - limits[2]
    side = min(7.0, 7.0 * width / height)
    figure = Figure(figsize=(side + 0.6, side * height / width + 1.4), layout="constrained")
    axes = figure.subplots()
    figure.suptitle(f"Objects in {drawable(frame)}")
    if not objects:
        axes.text(0.5, 0.5, "no objects", ha="center", va="center", transform=axes.transAxes)
    handles = _draw_scene(axes, limits, track, None, BACKGROUND_COLOR)
    size = _object_size(len(objects))
    texts = [_object_text(one, class_names, short=len(objects) > _CROWD) for one in objects]
    places = _text_places(objects, texts, limits, size, side)
    for estimate, text, place in zip(objects, texts, places, strict=True):
        name = drawable(class_names[estimate.class_index])
        color = class_color(estimate.class_index)
        marker = CLASS_MARKERS[estimate.class_index % len(CLASS_MARKERS)]
        _draw_object(axes, estimate, limits, size, color=color, marker=marker)
        _write(axes, estimate, text, place, size)
        handles[name] = Line2D([], [], color=color, marker=marker, linestyle="")
    add_scale_bar(axes, "m", above=True)
    _label_plane(np.array([[axes]]), 1)
    if handles:
        named_legend(
            figure, list(handles.values()), list(handles), loc="outside lower center", ncols=4
        )
    return figure


def _best_layout(count: int, aspect: float) -> tuple[int, float]:
    """Columns and panel width [inch] that fill a page best with ``count`` panels."""
    layouts = []
    for columns in range(1, count + 1):
        rows = math.ceil(count / columns)
        panel = min(11.0 / columns, 8.0 * aspect / rows, 6.5)
        layouts.append((panel * math.sqrt(count / (rows * columns)), columns, panel))
    _, columns, panel = max(layouts)
    return columns, panel


def _draw_map(axes: Axes, maps: ClassMaps, index: int, colors: Colormap) -> AxesImage:
    """One class's probabilities as an image of the touched cells' surroundings."""
    grid = maps.grid
    row, column = np.divmod(maps.cells, grid.columns)
    row_0, column_0 = (int(row.min()), int(column.min())) if len(row) else (0, 0)
    shape = (
        int(row.max(initial=row_0)) - row_0 + 1,
        int(column.max(initial=column_0)) - column_0 + 1,
    )
    values = np.full(shape, np.nan, dtype=np.float32)
    values[row - row_0, column - column_0] = maps.class_probabilities[:, index]
    left = grid.origin[0] + column_0 * grid.cell_size
    bottom = grid.origin[1] + row_0 * grid.cell_size
    return axes.imshow(
        values,
        origin="lower",
        extent=(
            left,
            left + shape[1] * grid.cell_size,
            bottom,
            bottom + shape[0] * grid.cell_size,
        ),
        cmap=colors,
        vmin=0.0,
        vmax=1.0,
    )


def _draw_scene(
    axes: Axes,
    limits: Limits,
    track: PoseTrack | None,
    rays: FloatArray | None,
    track_color: str,
) -> dict[str, Artist]:
    """Rays and trajectory; returns legend handles by name."""
    handles: dict[str, Artist] = {}
    axes.set_aspect("equal")
    axes.set(xlim=limits[:2], ylim=limits[2:])
    if rays is not None and len(rays):
        alpha = float(np.clip(15.0 / len(rays), 0.1, 0.8))
        axes.add_collection(
            LineCollection(list(rays), colors=_RAY_COLOR, linewidths=0.7, alpha=alpha),
            autolim=False,
        )
        handles["detections"] = Line2D([], [], color=_RAY_COLOR, linewidth=1.0)
    if track is not None and len(track.stamps_ns):
        step = -(-len(track.stamps_ns) // _TRACK_POINTS)
        x, y = track.poses_world_child[::step, :2].T
        line = axes.plot(x, y, color=track_color, linewidth=1.2, path_effects=halo(2.5))
        axes.plot(x[:1], y[:1], "o", color=track_color, markersize=4, path_effects=halo(2.5))
        handles["track, from its dot"] = line[0]
    return handles


def _draw_object(
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
    return size * _ARROW * max(limits[1] - limits[0], limits[3] - limits[2])


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


def _text_places(
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


def _write(axes: Axes, estimate: ObjectEstimate, text: str, place: FloatArray, size: float) -> None:
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


def _object_size(count: int) -> float:
    """How large objects are drawn: 1, less in a crowd."""
    return min(1.0, math.sqrt(_CROWD / max(count, 1)))


def _limits(
    maps: ClassMaps | None,
    objects: Sequence[ObjectEstimate],
    track: PoseTrack | None,
    rays: FloatArray | None,
    narrowest: float = 0.25,
) -> Limits:
    """Ranges of x and y [m] that hold everything drawn, with a margin; at least a metre wide.

    The shorter side is ``narrowest`` of the longer one or more.
    """
    two_sigma = np.array([[2.0], [-2.0]])
    points = [estimate.position + two_sigma * estimate.position_std for estimate in objects]
    if track is not None:
        points.append(track.poses_world_child[:, :2])
    if rays is not None:
        points.append(rays[:, 0])
    if maps is not None:
        grid = maps.grid
        half = 0.5 * grid.cell_size
        centers = grid.centers(maps.cells)
        points += [centers - half, centers + half]
        if not len(maps.cells):
            size = grid.cell_size * np.array([grid.columns, grid.rows])
            points.append(np.array([grid.origin, np.array(grid.origin) + size]))
    everything = np.concatenate(points) if points else np.zeros((1, 2))
    low, high = everything.min(axis=0), everything.max(axis=0)
    middle, half_size = (low + high) / 2.0, np.maximum((high - low) / 2.0, 0.5)
    half_size = np.maximum(half_size, narrowest * half_size.max())
    half_size += (3.0 * _ARROW if objects else _ARROW) * half_size.max()
    (x_0, y_0), (x_1, y_1) = middle - half_size, middle + half_size
    return float(x_0), float(x_1), float(y_0), float(y_1)


def _label_plane(grid: npt.NDArray[np.object_], count: int) -> None:
    """Axis labels on the outer panels."""
    columns = grid.shape[1]
    for index, axes in enumerate(grid.ravel()[:count]):
        if index + columns >= count:
            axes.set_xlabel("x [m]")
            axes.tick_params(labelbottom=True)
        if index % columns == 0:
            axes.set_ylabel("y [m]")
