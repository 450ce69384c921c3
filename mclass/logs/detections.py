"""Detections as columns, whatever message type they came in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from mclass.errors import LogError
from mclass.logs.decode import ABSENT, is_absent
from mclass.logs.families import BoxFormat
from mclass.logs.fields import BoxFields, DetectionFields
from mclass.logs.tables import Table, level_of
from mclass.records import BoolArray, FloatArray, IntArray

TextArray = npt.NDArray[np.object_]


@dataclass(frozen=True)
class Detections:
    """Everything that detectors returned, as they returned it.

    A *look* is one message: one image or scan, at one instant, from one sensor.

    Attributes:
        topics: Topic of each look, (m,).
        stamps_ns: Header stamp of each look [ns], 0 where there is none, (m,).
        log_times_ns: Its log time [ns], (m,).
        frame_names: Its sensor's frame, empty if the message does not say, (m,).
        look_index: Look of each detection, (n,).
        ids: Object id of each detection, empty for none, (n,).
        has_box: Which detections have an image box, (n,).
        boxes: Left, top, right, bottom [pixel], (n, 4); NaN without a box.
        has_bearing: Which detections have a bearing, (n,).
        bearings: Right and left [rad] in the sensor's frame, (n, 2).
        has_volume: Which detections have a 3-D box, (n,).
        volumes: Its position (3), orientation (4) and size (3) in the sensor's frame, (n, 10).
        label_detection: Detection of each label, non-decreasing, (k,).
        labels: Label names as the detector gives them, (k,).
        scores: Their scores, 1 where the detector gives none, (k,).
    """

    topics: TextArray
    stamps_ns: IntArray
    log_times_ns: IntArray
    frame_names: TextArray
    look_index: IntArray
    ids: TextArray
    has_box: BoolArray
    boxes: FloatArray
    has_bearing: BoolArray
    bearings: FloatArray
    has_volume: BoolArray
    volumes: FloatArray
    label_detection: IntArray
    labels: TextArray
    scores: FloatArray

    def __len__(self) -> int:
        return len(self.look_index)

    @property
    def n_looks(self) -> int:
        """Number of looks."""
        return len(self.stamps_ns)


def join_detections(parts: Sequence[Detections]) -> Detections:
    """Detections of several channels as one."""
    if len(parts) == 1:
        return parts[0]
    looks = np.cumsum([0, *(part.n_looks for part in parts)])
    counts = np.cumsum([0, *(len(part) for part in parts)])

    def joined(name: str, shifts: IntArray | None = None) -> npt.NDArray[Any]:
        columns = [getattr(part, name) for part in parts]
        if shifts is not None:
            columns = [column + shift for column, shift in zip(columns, shifts, strict=False)]
        return np.concatenate(columns)

    return Detections(
        topics=joined("topics"),
        stamps_ns=joined("stamps_ns"),
        log_times_ns=joined("log_times_ns"),
        frame_names=joined("frame_names"),
        look_index=joined("look_index", looks),
        ids=joined("ids"),
        has_box=joined("has_box"),
        boxes=joined("boxes"),
        has_bearing=joined("has_bearing"),
        bearings=joined("bearings"),
        has_volume=joined("has_volume"),
        volumes=joined("volumes"),
        label_detection=joined("label_detection", counts),
        labels=joined("labels"),
        scores=joined("scores"),
    )


def read_detections(table: Table, fields: DetectionFields) -> Detections:
    """Detections of one channel.

    Raises:
        LogError: If lists that should run in parallel do not.
    """
    element = fields.element
    if element and not any(path.startswith(element) for path in table.columns):
        # Messages that name their own fields, of which none ever held a detection.
        return no_detections(
            np.full(len(table), table.channel.topic, dtype=object),
            read_stamps(table, fields.stamps),
            table.log_times_ns,
            _frame_names(table, fields.frames),
        )
    count = table.count(element)
    has_box, boxes = _boxes(table, fields.box, element, count)
    has_volume, volumes = _volumes(table, fields.volume, element, count)
    label_detection, labels, scores = _labels(table, fields, count)
    ids = np.full(count, "", dtype=object)
    if fields.id is not None:
        ids = as_ids(table.at_level(fields.id, element))
    has_bearing, bearings = np.zeros(count, bool), _none(count, 2)
    if fields.bearing is not None:
        sides = [table.at_level(path, element) for path in fields.bearing]
        bearings = np.stack(sides, axis=1).astype(float)
        has_bearing = np.asarray(~is_absent(bearings).all(axis=1))
    return Detections(
        topics=np.full(len(table), table.channel.topic, dtype=object),
        stamps_ns=read_stamps(table, fields.stamps),
        log_times_ns=table.log_times_ns,
        frame_names=_frame_names(table, fields.frames),
        look_index=table.parents("", element) if element else np.arange(count),
        ids=ids,
        has_box=has_box,
        boxes=boxes,
        has_bearing=has_bearing,
        bearings=bearings,
        has_volume=has_volume,
        volumes=volumes,
        label_detection=label_detection,
        labels=labels,
        scores=scores,
    )


def no_detections(
    topics: TextArray, stamps_ns: IntArray, log_times_ns: IntArray, frame_names: TextArray
) -> Detections:
    """Looks that returned nothing; arguments as the attributes of `Detections`."""
    nothing = np.zeros(0, np.int64)
    texts = np.zeros(0, dtype=object)
    return Detections(
        topics=topics,
        stamps_ns=stamps_ns,
        log_times_ns=log_times_ns,
        frame_names=frame_names,
        look_index=nothing,
        ids=texts,
        has_box=np.zeros(0, bool),
        boxes=np.zeros((0, 4)),
        has_bearing=np.zeros(0, bool),
        bearings=np.zeros((0, 2)),
        has_volume=np.zeros(0, bool),
        volumes=np.zeros((0, 10)),
        label_detection=nothing,
        labels=texts,
        scores=np.zeros(0),
    )


def encode_texts(texts: TextArray) -> tuple[list[str], IntArray]:
    """Distinct texts in the order of their first appearance, and the number of each text.

    Object arrays throughout: one very long text would make a fixed-width array of many huge.
    """
    values: list[str] = texts.tolist()
    numbers = {text: number for number, text in enumerate(dict.fromkeys(values))}
    return list(numbers), np.fromiter(map(numbers.__getitem__, values), np.int64, len(values))


def as_names(values: npt.NDArray[Any]) -> TextArray:
    """Label names; numbers as people write them (``3``, not ``3.0``)."""
    if values.dtype == object:
        return values
    if values.dtype.kind == "f":
        values = np.array([f"{value:.15g}" for value in values.tolist()], dtype=object)
    return np.array([str(value) for value in values.tolist()] + [None], dtype=object)[:-1]


def as_ids(values: npt.NDArray[Any]) -> TextArray:
    """Object ids; negative numbers mean none."""
    names = as_names(values)
    if values.dtype.kind in "if":
        names[~(values >= 0)] = ""
    return names


def read_stamps(table: Table, alternatives: Sequence[str]) -> IntArray:
    """Header stamps [ns], 0 where there are none; plain numbers by their magnitude.

    Stamps before 1970 are none: no clock shows them, and differences to them overflow.
    """
    if not alternatives:
        return np.zeros(len(table), np.int64)
    values = table.at_level(alternatives[0], "")
    if table.is_time(alternatives[0]):
        stamps = values.astype(np.int64)
    elif values.dtype.kind in "iuf":
        # Seconds since 1970 stay below 1e11 for three thousand years, milliseconds below 1e14, ...
        with np.errstate(invalid="ignore"):
            usable = (values >= 0) & (values < 2.0**63)
        safe = np.where(usable, values, 0)
        scale = np.array([10**9, 10**6, 10**3, 1])[np.searchsorted([1e11, 1e14, 1e17], safe)]
        whole = safe.astype(np.int64)
        stamps = whole * np.where(whole < np.iinfo(np.int64).max // scale, scale, 0)
        if values.dtype.kind == "f":
            stamps += np.rint((safe - whole) * scale).astype(np.int64)
    else:
        stamps = np.zeros(len(table), np.int64)
    return np.maximum(stamps, 0)


def _frame_names(table: Table, alternatives: Sequence[str]) -> TextArray:
    """The first name that is not empty: the message's own, else that of its first element."""
    names = np.full(len(table), "", dtype=object)
    for path in alternatives:
        level = level_of(path)
        if level:
            spans = table.spans("", level)
            filled = np.diff(spans) > 0
            found = np.full(len(table), "", dtype=object)
            found[filled] = table.values(path)[spans[:-1][filled]]
        else:
            found = table.values(path)
        names = np.where(names == "", found, names)
    return clean_frames(names)


