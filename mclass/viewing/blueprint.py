"""How Rerun lays a recording out: the map from above, and each object's belief beside it."""

from __future__ import annotations

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from mclass.classes import BACKGROUND
from mclass.outputs.names import display_text
from mclass.records import FloatArray
from mclass.viewing.contents import Contents
from mclass.viewing.entities import (
    ABOUT,
    DETECTIONS,
    EVERYTHING,
    LABELS,
    MAP,
    TIMELINE,
    Paths,
)

_MOST_MAPS = 12
_MOST_OBJECTS = 60
_MOST_LEGEND = 7
"""More series than this, and their legend would hide them; the mouse still tells which is which."""

_STACKED = 3
"""So many objects are seen at once, of more one behind the other."""

_HEIGHT_SEEN = 1.04
"""Height that the 3D view shows of what lies one metre before its eye [m]."""

_ASPECT = 1.1
"""Width over height of the map's panel, on a common screen."""

_PAPER = (0xFF, 0xFF, 0xFF)
_SHADE = (0xE8, 0xE8, 0xE8)
_LINES = (0x00, 0x00, 0x00, 0x28)


def blueprint(contents: Contents) -> rrb.Blueprint:
    """The layout of a recording of these contents."""
    paths = Paths.of(contents)
    eye = _eye(contents)
    shown: list[tuple[str, str]] = [("all classes", EVERYTHING)] if contents.maps else [("map", "")]
    if contents.maps:
        names = (BACKGROUND, *map(display_text, contents.class_names))
        shown += zip(
            [f"P({name})" for name in names[:_MOST_MAPS]],
            (BACKGROUND, *paths.classes),
            strict=False,
        )
    maps = [_map_view(name, part, eye) for name, part in shown]
    chosen = list(contents.objects)[:_MOST_OBJECTS]
    span = _span(contents)
    legend = rrb.PlotLegend("LeftTop", visible=len(paths.classes) < _MOST_LEGEND)
    objects = [_object_view(display_text(key), paths.objects[key], span, legend) for key in chosen]
    words = rrb.Tabs(
        rrb.TextLogView(
            origin="/" + LABELS,
            name="Detections",
            columns=rrb.TextLogColumns(text_log_columns=["Body"]),
        ),
        rrb.TextDocumentView(origin="/" + ABOUT, name="About"),
        name="log",
    )
    beside: list[rrb.Container | rrb.View] = []
    if len(objects) <= _STACKED:
        beside += objects
    else:
        beside.append(rrb.Tabs(*objects, active_tab=0, name="objects"))
    side = rrb.Vertical(*beside, words, row_shares=[*([3.0] * len(beside)), 1.5])
    return rrb.Blueprint(
        rrb.Horizontal(rrb.Tabs(*maps, active_tab=0, name="maps"), side, column_shares=[3, 2]),
        # The end is the result; the way there is one drag away.
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        auto_views=False,
        auto_layout=False,
    )


def _map_view(name: str, part: str, eye: rrb.EyeControls3D) -> rrb.Spatial3DView:
    """The world from above, with one of the maps."""
    contents = ["+ /world/**", f"- /{MAP}/**"]
    if part:
        contents.append(f"+ /{MAP}/{part}")
    until_now = rrb.VisibleTimeRange(
        TIMELINE,
        start=rrb.TimeRangeBoundary.infinite(),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )
    return rrb.Spatial3DView(
        origin="/world",
        contents=contents,
        name=name,
        background=_PAPER if part in ("", EVERYTHING) else _SHADE,
        line_grid=rrb.LineGrid3D(visible=True, spacing=1.0, color=_LINES),
        eye_controls=eye,
        overrides={f"{DETECTIONS}/before": rrb.VisibleTimeRanges(until_now)},
    )


def _object_view(
    name: str, part: str, span: rrb.TimeRange | None, legend: rrb.PlotLegend
) -> rrb.Horizontal:
    """Class probabilities over time, and the orientation density at the time shown."""
    return rrb.Horizontal(
        rrb.TimeSeriesView(
            origin=f"/objects/{part}/probability",
            name=f"{name}: P(class)",
            axis_x=rrb.TimeAxis(view_range=span),
            axis_y=rrb.ScalarAxis(range=(0.0, 1.02), zoom_lock=True),
            plot_legend=legend,
        ),
        # Its colours are those of the plot beside it.
        rrb.BarChartView(
            origin=f"/objects/{part}/orientation",
            name=f"{name}: orientation [deg]",
            plot_legend=rrb.PlotLegend(visible=False),
        ),
        name=name,
    )


def _span(contents: Contents) -> rrb.TimeRange | None:
    """From the first frame to the last, the same for all plots."""
    stamps = contents.measurements.frames.stamps_ns
    if not len(stamps):
        return None
    margin = int(stamps[-1] - stamps[0]) // 20
    first, last = (
        rrb.TimeRangeBoundary.absolute(rr.TimeInt(nanos=stamp))
        for stamp in (int(stamps[0]) - margin, int(stamps[-1]) + margin)
    )
    return rrb.TimeRange(first, last)


def _eye(contents: Contents) -> rrb.EyeControls3D:
    """Straight down onto everything, x to the right and y up."""
    places = [contents.track.poses_world_child[:, :2]]
    places += [one.latest.position[None] for one in contents.objects.values()]
    for shown in contents.maps[-1:]:
        half = 0.5 * shown.grid.cell_size
        centers = shown.grid.centers(shown.cells)
        places += [centers - half, centers + half]
    everything: FloatArray = np.concatenate(places) - contents.origin
    everything = everything[np.isfinite(everything).all(axis=1)]
    if not len(everything):
        everything = np.zeros((1, 2))
    low, high = everything.min(axis=0), everything.max(axis=0)
    middle = 0.5 * (low + high)
    width, height = np.maximum(high - low, 2.0) * 1.1
    distance = float(max(height, width / _ASPECT)) / _HEIGHT_SEEN
    return rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital,
        position=[*middle, distance],
        look_target=[*middle, 0.0],
        eye_up=[0.0, 1.0, 0.0],
    )
