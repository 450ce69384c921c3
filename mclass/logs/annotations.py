"""Image annotations as detections: texts are labels, the outlines that they stand at are boxes.

An annotation message was made to be looked at, so what belongs together is told by place: a
text belongs to the outline with a corner, a side's middle or the centre nearest to it. Texts
at one outline with one id are one detection with several labels.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mclass.logs.detections import Detections, TextArray, encode_texts, read_stamps
from mclass.logs.tables import Table
from mclass.records import BoolArray, FloatArray, IntArray

_LINE_LOOP = (2, "LINE_LOOP", "2")
# Messages are kept apart on a third axis, further than any two places in one image.
_MESSAGE_DISTANCE = 1e6
_ANCHORS = np.array([(x, y) for x in (0.0, 0.5, 1.0) for y in (0.0, 0.5, 1.0)])

_TEXT_PATHS = (
    "texts[].text",
    "texts[].position.x",
    "texts[].position.y",
    "points[].type",
    "points[].points[].x",
    "points[].points[].y",
)
_OPTIONAL_PATHS = (
    "timestamp",
    "texts[].timestamp",
    "texts[].metadata[].key",
    "texts[].metadata[].value",
)


@dataclass(frozen=True)
class _Outlines:
    """Boxes of closed lines: left, top, right, bottom (o, 4), and their messages (o,)."""

    edges: FloatArray
    messages: IntArray


def annotation_paths(paths: Mapping[str, str]) -> tuple[str, ...] | None:
    """The fields to read; None if the messages are no annotations with texts and outlines."""
    if not all(path in paths for path in _TEXT_PATHS):
        return None
    return _TEXT_PATHS + tuple(path for path in _OPTIONAL_PATHS if path in paths)


def read_annotations(table: Table) -> Detections:
    """Detections of a channel of image annotations; they name no sensor frame."""
    text_message = table.parents("", "texts[]")
    names = np.asarray(table.values("texts[].text"), dtype=object)
    metadata = _metadata(table, len(names))
    ids = metadata.get("id", np.full(len(names), "", dtype=object))
    outline = _nearest_outlines(table, text_message)
    # Texts without an outline stand for themselves.
    place = np.where(outline >= 0, outline, -1 - np.arange(len(names)))
    _, id_codes = encode_texts(ids)
    _, first, group = np.unique(
        np.stack([text_message, place, id_codes], axis=1),
        axis=0,
        return_index=True,
        return_inverse=True,
    )
    # Groups in the order of their first texts, which is the order of the message.
    order = np.argsort(first, kind="stable")
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    first, detection = first[order], rank[group.reshape(-1)]
    by_detection = np.argsort(detection, kind="stable")
    outlines = _outlines(table)
    boxes = np.full((len(first), 4), np.nan)
    has_box = outline[first] >= 0
    boxes[has_box] = outlines.edges[outline[first][has_box]]
    look, look_message, stamps = _looks(table, text_message[first], first)
    empty = np.full(len(look_message), "", dtype=object)
    return Detections(
        topics=np.full(len(look_message), table.channel.topic, dtype=object),
        stamps_ns=stamps,
        log_times_ns=table.log_times_ns[look_message],
        frame_names=empty,
        look_index=look,
        ids=ids[first],
        has_box=has_box,
        boxes=boxes,
        has_bearing=np.zeros(len(first), bool),
        bearings=np.full((len(first), 2), np.nan),
        has_volume=np.zeros(len(first), bool),
        volumes=np.full((len(first), 10), np.nan),
        label_detection=detection[by_detection],
        labels=names[by_detection],
        scores=_numbers(metadata.get("score"), len(names))[by_detection],
    )


def _metadata(table: Table, count: int) -> dict[str, TextArray]:
    """Values of the keys ``id`` and ``score`` for each text, empty where not given."""
    if "texts[].metadata[].key" not in table.columns:
        return {}
    parents = table.parents("texts[]", "texts[].metadata[]")
    keys = table.values("texts[].metadata[].key")
    values = np.asarray(table.values("texts[].metadata[].value"), dtype=object)
    found = {}
    for name in ("id", "score"):
        chosen = keys == name
        column = np.full(count, "", dtype=object)
        column[parents[chosen]] = values[chosen]
        found[name] = column
    return found


def _numbers(texts: TextArray | None, count: int) -> FloatArray:
    """Scores written as text; 1 where there is none, NaN where it is no number."""
    result = np.ones(count)
    if texts is not None:
        distinct, codes = encode_texts(texts)
        result = np.array([_number(text) for text in distinct] + [1.0])[codes]
    return result


def _number(text: str) -> float:
    try:
        return float(text) if text else 1.0
    except ValueError:
        return float("nan")


def _outlines(table: Table) -> _Outlines:
    """Bounding boxes of all closed lines with a point or more."""
    kinds = table.values("points[].type")
    spans = table.spans("points[]", "points[].points[]")
    closed: BoolArray = (
        np.isin(kinds, _LINE_LOOP[:1])
        if kinds.dtype.kind in "iuf"
        else np.array([kind in _LINE_LOOP for kind in kinds.tolist()], dtype=bool)
    )
    chosen = closed & (np.diff(spans) > 0)
    starts = spans[:-1]
    points = np.stack(
        [table.floats("points[].points[].x"), table.floats("points[].points[].y")], axis=1
    )
    edges = np.full((len(kinds), 4), np.nan)
    filled = np.diff(spans) > 0
    if filled.any():
        edges[filled, :2] = np.minimum.reduceat(points, starts[filled])
        edges[filled, 2:] = np.maximum.reduceat(points, starts[filled])
    return _Outlines(edges[chosen], table.parents("", "points[]")[chosen])


def _nearest_outlines(table: Table, text_message: IntArray) -> IntArray:
    """Index of the outline that each text stands at, -1 for none in its message."""
    # Takes longer to load than most logs to read, and few logs need it.
    from scipy.spatial import cKDTree  # noqa: PLC0415

    outlines = _outlines(table)
    nearest = np.full(len(text_message), -1)
    places = np.stack(
        [table.floats("texts[].position.x"), table.floats("texts[].position.y")], axis=1
    )
    placed = np.isfinite(places).all(axis=1)
    usable = np.flatnonzero(np.isfinite(outlines.edges).all(axis=1))
    if not len(usable) or not placed.any():
        return nearest
    low, high = outlines.edges[usable, None, :2], outlines.edges[usable, None, 2:]
    anchors = low + _ANCHORS * (high - low)
    depth = np.repeat(outlines.messages[usable], len(_ANCHORS))
    tree = cKDTree(
        np.column_stack([anchors.reshape(-1, 2), depth * _MESSAGE_DISTANCE]), balanced_tree=False
    )
    _, index = tree.query(np.column_stack([places, text_message * _MESSAGE_DISTANCE])[placed])
    found = usable[index // len(_ANCHORS)]
    same = outlines.messages[found] == text_message[placed]
    nearest[placed] = np.where(same, found, -1)
    return nearest


def _looks(
    table: Table, message: IntArray, first_text: IntArray
) -> tuple[IntArray, IntArray, IntArray]:
    """Looks of a channel: one a message, one more for every other stamp of its texts.

    Args:
        table: The channel.
        message: Message of each detection, (n,).
        first_text: One text of each detection, (n,).

    Returns:
        Look of each detection (n,), message (m,) and stamp [ns] (m,) of each look.
    """
    stamps = read_stamps(table, [path for path in ("timestamp",) if path in table.columns])
    own = stamps[message]
    if "texts[].timestamp" in table.columns:
        given = table.values("texts[].timestamp")[first_text]
        # A message without a stamp of its own was taken when its first text was.
        unstamped = np.flatnonzero(stamps[message] == 0)[::-1]
        stamps = stamps.copy()
        stamps[message[unstamped]] = given[unstamped]
        own = np.where(given != 0, given, stamps[message])
    other = own != stamps[message]
    extra, extra_look = np.unique(
        np.stack([message[other], own[other]], axis=1), axis=0, return_inverse=True
    )
    look = message.copy()
    look[other] = len(table) + extra_look.reshape(-1)
    return (
        look,
        np.concatenate([np.arange(len(table)), extra[:, 0]]),
        np.concatenate([stamps, extra[:, 1]]),
    )
