"""Likelihood fields over the plane (paper figures 1 to 3)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mclass.classes import ClassModel
from mclass.errors import UsageError
from mclass.geometry import inverse, rotate, transform_points
from mclass.plot.style import add_scale_bar, drawable, halo, styled
from mclass.records import FloatArray

_POINTS = 201
_MOST_PANELS = 64


@styled
def likelihood_figure(
    model: ClassModel,
    pairs: Sequence[tuple[int, int]] | None = None,
    half_width: float | None = None,
    unit: tuple[str, float] = ("m", 1.0),
    pose: Sequence[float] = (0.0, 0.0, 0.0),
) -> Figure:
    """p(label | class) by sensor position, a panel a pair.

    The object's arrow is its x axis: the angle of that in the world is its orientation,
    whichever of its sides a model file calls the front. All panels share one scale; the line
    is half of a panel's own peak. Bearings are taken as 0.

    Args:
        model: The classes.
        pairs: (class index, label index) of the panels; None for all, a row a class and a
            column a label.
        half_width: The field reaches this far from the object [m]; None takes in three
            standard deviations of every viewpoint.
        unit: Name of the length unit to draw in, and metres in one.
        pose: Of the object: x [m], y [m], orientation [rad]. At the origin positions are those
            in its own frame.

    Raises:
        UsageError: If there are more pairs than a figure can hold.
    """
    pairs, columns = _panels(model, pairs)
    unit_name, unit_metres = unit
    reach = (half_width or _reach(model)) / unit_metres
    axis = np.linspace(-reach, reach, _POINTS)
    pose_world_object = np.array(pose, dtype=np.float64)
    place = pose_world_object[:2] / unit_metres
    sensors = np.stack(np.meshgrid(axis, axis), axis=-1) * unit_metres + pose_world_object[:2]
    views = transform_points(inverse(pose_world_object), sensors)
    box = (place[0] - reach, place[0] + reach, place[1] - reach, place[1] + reach)
    fields = {
        pair: np.exp(model.likelihoods[pair].log_likelihood(views)) * unit_metres**2
        for pair in pairs
        if pair in model.likelihoods
    }
    top = max((float(field.max()) for field in fields.values()), default=1.0)
    rows = math.ceil(len(pairs) / columns)
    side = min(3.2, 12.0 / columns)
    figure = Figure(figsize=(side * columns + 1.2, side * rows + 1.2), layout="constrained")
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    panels = grid.ravel()
    image = None
    for axes, pair in zip(panels, pairs, strict=False):
        label, name = model.label_names[pair[1]], model.class_names[pair[0]]
        axes.set_title(f"label {drawable(label, 20)}\nof class {drawable(name, 20)}")
        axes.set_aspect("equal")
        axes.set(xlim=box[:2], ylim=box[2:])
        if pair not in fields:
            axes.set_facecolor("#eeeeee")
            axes.text(0.5, 0.75, "never returned", ha="center", transform=axes.transAxes)
        else:
            # Pixels are centred on the points where the field was evaluated.
            rim = reach / (_POINTS - 1)
            image = axes.imshow(
                fields[pair],
                origin="lower",
                extent=(box[0] - rim, box[1] + rim, box[2] - rim, box[3] + rim),
                cmap="Blues",
                vmin=0.0,
                vmax=top,
            )
            axes.set(xlim=box[:2], ylim=box[2:])
            _half_peak_line(axes, place[:, None] + axis, fields[pair])
            means = model.likelihoods[pair].mixture.means
            means = transform_points(pose_world_object, means) / unit_metres
            axes.plot(*means.T, "+", color="black", markersize=5, path_effects=halo())
        arrow = rotate(pose_world_object[2], np.array([0.3 * reach, 0.0]))
        _draw_object(axes, place, arrow)
        add_scale_bar(axes, unit_name)
    for axes in panels[len(pairs) :]:
        axes.set_axis_off()
    for axes in grid[-1]:
        axes.set_xlabel(f"x [{unit_name}]")
    for axes in grid[:, 0]:
        axes.set_ylabel(f"y [{unit_name}]")
    density_unit = f"1/({unit_name}² rad)" if model.has_bearing else f"1/{unit_name}²"
    if image is not None:
        figure.colorbar(image, ax=list(panels), label=f"likelihood [{density_unit}]", aspect=40)
    bearing = ", at bearing 0" if model.has_bearing else ""
    figure.suptitle(f"Likelihood of each label by sensor position{bearing}")
    x, y = place
    where = f"object at ({x:g}, {y:g}) {unit_name}" if place.any() else "object at 0"
    # In short lines: there may be one panel only.
    figure.supxlabel(
        f"{where}, seen from above\narrow: its x axis, whose angle in the world is its "
        "orientation\n+: viewpoints; line: half the panel's peak",
        fontsize="small",
    )
    return figure


def _panels(
    model: ClassModel, pairs: Sequence[tuple[int, int]] | None
) -> tuple[Sequence[tuple[int, int]], int]:
    """(class index, label index) of each panel, and how many stand side by side."""
    columns = len(model.label_names)
    if pairs is not None:
        columns = min(len(pairs), math.ceil(math.sqrt(len(pairs))))
    else:
        pairs = [(c, k) for c in range(len(model.class_names)) for k in range(columns)]
        if len(pairs) > _MOST_PANELS:
            pairs = sorted(model.likelihoods)
            columns = math.ceil(math.sqrt(len(pairs)))
    if not 0 < len(pairs) <= _MOST_PANELS:
        raise UsageError(
            f"a likelihood figure has 1 to {_MOST_PANELS} panels, one a class and label; "
            f"{len(pairs)} were asked for. Choose some of the classes."
        )
    return pairs, columns


def _reach(model: ClassModel) -> float:
    """Distance [m] within which every viewpoint has three standard deviations."""
    reaches = [
        np.max(
            np.abs(entry.mixture.means)
            + 3.0 * np.sqrt(np.diagonal(entry.mixture.covariances, axis1=1, axis2=2))
        )
        for entry in model.likelihoods.values()
    ]
    return float(max(reaches, default=1.0))


def _half_peak_line(axes: Axes, axis: FloatArray, field: FloatArray) -> None:
    """A contour at half of the field's own peak, where there is one; x and y of its points."""
    half = 0.5 * float(field.max())
    if field.min() < half:
        axes.contour(*axis, field, levels=[half], colors="#555555", linewidths=0.7)


def _draw_object(axes: Axes, place: FloatArray, arrow: FloatArray) -> None:
    """The object at its place, and its x axis."""
    axes.plot(*place, "o", color="black", markersize=4, path_effects=halo())
    x, y = place
    tip_x, tip_y = place + arrow
    axes.annotate(
        "",
        xy=(tip_x, tip_y),
        xytext=(x, y),
        arrowprops={"arrowstyle": "-|>", "color": "black", "path_effects": halo(3.0)},
    )
