"""Viewer layouts against what Lichtblick reads of them."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from lichtblick import MESSAGE_PATH, check_layout, message_paths
from written_output import ENCODINGS

from mclass.footprint import Grid
from mclass.outputs.layout import layout_for

SHIPPED = Path(__file__).parents[1] / "configs/mclass_layout.json"


def layout(encoding: str = "ros2", **settings: Any) -> dict[str, Any]:
    """A full layout: maps, poses, two objects."""
    return layout_for(
        "odom",
        ("books", "parts"),
        encoding=encoding,
        topics=("/mclass/grid/background", "/mclass/grid/books", "/mclass/pose/o1"),
        **{"object_ids": ("o1", "o2"), "grid": Grid((-1.0, 2.0), 0.5, 4, 6), **settings},
    )


def shipped() -> dict[str, Any]:
    content: dict[str, Any] = json.loads(SHIPPED.read_text("utf-8"))
    return content


@pytest.mark.parametrize("encoding", [*ENCODINGS, ""])
def test_every_layout_is_what_lichtblick_reads(encoding: str) -> None:
    check_layout(layout(encoding))


def test_the_shipped_layout_is_what_lichtblick_reads() -> None:
    check_layout(shipped())


BREAKAGES: list[tuple[tuple[str | int, ...], Any]] = [
    (("globalVariables",), None),
    (("playbackConfig", "speed"), "fast"),
    (("layout", "direction"), "diagonal"),
    (("configById", "3D!mclass", "cameraState", "distance"), 0),
    (("configById", "3D!mclass", "cameraState", "target"), [0.0, 0.0]),
    (("configById", "3D!mclass", "followMode"), "follow"),
    (("configById", "3D!mclass", "topics", "/mclass/grid", "colorMode"), "rgba"),
    (("configById", "3D!mclass", "topics", "/mclass/grid/books", "colorMode"), "gradient"),
    (("configById", "3D!mclass", "topics", "/mclass/grid/books", "maxColor"), "orange-ish"),
    (("configById", "3D!mclass", "topics", "/mclass/pose/o1", "type"), "arrows"),
    (("configById", "3D!mclass", "layers", "mclass-metres", "divisions"), 5000),
    (("configById", "Plot!mclass", "title"), "a key of no effect"),
    (("configById", "Plot!mclass", "legendDisplay"), "bottom"),
    (("configById", "Plot!mclass", "paths", 0, "timestampMethod"), "logTime"),
    (("configById", "StateTransitions!mclass", "paths", 0, "value"), ""),
    (("configById", "RawMessages!mclass", "diffMethod"), "next message"),
]


@pytest.mark.parametrize(("place", "value"), BREAKAGES)
def test_the_schema_can_fail(place: tuple[str | int, ...], value: Any) -> None:
    broken = copy.deepcopy(layout())
    parent: Any = broken
    for key in place[:-1]:
        parent = parent[key]
    parent[place[-1]] = value
    with pytest.raises(jsonschema.ValidationError):
        check_layout(broken)


def test_a_panel_without_a_place_is_noticed() -> None:
    broken = layout()
    broken["layout"] = "3D!mclass"
    with pytest.raises(AssertionError):
        check_layout(broken)


@pytest.mark.parametrize(
    ("path", "good"),
    [
        ("/mclass/objects", True),
        ('/mclass/objects.objects[:]{id=="o 1"}.classes[0].probability', True),
        ("/mclass/objects.objects[:]{id=='o\"1'}.class_name", True),
        ('"/my topic".objects[0]', True),
        ("/my topic.objects[0]", False),
        ('/mclass/objects.objects[:]{id=="a"b"}', False),
        ("/mclass/objects.objects[0][1]", False),
        ("/mclass/objects.objects[:]{id==o1}", False),
    ],
)
def test_message_paths(path: str, good: bool) -> None:
    assert bool(MESSAGE_PATH.fullmatch(path)) == good


def test_ids_are_quoted_the_way_that_they_allow() -> None:
    ids = ('a"b', "a'b", "a\"'b", "back\\slash", "line\nbreak", "größe")
    content = layout("json", object_ids=ids)
    check_layout(content)
    named = [
        series["value"] for series in content["configById"]["StateTransitions!mclass"]["paths"]
    ]
    assert named == [
        f"/mclass/objects.objects[:]{{id=={quoted}}}.class_name"
        for quoted in ("'a\"b'", '"a\'b"', '"back\\slash"', '"größe"')
    ]


def test_ids_that_no_path_can_hold_leave_the_first_object() -> None:
    paths = message_paths(layout("json", object_ids=("a\"'b",)))
    assert paths[0] == "/mclass/objects.objects[0].classes[0].probability"


@pytest.mark.parametrize("prefix", ["/deep/er", "/with space", '/with"quote', "/with\\slash"])
def test_any_prefix(prefix: str) -> None:
    content = layout_for("odom", ("a",), encoding="json", prefix=prefix)
    check_layout(content)
    (topic,) = {MESSAGE_PATH.fullmatch(path)["topic"] for path in message_paths(content)}  # type: ignore[index]
    if topic.startswith('"'):
        topic = topic[1:-1].replace('\\"', '"').replace("\\\\", "\\")
    assert topic == f"{prefix}/objects"


@pytest.mark.parametrize(
    ("grid", "size", "divisions", "position"),
    [
        # 1.25 times the larger side is 3.75 m: four lines.
        (Grid((-1.0, 2.0), 0.5, 4, 6), 4.0, 4, [0.0, 3.0, -0.01]),
        # 1250 m wide: lines ten metres apart.
        (Grid((1e6, 0.0), 1.0, 100, 1000), 1260.0, 126, [1_000_500.0, 50.0, -0.01]),
    ],
)
def test_lines_on_the_ground_stand_a_round_number_of_metres_apart(
    grid: Grid, size: float, divisions: int, position: list[float]
) -> None:
    lines = layout(grid=grid)["configById"]["3D!mclass"]["layers"]["mclass-metres"]
    assert (lines["size"], lines["divisions"]) == (size, divisions)
    assert lines["position"] == position
