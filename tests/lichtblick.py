"""What Lichtblick reads of a layout, as a JSON Schema and a grammar of message paths.

Stated after the types of its panels' configurations (`LayoutData`, `RendererConfig` with the
settings of its scene extensions, `PlotConfig`, `StateTransitionConfig`,
`RawMessagesPanelConfig`) and `validateLayoutData`, which it calls on import. It ignores what
it does not know: here that is an error, as a setting without effect is a mistake of ours.
"""

from __future__ import annotations

import re
from typing import Any

import jsonschema

Json = dict[str, Any]


def _object(required: Json, optional: Json | None = None) -> Json:
    """These properties and no others."""
    return {
        "type": "object",
        "properties": {**required, **(optional or {})},
        "required": list(required),
        "additionalProperties": False,
    }


def _numbers(count: int) -> Json:
    return {"type": "array", "items": NUMBER, "minItems": count, "maxItems": count}


NUMBER: Json = {"type": "number"}
POSITIVE: Json = {"type": "number", "exclusiveMinimum": 0}
TEXT: Json = {"type": "string"}
TRUTH: Json = {"type": "boolean"}
COLOR: Json = {"type": "string", "pattern": "^#([0-9a-f]{6}|[0-9a-f]{8})$"}
TITLES: Json = {"lichtblickPanelTitle": TEXT, "foxglovePanelTitle": TEXT}

SERIES = _object(
    {
        "value": {"type": "string", "minLength": 1},
        "timestampMethod": {"enum": ["receiveTime", "headerStamp"]},
        "enabled": TRUTH,
    },
    {"label": TEXT, "color": COLOR},
)

# Settings by what a topic holds. All are partial: what is missing has a default.
SCENE_ENTITIES = _object({}, {"visible": TRUTH, "showOutlines": TRUTH, "color": COLOR})
MARKERS = SCENE_ENTITIES
FOXGLOVE_GRID = _object(
    {},
    {
        "visible": TRUTH,
        "frameLocked": TRUTH,
        # Point clouds alone know rgb and rgba.
        "colorMode": {"enum": ["flat", "gradient", "colormap", "rgba-fields"]},
        "flatColor": COLOR,
        "colorField": TEXT,
        "gradient": {"type": "array", "items": COLOR, "minItems": 2, "maxItems": 2},
        "colorMap": {"enum": ["turbo", "rainbow"]},
        "explicitAlpha": NUMBER,
        "minValue": NUMBER,
        "maxValue": NUMBER,
    },
)
OCCUPANCY_GRID = _object(
    {},
    {
        "visible": TRUTH,
        "frameLocked": TRUTH,
        "colorMode": {"enum": ["custom", "map", "costmap", "raw"]},
        "minColor": COLOR,
        "maxColor": COLOR,
        "unknownColor": COLOR,
        "invalidColor": COLOR,
        "alpha": NUMBER,
    },
)
POSE = _object(
    {},
    {
        "visible": TRUTH,
        "frameLocked": TRUTH,
        "type": {"enum": ["axis", "arrow"]},
        "axisScale": POSITIVE,
        "arrowScale": _numbers(3),
        "color": COLOR,
        "showCovariance": TRUTH,
        "covarianceColor": COLOR,
    },
)

THREE_DEE = _object(
    {
        "cameraState": _object(
            {
                "distance": POSITIVE,
                "perspective": TRUTH,
                "phi": NUMBER,
                "target": _numbers(3),
                "targetOffset": _numbers(3),
                "targetOrientation": _numbers(4),
                "thetaOffset": NUMBER,
                "fovy": POSITIVE,
                "near": POSITIVE,
                "far": POSITIVE,
            }
        ),
        "followMode": {"enum": ["follow-pose", "follow-position", "follow-none"]},
        "scene": _object(
            {},
            {
                "backgroundColor": COLOR,
                "labelScaleFactor": POSITIVE,
                "transforms": _object(
                    {},
                    {
                        "editable": TRUTH,
                        "showLabel": TRUTH,
                        "labelSize": POSITIVE,
                        "axisScale": NUMBER,
                        "lineWidth": NUMBER,
                        "lineColor": COLOR,
                    },
                ),
                "syncCamera": TRUTH,
                "topicsVisible": TRUTH,
            },
        ),
        "transforms": {"type": "object", "maxProperties": 0},
        "topics": {
            "type": "object",
            "patternProperties": {
                "/scene$": SCENE_ENTITIES,
                "/markers$": MARKERS,
                "/grid$": FOXGLOVE_GRID,
                "/grid/[^/]+$": OCCUPANCY_GRID,
                "/pose/[^/]+$": POSE,
            },
            "additionalProperties": False,
        },
        "layers": {
            "type": "object",
            "additionalProperties": _object(
                {
                    "visible": TRUTH,
                    "instanceId": TEXT,
                    "layerId": {"const": "foxglove.Grid"},
                    "label": TEXT,
                    "size": POSITIVE,
                    # It has to hold every line in memory.
                    "divisions": {"type": "integer", "minimum": 1, "maximum": 4096},
                    "lineWidth": POSITIVE,
                    "color": COLOR,
                    "position": _numbers(3),
                    "rotation": _numbers(3),
                },
                {"frameLocked": TRUTH, "frameId": TEXT, "order": NUMBER},
            ),
        },
    },
    {"followTf": {"type": "string", "minLength": 1}},
)

