"""The ground plane that figures are drawn on: its limits, where a robot went, where it looked."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.lines import Line2D

from mclass.plot.style import halo
from mclass.records import FloatArray, PoseTrack
from mclass.results import ClassMaps, ObjectEstimate

_RAY_COLOR = "#009E73"
_TRACK_POINTS = 5000
ARROW = 0.08
"""Length of a mode's arrow, of the larger side of the plane."""

Limits = tuple[float, float, float, float]
"""Least and greatest x, then y [m]."""


def draw_scene(
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


def limits_of(
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
    half_size += (3.0 * ARROW if objects else ARROW) * half_size.max()
    (x_0, y_0), (x_1, y_1) = middle - half_size, middle + half_size
    return float(x_0), float(x_1), float(y_0), float(y_1)


def label_plane(grid: npt.NDArray[np.object_], count: int) -> None:
    """Axis labels on the outer panels."""
    columns = grid.shape[1]
    for index, axes in enumerate(grid.ravel()[:count]):
        if index + columns >= count:
            axes.set_xlabel("x [m]")
            axes.tick_params(labelbottom=True)
        if index % columns == 0:
            axes.set_ylabel("y [m]")
