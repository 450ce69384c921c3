"""Viewer layouts for Foxglove and Lichtblick: the map from above, plots, and the objects.

Topics are hidden by default in these viewers, and a map can only be drawn in a frame that is
known; a layout names both.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Any, TypeAlias

from mclass.classes import BACKGROUND
from mclass.footprint import Grid
from mclass.outputs.colors import CLASS_COLORS, hex_color

Json: TypeAlias = dict[str, Any]

_VIEW = "3D!mclass"
_PLOT = "Plot!mclass"
_STATES = "StateTransitions!mclass"
_MESSAGES = "RawMessages!mclass"
_MOST_SERIES = 12
_DEFAULT_WIDTH = 12.0
_MARGIN = 1.25
_MOST_LINES = 200
"""Of the grid of metres; more would make a surface of it."""

_TITLE_KEYS = ("lichtblickPanelTitle", "foxglovePanelTitle")
"""Each of the viewers reads its own."""

_PLAIN_TOPIC = re.compile(r"[A-Za-z0-9_/-]+")


def layout_for(
    frame: str,
    classes: Sequence[str],
    *,
    encoding: str = "",
    prefix: str = "/mclass",
    topics: Sequence[str] = (),
    object_ids: Sequence[str] = (),
    grid: Grid | None = None,
) -> Json:
    """A layout as JSON can hold it.

    Args:
        frame: Frame to show everything in; empty lets the viewer choose.
        classes: Names without the background.
        encoding: ``ros2``, ``protobuf`` or ``json``; empty makes a layout that suits all.
        prefix: Of all topics.
        topics: Topics of the output; the maps of classes and the poses among them are listed.
        object_ids: Objects to plot the class probabilities of; the first one's when empty.
        grid: What the view shows; the surroundings of the origin when None.
    """
    shown: Json = {}
    if encoding != "ros2":
        shown[f"{prefix}/scene"] = {"visible": True}
    if encoding in ("ros2", ""):
        shown[f"{prefix}/markers"] = {"visible": True}
    shown[f"{prefix}/grid"] = {
        "visible": True,
        "frameLocked": True,
        "colorMode": "rgba-fields",
        "colorField": f"p_{classes[0] if classes else BACKGROUND}",
        "minValue": 0,
        "maxValue": 1,
    }
    # The map of the background comes first, in grey.
    maps = [topic for topic in topics if topic.startswith(f"{prefix}/grid/")]
    for index, topic in enumerate(maps):
        color = CLASS_COLORS[(index - 1) % len(CLASS_COLORS)] if index else (0x44, 0x44, 0x44)
        shown[topic] = _occupancy_settings(hex_color(color))
    for topic in topics:
        if topic.startswith(f"{prefix}/pose/"):
            # Arrows of the same poses are in the markers: these stand by.
            shown[topic] = {"visible": False, "type": "axis", "axisScale": 0.5}

    source = _topic_path(f"{prefix}/{'estimates' if encoding == 'ros2' else 'objects'}")
    return {
        "configById": {
            _VIEW: _view(frame, shown, grid),
            _PLOT: _plot(source, classes, object_ids),
            _STATES: _states(source, object_ids),
            _MESSAGES: {
                "topicPath": source,
                "diffEnabled": False,
                "diffMethod": "previous message",
                "diffTopicPath": "",
                "showFullMessageForDiff": False,
            },
        },
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": {
            "direction": "row",
            "first": _VIEW,
            "second": {
                "direction": "column",
                "first": _PLOT,
                "second": {
                    "direction": "column",
                    "first": _STATES,
                    "second": _MESSAGES,
                    "splitPercentage": 40,
                },
                "splitPercentage": 45,
            },
            "splitPercentage": 65,
        },
    }


def _occupancy_settings(color: str) -> Json:
    """One class's map, hidden: it would lie in the same plane as the map of all."""
    return {
        "visible": False,
        "frameLocked": True,
        "colorMode": "custom",
        "minColor": f"{color}00",
        "maxColor": f"{color}ff",
        "unknownColor": "#00000000",
        "invalidColor": "#ff00ffff",
    }