PLOT = _object(
    {
        "paths": {"type": "array", "items": SERIES},
        "showLegend": TRUTH,
        "legendDisplay": {"enum": ["floating", "top", "left", "none"]},
        "showPlotValuesInLegend": TRUTH,
        "showXAxisLabels": TRUTH,
        "showYAxisLabels": TRUTH,
        "isSynced": TRUTH,
        "xAxisVal": {"enum": ["timestamp", "index", "custom", "currentCustom"]},
        "sidebarDimension": NUMBER,
    },
    {"minYValue": {"type": ["number", "string"]}, "maxYValue": {"type": ["number", "string"]}}
    | TITLES,
)

STATE_TRANSITIONS = _object(
    {"isSynced": TRUTH, "paths": {"type": "array", "items": SERIES}}, {"showPoints": TRUTH} | TITLES
)

RAW_MESSAGES = _object(
    {
        "topicPath": TEXT,
        "diffEnabled": TRUTH,
        "diffMethod": {"enum": ["custom", "previous message"]},
        "diffTopicPath": TEXT,
        "showFullMessageForDiff": TRUTH,
    },
    {"fontSize": NUMBER} | TITLES,
)

LAYOUT = {
    **_object(
        {
            "configById": {
                "type": "object",
                # A panel's type stands before the mark in its id.
                "patternProperties": {
                    "^3D!.": THREE_DEE,
                    "^Plot!.": PLOT,
                    "^StateTransitions!.": STATE_TRANSITIONS,
                    "^RawMessages!.": RAW_MESSAGES,
                },
                "additionalProperties": False,
            },
            "globalVariables": {"type": "object"},
            "playbackConfig": _object({"speed": POSITIVE}),
            "layout": {"$ref": "#/$defs/tile"},
        },
        {"userNodes": {"type": "object"}, "version": NUMBER},
    ),
    "$defs": {
        "tile": {
            "oneOf": [
                {"type": "string", "minLength": 1},
                _object(
                    {
                        "direction": {"enum": ["row", "column"]},
                        "first": {"$ref": "#/$defs/tile"},
                        "second": {"$ref": "#/$defs/tile"},
                    },
                    {"splitPercentage": {"type": "number", "minimum": 0, "maximum": 100}},
                ),
            ]
        }
    },
}

_VALIDATOR = jsonschema.Draft202012Validator(LAYOUT)

_NAME = r"[A-Za-z0-9_-]+"
_QUOTED = r'"(?:[^"\\]|\\\\|\\")*"'
_TOPIC = rf"(?:(?:/(?:{_NAME})?)+|{_NAME}(?:/(?:{_NAME})?)*|{_QUOTED})"
_SLICE = r"\[(?:-?\d+|-?\d*:-?\d*)\]"
_TEXT_VALUE = r"(?:'[^']*'|\"[^\"]*\")"
_VALUE = rf"(?:-?\d+|true|false|{_TEXT_VALUE})"
_FILTER = rf"\{{{_NAME}(?:\.{_NAME})*(?:==|!=|>=|<=|>|<){_VALUE}\}}"
MESSAGE_PATH = re.compile(
    rf"(?P<topic>{_TOPIC})(?:\.(?:{_NAME}|{_QUOTED})(?:{_SLICE})?(?:{_FILTER})?)*"
)


def tiles(node: Any) -> list[str]:
    """Ids of all panels in a layout's tree, in order."""
    return [node] if isinstance(node, str) else tiles(node["first"]) + tiles(node["second"])


def message_paths(layout: Json) -> list[str]:
    """Every message path in a layout."""
    found = []
    for config in layout["configById"].values():
        found += [series["value"] for series in config.get("paths", ())]
        if "topicPath" in config:
            found.append(config["topicPath"])
    return found


def check_layout(layout: Json) -> None:
    """Raise unless Lichtblick would take a layout and heed every word of it."""
    _VALIDATOR.validate(layout)
    panels = tiles(layout["layout"])
    assert sorted(panels) == sorted(layout["configById"])
    for path in message_paths(layout):
        assert MESSAGE_PATH.fullmatch(path), path
    for name, layer in layout["configById"]["3D!mclass"]["layers"].items():
        assert layer["instanceId"] == name
