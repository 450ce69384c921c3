"""Likelihood fields over the plane (paper figures 1 to 3)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mclass.classes import ClassModel
from mclass.errors import UsageError
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
) -> Figure:
    """p(label | class) by sensor position in the object's frame, a panel a pair.

    The object stands at the origin. Its arrow is its x axis: the angle of that in the world is
    its orientation, whichever of its sides a model file calls the front. All panels share one
    scale; the line is half of a panel's own peak. Bearings are taken as 0.

    Args:
        model: The classes.
        pairs: (class index, label index) of the panels; None for all, a row a class and a
            column a label.
        half_width: The field reaches this far from the object [m]; None takes in three
            standard deviations of every viewpoint.
        unit: Name of the length unit to draw in, and metres in one.

    Raises:
        UsageError: If there are more pairs than a figure can hold.
    """
    if pairs is None:
        pairs = [
            (c, k) for c in range(len(model.class_names)) for k in range(len(model.label_names))
        ]
        columns = len(model.label_names)
        if len(pairs) > _MOST_PANELS:
            pairs = sorted(model.likelihoods)
            columns = math.ceil(math.sqrt(len(pairs)))
    else:
        columns = min(len(pairs), math.ceil(math.sqrt(len(pairs))))
    if not 0 < len(pairs) <= _MOST_PANELS:
        raise UsageError(
            f"a likelihood figure has 1 to {_MOST_PANELS} panels, one a class and label; "
            f"{len(pairs)} were asked for. Choose some of the classes."
        )
    unit_name, unit_metres = unit
    reach = (half_width or _reach(model)) / unit_metres
    axis = np.linspace(-reach, reach, _POINTS)
    views = np.stack(np.meshgrid(axis, axis), axis=-1) * unit_metres
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
        axes.set(xlim=(-reach, reach), ylim=(-reach, reach))
        if pair not in fields:
            axes.set_facecolor("#eeeeee")
            axes.text(0.5, 0.75, "never returned", ha="center", transform=axes.transAxes)
        else:
            # Pixels are centred on the points where the field was evaluated.
            rim = reach * (1.0 + 1.0 / (_POINTS - 1))
            image = axes.imshow(
                fields[pair],
                origin="lower",
                extent=(-rim, rim, -rim, rim),
                cmap="Blues",
                vmin=0.0,
                vmax=top,
            )
            axes.set(xlim=(-reach, reach), ylim=(-reach, reach))
            _half_peak_line(axes, axis, fields[pair])
            means = model.likelihoods[pair].mixture.means / unit_metres
            axes.plot(*means.T, "+", color="black", markersize=5, path_effects=halo())
        _draw_object(axes, reach)
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
    figure.supxlabel(
        "object at 0, seen from above; arrow: its x axis, whose angle in the world is its "
        "orientation\n+: viewpoints; line: half the panel's peak",
        fontsize="small",
    )
    return figure


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
    """A contour at half of the field's own peak, where there is one."""
    half = 0.5 * float(field.max())
    if field.min() < half:
        axes.contour(axis, axis, field, levels=[half], colors="#555555", linewidths=0.7)


def _draw_object(axes: Axes, reach: float) -> None:
    """The object at the origin, and its x axis."""
    axes.plot(0.0, 0.0, "o", color="black", markersize=4, path_effects=halo())
    axes.annotate(
        "",
        xy=(0.3 * reach, 0.0),
        xytext=(0.0, 0.0),
        arrowprops={"arrowstyle": "-|>", "color": "black", "path_effects": halo(3.0)},
    )