def _view(frame: str, topics: Json, grid: Grid | None) -> Json:
    """The 3D panel, looking straight down, x to the right and y up."""
    center, width = [0.0, 0.0, 0.0], _DEFAULT_WIDTH
    if grid is not None:
        extent = (grid.columns * grid.cell_size, grid.rows * grid.cell_size)
        center = [grid.origin[0] + extent[0] / 2.0, grid.origin[1] + extent[1] / 2.0, 0.0]
        width = _MARGIN * max(extent)
    view: Json = {
        "cameraState": {
            "distance": width,
            "perspective": False,
            "phi": 0,
            "thetaOffset": 0,
            "target": [0.0, 0.0, 0.0],
            "targetOffset": center,
            "targetOrientation": [0.0, 0.0, 0.0, 1.0],
            "fovy": 45,
            "near": 0.5,
            "far": 5000,
        },
        "followMode": "follow-pose",
        "scene": {"transforms": {"showLabel": True, "axisScale": 0.5}},
        "transforms": {},
        "topics": topics,
        "layers": {"mclass-metres": _metres(center, width)},
    }
    if frame:
        view["followTf"] = frame
    return view


def _metres(center: Sequence[float], width: float) -> Json:
    """Lines on the ground a metre apart, or ten, hundred ...: the scale of what is seen."""
    spacing = 10.0 ** max(math.ceil(math.log10(width / _MOST_LINES)), 0)
    divisions = math.ceil(width / spacing)
    divisions += divisions % 2  # Lines go through whole numbers of metres then.
    return {
        "visible": True,
        "frameLocked": True,
        "label": f"{spacing:g} m",
        "instanceId": "mclass-metres",
        "layerId": "foxglove.Grid",
        "size": divisions * spacing,
        "divisions": divisions,
        "lineWidth": 1,
        "color": "#88888866",
        "position": [*(spacing * round(place / spacing) for place in center[:2]), -0.01],
        "rotation": [0, 0, 0],
    }


def _plot(source: str, classes: Sequence[str], object_ids: Sequence[str]) -> Json:
    """Class probabilities over time."""
    series = [
        (f"{title}: {name}" if title else name, f"{element}.classes[{index}].probability")
        for title, element in _elements(source, object_ids)
        for index, name in enumerate((BACKGROUND, *classes))
    ]
    return {
        **dict.fromkeys(_TITLE_KEYS, "P(class)"),
        "paths": _paths(series),
        "minYValue": 0,
        "maxYValue": 1,
        "showLegend": True,
        "legendDisplay": "floating",
        "showPlotValuesInLegend": True,
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        "isSynced": True,
        "xAxisVal": "timestamp",
        "sidebarDimension": 240,
    }


def _states(source: str, object_ids: Sequence[str]) -> Json:
    """The class named, over time."""
    series = [
        (title or "class", f"{element}.class_name")
        for title, element in _elements(source, object_ids)
    ]
    return {
        **dict.fromkeys(_TITLE_KEYS, "Class named"),
        "isSynced": True,
        "paths": _paths(series),
    }


def _paths(series: Sequence[tuple[str, str]]) -> list[Json]:
    """Labels and message paths as panels hold them."""
    return [
        {"value": path, "label": label, "enabled": True, "timestampMethod": "receiveTime"}
        for label, path in series[:_MOST_SERIES]
    ]


def _elements(source: str, object_ids: Sequence[str]) -> list[tuple[str, str]]:
    """Title and message path of each object; of whichever comes first when none can be named.

    A message path quotes text one way or the other and escapes nothing.
    """
    quotes = [
        (name, next((quote for quote in "\"'" if quote not in name), ""))
        for name in object_ids
        if name.isprintable()
    ]
    named = [
        (name, f"{source}.objects[:]{{id=={quote}{name}{quote}}}")
        for name, quote in quotes
        if quote
    ]
    return named or [("", f"{source}.objects[0]")]


def _topic_path(topic: str) -> str:
    """A topic as message paths begin with it: quoted if its name is not a plain one."""
    if _PLAIN_TOPIC.fullmatch(topic):
        return topic
    escaped = topic.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'
