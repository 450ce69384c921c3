"""Class-probability maps of the ground plane (paper figures 8 and 12)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Colormap
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from mclass.classes import BACKGROUND
from mclass.errors import UsageError
from mclass.findings import Estimate
from mclass.geometry import opening_angles
from mclass.plot.objects import draw_object, object_size, text_places, write_text
from mclass.plot.plane import draw_scene, label_plane, limits_of
from mclass.plot.style import (
    OBJECT_COLOR,
    TRACK_COLOR,
    add_scale_bar,
    drawable,
    styled,
)
from mclass.records import FloatArray, LabelMeasurements, PoseTrack
from mclass.results import ClassMaps, ObjectEstimate
from mclass.text.values import probability_text

_UNTOUCHED_COLOR = "#f8dcb0"
_MOST_PANELS = 12


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
    limits = limits_of(maps, objects, track, rays)
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
    size = object_size(len(objects))
    ids = [drawable(estimate.object_id) for estimate in objects]
    places = text_places(objects, ids, limits, size, panel)
    for axes, index in zip(grid.ravel(), shown, strict=False):
        image = _draw_map(axes, maps, index, colors)
        axes.set_facecolor(_UNTOUCHED_COLOR)
        prior = probability_text(maps.untouched[index])
        axes.set_title(f"P({names[index]}), prior {prior}", loc="left")
        handles = draw_scene(axes, limits, track, rays, TRACK_COLOR)
        for estimate, name, place in zip(objects, ids, places, strict=True):
            # Hollow and without ellipse: what the cells say there is the point of the map.
            draw_object(axes, estimate, limits, size, color=OBJECT_COLOR, marker="")
            write_text(axes, estimate, name, place, size)
            handles["objects, arrows where they face"] = Line2D([], [], color=OBJECT_COLOR)
        add_scale_bar(axes, "m", above=True)
    for axes in grid.ravel()[count:]:
        axes.set_axis_off()
    label_plane(grid, count)
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