def _none(count: int, numbers: int) -> FloatArray:
    """NaN in so many rows, in no more memory than one takes."""
    return np.broadcast_to(np.nan, (count, numbers))


def clean_frames(names: npt.NDArray[Any]) -> TextArray:
    """Frame names without the leading slash of old ROS."""
    distinct, codes = encode_texts(names)
    return np.array([str(name).lstrip("/") for name in distinct] + [None], object)[codes]


def _labels(
    table: Table, fields: DetectionFields, count: int
) -> tuple[IntArray, TextArray, FloatArray]:
    """Detection, name and score of every label."""
    element = fields.element
    if fields.label is None:
        return np.zeros(0, np.int64), np.zeros(0, dtype=object), np.zeros(0)
    level = level_of(fields.label)
    if level != element and level.startswith(element):
        detection = table.parents(element, level)
    else:
        detection, level = np.arange(count), element
    labels = as_names(table.at_level(fields.label, level))
    scores = np.ones(len(labels))
    if fields.score is not None:
        scores = table.at_level(fields.score, level).astype(np.float64)
        # A message may leave the score out where it has nothing to say.
        scores = np.where(is_absent(scores), 1.0, scores)
    return detection, labels, scores


def _boxes(
    table: Table, box: BoxFields | None, element: str, count: int
) -> tuple[BoolArray, FloatArray]:
    """Left, top, right, bottom of every detection, and which have a box at all."""
    nothing = np.zeros(count, bool), _none(count, 4)
    if box is None or not count:
        return nothing
    if len(box.paths) == 4:
        numbers = np.stack([table.at_level(path, element) for path in box.paths], axis=1)
        given = np.asarray(numbers, dtype=np.float64)
    else:
        given = _four_numbers(table, box.paths[0], element, count)
    absent = np.asarray((given == 0.0).all(axis=1) | is_absent(given).all(axis=1))
    turn = np.zeros(count)
    if box.angle is not None:
        turn = np.asarray(table.at_level(box.angle, element), dtype=np.float64)
    # Infinities become NaN on the way, and NaN is refused later.
    with np.errstate(invalid="ignore", over="ignore"):
        edges = _edges(given, turn, box.format)
    return ~absent, np.where(absent[:, None], np.nan, edges)


