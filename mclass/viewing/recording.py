"""A recording for Rerun: maps, track, detections, objects and their beliefs on one time line.

Entities under ``world`` are placed in metres in the world frame, less `Contents.origin`;
``objects`` holds each object's probabilities and orientation densities, ``detections`` what
was returned. The time line is that of the header stamps.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
import rerun as rr

from mclass.classes import BACKGROUND
from mclass.outputs.colors import BACKGROUND_COLOR, CLASS_COLORS
from mclass.outputs.names import display_text
from mclass.outputs.raster import pack_cells
from mclass.outputs.scene import ObjectScene, arrow_length, object_scene
from mclass.records import FloatArray
from mclass.results import ClassMaps
from mclass.viewing.contents import BINS, Contents, ObjectContents
from mclass.viewing.entities import ABOUT, EVERYTHING, LIFT, MAP, TIMELINE, Paths, lifted, times
from mclass.viewing.measured import record_detections, record_track

_PAPER = (0xFF, 0xFF, 0xFF)


def record(recording: rr.RecordingStream, contents: Contents) -> None:
    """Send everything.

    Args:
        recording: Where to; its own clocks are switched off.
        contents: What is shown.
    """
    recording.set_log_tick_enabled(False)
    recording.set_log_time_enabled(False)
    paths = Paths.of(contents)
    size = arrow_length(contents.grid.cell_size)
    recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    recording.log(
        ABOUT, rr.TextDocument(about_text(contents), media_type="text/markdown"), static=True
    )
    for shown in contents.maps:
        _map(recording, contents, paths, shown)
    record_track(recording, contents, size)
    record_detections(recording, contents, size)
    for object_id, one in contents.objects.items():
        _object(recording, contents, paths, object_id, one, size)
        _belief(recording, contents, paths, object_id, one, size)


def about_text(contents: Contents) -> str:
    """What the output says of itself, as Markdown."""
    lines = [f"# {_plain(contents.name)}", ""]
    lines += [f"- {_plain(name)}: {_plain(text)}" for name, text in contents.facts.items()]
    lines += [f"- {_plain(note)}" for note in contents.notes]
    if contents.origin.any():
        x, y = contents.origin
        lines.append(f"- positions are shown less x {x:.0f} m, y {y:.0f} m")
    lines += ["", "P is a class's probability; on the map of one class black is 0 and white 1, and"]
    lines += ["what was not seen has the prior. Arrows point along an object's x axis, one a mode,"]
    lines += ["the paler the lighter the mode. Curves around an object are P(class) times"]
    lines += ["the orientation density given the class, by direction. All times are header stamps."]
    return "\n".join(lines)


def _map(recording: rr.RecordingStream, contents: Contents, paths: Paths, shown: ClassMaps) -> None:
    """The class maps of one moment: all mixed, and each as shades of grey."""
    recording.set_time(TIMELINE, timestamp=np.datetime64(shown.stamp_ns, "ns"))
    names = (BACKGROUND, *contents.class_names)
    grid = shown.grid
    corner = np.array(grid.origin) - contents.origin

    def raster(values: Any, model: rr.ColorModel, **settings: Any) -> rr.GridMap:
        # An image's first row is its uppermost, ours the lowest.
        image = np.ascontiguousarray(values.reshape(grid.rows, grid.columns, -1)[::-1])
        form = rr.components.ImageFormat(
            width=grid.columns,
            height=grid.rows,
            color_model=model,
            channel_datatype=rr.ChannelDatatype.from_np_dtype(image.dtype),
        )
        return rr.GridMap(
            data=image.tobytes(),
            format=form,
            cell_size=grid.cell_size,
            translation=[*corner, 0.0],
            **settings,
        )

    colors = pack_cells(shown, names).data[:, -4:]
    # Only what is not fully opaque is blended with what lies behind.
    recording.log(f"{MAP}/{EVERYTHING}", raster(colors, rr.ColorModel.RGBA, opacity=0.999))
    values = np.empty((grid.rows * grid.columns, len(names)), dtype=np.float32)
    values[:] = shown.untouched
    values[shown.cells] = shown.class_probabilities
    for index, part in enumerate((BACKGROUND, *paths.classes)):
        grey = raster(values[:, index], rr.ColorModel.L, colormap="grayscale")
        recording.log(f"{MAP}/{part}", grey)


def _object(
    recording: rr.RecordingStream,
    contents: Contents,
    paths: Paths,
    object_id: str,
    one: ObjectContents,
    size: float,
) -> None:
    """A box at the object's place, its spread, and an arrow a mode."""
    path = f"world/objects/{paths.objects[object_id]}"
    estimates = one.estimates
    scenes = [object_scene(estimate, contents.class_names) for estimate in estimates]
    index = [times([estimate.stamp_ns for estimate in estimates])]
    places = np.array([estimate.position for estimate in estimates]) - contents.origin
    colors = [_class_color(estimate.class_index) for estimate in estimates]
    side = 0.4 * size
    turns = [scene.arrows[0][0] if scene.arrows else 0.0 for scene in scenes]
    recording.log(
        path,
        rr.Boxes3D.from_fields(half_sizes=[[0.5 * side] * 3], fill_mode="solid"),
        static=True,
    )
    recording.send_columns(
        path,
        indexes=index,
        columns=rr.Boxes3D.columns(
            centers=lifted(places, 0.5 * side + 4.0 * LIFT * size),
            quaternions=[(0.0, 0.0, math.sin(t / 2.0), math.cos(t / 2.0)) for t in turns],
            colors=colors,
        ),
    )
    # A label has its element's colour, and a dark ground.
    recording.log(
        f"{path}/name",
        rr.Points3D.from_fields(colors=[_PAPER], radii=[1e-3 * size], show_labels=True),
        static=True,
    )
    recording.send_columns(
        f"{path}/name",
        indexes=index,
        columns=rr.Points3D.columns(
            positions=lifted(places + np.array([0.0, 0.7 * size]), side + 5.0 * LIFT * size),
            labels=[scene.text for scene in scenes],
        ),
    )
    counts = [len(scene.arrows) for scene in scenes]
    recording.log(f"{path}/modes", rr.Arrows3D.from_fields(radii=[0.04 * size]), static=True)
    recording.send_columns(
        f"{path}/modes",
        indexes=index,
        columns=rr.Arrows3D.columns(
            origins=np.repeat(lifted(places, side + 5.0 * LIFT * size), counts, axis=0),
            vectors=size * _arrows(scenes),
            colors=[
                _faded(color, opacity)
                for scene, color in zip(scenes, colors, strict=True)
                for _, opacity in scene.arrows
            ],
        ).partition(counts),
    )
    spreads = np.array([estimate.position_std for estimate in estimates])
    if spreads.any():
        flat = np.column_stack([2.0 * spreads, np.full(len(spreads), 1e-3 * size)])
        recording.send_columns(
            f"{path}/spread",
            indexes=index,
            columns=rr.Ellipsoids3D.columns(
                centers=lifted(places, 4.0 * LIFT * size), half_sizes=flat, colors=colors
            ),
        )