def _edges(given: FloatArray, turn: FloatArray, box_format: BoxFormat) -> FloatArray:
    """Left, top, right, bottom of boxes in any format, turned [rad] about their centres."""
    a, b, c, d = given.T
    if box_format == "corners":
        return given
    if box_format == "corner":
        return np.stack([a, b, a + c, b + d], axis=1)
    cosine, sine = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    half_x, half_y = 0.5 * (c * cosine + d * sine), 0.5 * (c * sine + d * cosine)
    return np.stack([a - half_x, b - half_y, a + half_x, b + half_y], axis=1)


def _four_numbers(table: Table, path: str, element: str, count: int) -> FloatArray:
    """Boxes that are arrays, or lists of exactly four numbers; empty lists are no box."""
    values = table.floats(path)
    if values.ndim == 2:
        if values.shape[1] != 4:
            raise LogError(
                f"{path!r} has {values.shape[1]} numbers; a box has four",
                topic=table.channel.topic,
            )
        return values
    spans = table.spans(element, level_of(path))
    sizes = np.diff(spans)
    result = np.full((count, 4), ABSENT)
    full = sizes == 4
    result[full] = values[spans[:-1][full, None] + np.arange(4)]
    # Any other length is a box that means nothing, not the absence of one.
    result[(sizes != 4) & (sizes != 0)] = np.nan
    return result


def _volumes(
    table: Table, paths: Sequence[str], element: str, count: int
) -> tuple[BoolArray, FloatArray]:
    """Position, orientation, size of 3-D boxes, and which detections have one."""
    if not paths:
        return np.zeros(count, bool), _none(count, 10)
    values, filled = np.empty((count, 10)), np.zeros(count, bool)
    for column, path in enumerate(paths):
        values[:, column] = table.at_level(path, element)
        if not 3 <= column < 7:
            # A box at the sensor's own origin without size is a message that was not filled in.
            filled |= values[:, column] != 0.0
    return filled, values