def _belief(
    recording: rr.RecordingStream,
    contents: Contents,
    paths: Paths,
    object_id: str,
    one: ObjectContents,
    size: float,
) -> None:
    """Class probabilities over time; orientation densities as bars and around the object."""
    path = f"objects/{paths.objects[object_id]}"
    colors = [_class_color(index) for index in range(len(contents.class_names))]
    names = (BACKGROUND, *map(display_text, contents.class_names))
    recording.log(
        f"{path}/probability",
        rr.SeriesLines(
            names=names,
            colors=[BACKGROUND_COLOR, *colors],
            widths=[2.0] * len(names),
            # A belief stays as it is until the next measurement.
            interpolation_mode="StepAfter",
        ),
        static=True,
    )
    # A dot a measurement: a line needs two of them.
    recording.log(
        f"{path}/probability",
        rr.SeriesPoints(
            names=names,
            colors=[BACKGROUND_COLOR, *colors],
            markers=["circle"] * len(names),
            marker_sizes=[3.0] * len(names),
        ),
        static=True,
    )
    recording.send_columns(
        f"{path}/probability",
        indexes=[times([estimate.stamp_ns for estimate in one.estimates])],
        columns=rr.Scalars.columns(
            scalars=np.array([estimate.class_probabilities for estimate in one.estimates])
        ),
    )
    degrees = np.arange(BINS) * 360.0 / BINS
    angles = np.linspace(0.0, 2.0 * np.pi, BINS + 1)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    highest = max(float(one.densities.max(initial=0.0)), 1e-9)
    for step, density in zip(one.steps, one.densities, strict=True):
        estimate = one.estimates[step]
        recording.set_time(TIMELINE, timestamp=np.datetime64(estimate.stamp_ns, "ns"))
        for part, curve, color in zip(paths.classes, density, colors, strict=True):
            recording.log(
                f"{path}/orientation/{part}",
                rr.BarChart(curve, abscissa=degrees, color=color),
            )
        radii = size * (0.5 + 1.5 * np.append(density, density[:, :1], axis=1) / highest)
        place = estimate.position - contents.origin
        roses = lifted(place + radii[..., None] * circle, 5.0 * LIFT * size)
        recording.log(
            f"world/objects/{paths.objects[object_id]}/rose",
            rr.LineStrips3D(list(roses), colors=colors, radii=rr.Radius.ui_points(1.5)),
        )


def _arrows(scenes: Iterable[ObjectScene]) -> FloatArray:
    """Unit vectors of all scenes' modes, (k, 3)."""
    turns = np.array([turn for scene in scenes for turn, _ in scene.arrows])
    return np.stack([np.cos(turns), np.sin(turns), np.zeros(len(turns))], axis=-1)


def _class_color(index: int) -> tuple[int, int, int]:
    return CLASS_COLORS[index % len(CLASS_COLORS)]


def _faded(color: tuple[int, int, int], opacity: float) -> tuple[int, ...]:
    """A colour as it looks on white: solids are not drawn transparent."""
    share = 0.15 + 0.85 * opacity
    return tuple(round(share * part + (1.0 - share) * 255.0) for part in color)


def _plain(text: str) -> str:
    """Foreign text without what Markdown would take for its own."""
    shown = display_text(text, 200)
    return "".join(f"\\{c}" if c in "\\`*_{}[]<>()#+!|" else c for c in shown)
