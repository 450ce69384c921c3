"""From a log to label measurements: what `estimate` reads.

Header stamps place everything, as logs are written late and by other clocks; log times only
bound what is read and stamp what is written. Every detection is used, or counted under
exactly one reason: ``detections == len(measurements) + tally.total``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Literal

import numpy as np

from mclass.blockwise import blockwise
from mclass.errors import LogError, ModelError
from mclass.logs import directions
from mclass.logs.damage import undecoded
from mclass.logs.detections import Detections, encode_texts
from mclass.logs.inputs import InputReader, Inputs
from mclass.logs.labels import known_labels, merge_labels
from mclass.logs.placing import PlacedLooks, place_looks
from mclass.logs.reader import LogReader
from mclass.logs.sensors import Sensor
from mclass.logs.sources import Sources
from mclass.logs.topics import topics_present
from mclass.model import Model
from mclass.records import (
    BoolArray,
    FloatArray,
    Frames,
    IntArray,
    LabelMeasurements,
    PoseTrack,
    Tally,
)

NO_CAMERA = "box without a camera (set log.camera or log.camera_info)"
BAD_CAMERA = "camera calibration that cannot be used"
NO_TRANSFORM = "no transform to the sensor"
MERGED = "merged with another detection of the same id"

_LISTED = 10
_LONGEST_NAME = 60


@dataclass(frozen=True)
class LogContents:
    """What a log says, ready for inference.

    Attributes:
        measurements: Label sets with their frames.
        track: The poses that placed them.
        tally: Detections not used, by reason.
        notes: What was chosen, and why, in words.
        encoding: For channels written beside.
        frame: World frame; ``world`` if the log does not name it.
        unknown_labels: How often each name came that the model lacks.
        detections: Number of detections in all: used and not used.
        pose_tally: Poses and transforms left out or mended, by reason.
        unreadable: Messages that could not be decoded, by topic and reason.
    """

    measurements: LabelMeasurements
    track: PoseTrack
    tally: Tally
    notes: tuple[str, ...]
    encoding: Literal["ros2", "protobuf", "json"]
    frame: str
    unknown_labels: Mapping[str, int]
    detections: int = 0
    pose_tally: Tally = field(default_factory=Tally)
    unreadable: Mapping[str, Mapping[str, int]] = field(default_factory=dict)

    @property
    def losses(self) -> tuple[str, ...]:
        """Messages that could not be decoded, in sentences."""
        return undecoded(self.unreadable)


def read_measurements(
    reader: LogReader, model: Model, start_ns: int | None = None, end_ns: int | None = None
) -> LogContents:
    """Label measurements of a log.

    Args:
        reader: The open log.
        model: Label names, and the section ``log`` with what to use of the log.
        start_ns: Log time [ns] of the first detection message to use; None for the beginning.
        end_ns: Log time [ns] before which detection messages must be; None for the end.

    Raises:
        LogError: If there are no detections or no poses, or the model names what is not there.
    """
    try:
        return _read_measurements(reader, model, start_ns, end_ns)
    except LogError as error:
        if not reader.damage.any:
            raise
        # What is missing may be what was lost.
        raise LogError(f"{error} The log is damaged: {'; '.join(reader.damage.losses)}.") from error


def _read_measurements(
    reader: LogReader, model: Model, start_ns: int | None, end_ns: int | None
) -> LogContents:
    inputs = InputReader(reader, model, start_ns, end_ns).read()
    if not inputs.sources.detections:
        raise LogError(
            f"no detections were recognised. Topics present: {topics_present(reader)}. "
            "Name one as log.detections, with the field paths of label, id and box."
            f"{_unusable(reader, inputs.sources)}",
            path=str(reader.path),
        )
    if inputs.pose_source is None:
        raise LogError(
            f"no poses were recognised. Topics present: {topics_present(reader)}. "
            "Name one as log.odometry, with the field paths of x, y and heading."
            f"{_unusable(reader, inputs.sources)}",
            path=str(reader.path),
        )
    _check_clocks(inputs, model.log.max_gap_ns, str(reader.path))
    return measure(inputs, model)


def _check_clocks(inputs: Inputs, max_gap_ns: int, path: str) -> None:
    """Refuse a log none of whose detection messages has a pose."""
    poses, looks = inputs.track.poses.stamps_ns, inputs.stamps_ns
    if not len(looks) or inputs.track.covered(looks, max_gap_ns).any():
        return
    (first_pose, last_pose), (first, last) = (
        (f"{stamps.min() * 1e-9:.3f}", f"{stamps.max() * 1e-9:.3f}") for stamps in (poses, looks)
    )
    raise LogError(
        f"no detection message has a pose within {max_gap_ns * 1e-9:g} s: poses are stamped "
        f"{first_pose} to {last_pose} s, detections {first} to {last} s. Did their clocks differ? "
        "Name another source as log.odometry, or allow more with log.max_gap.",
        path=path,
    )


def _unusable(reader: LogReader, sources: Sources) -> str:
    """Why channels that should serve do not, each a sentence."""
    topics = {channel.id: channel.topic for channel in reader.channels}
    problems = [
        why if why.startswith("topic ") else f"topic {topics[key]}: {why}"
        for key, why in sources.unusable.items()
    ]
    return "".join(f" T{text.rstrip('.')[1:]}." for text in problems[:_LISTED])


def measure(inputs: Inputs, model: Model) -> LogContents:
    """Put what was read together.

    Args:
        inputs: Of a log with poses.
        model: As for `read_measurements`.
    """
    found, notes = inputs.detections, list(inputs.notes)
    looks = place_looks(inputs, model.log.max_gap_ns)
    known = known_labels(found, model, inputs.numbered)
    reasons = list(known.reasons)
    reason = known.reason_index.copy()

    def refuse(rows: BoolArray, why: str) -> None:
        """Count rows under a reason unless they have one already."""
        if why not in reasons:
            reasons.append(why)
        reason[rows & (reason == 0)] = reasons.index(why)

    seconds = f"{model.log.max_gap_ns * 1e-9:g} s"
    refuse(~looks.posed[found.look_index], f"no pose within {seconds}")
    refuse(~looks.mounted[found.look_index], f"{NO_TRANSFORM} within {seconds}")
    edges, codes, problems = _directions(inputs, looks, reason == 0)
    for code, why in enumerate((*directions.REASONS, NO_CAMERA, BAD_CAMERA)):
        if code:
            refuse(codes == code, why)
    notes += problems
    frames, frame_of_look = _frames(inputs, looks)
    used = np.flatnonzero(reason == 0)
    rows = _Rows.of(frame_of_look[found.look_index[used]], used, found)
    row_of_detection = np.full(len(found), -1)
    row_of_detection[used] = rows.row
    label_rows = row_of_detection[known.detections]
    kept = label_rows >= 0
    offsets, labels, scores = merge_labels(
        label_rows[kept], known.labels[kept], known.scores[kept], len(rows.first)
    )
    first = used[rows.first]
    measurements = LabelMeasurements(
        frames=frames,
        frame_index=frame_of_look[found.look_index[first]],
        directions=directions.hull(edges[used], rows.row, len(first)),
        object_index=rows.object_index,
        object_ids=rows.object_ids,
        label_offsets=offsets,
        labels=labels,
        scores=scores,
        label_names=tuple(model.classes.label_names),
    )
    tally = Tally()
    for why, count in zip(reasons, np.bincount(reason, minlength=len(reasons)), strict=True):
        if why:
            tally.add(why, int(count))
    tally.add(MERGED, len(used) - len(first))
    if inputs.tally.counts:
        notes.append(f"poses left out or mended: {_counts(inputs.tally.counts)}")
    if known.unknown:
        notes.append(f"labels not in the model (see log.labels): {_counts(known.unknown)}")
    frame = inputs.track.poses.frame
    if not frame:
        notes.append("the poses name no world frame; it is called world")
    return LogContents(
        measurements=measurements,
        track=inputs.track.poses,
        tally=tally,
        notes=tuple(notes),
        encoding=inputs.encoding,
        frame=frame or "world",
        unknown_labels=known.unknown,
        detections=len(found),
        pose_tally=inputs.tally,
        unreadable=inputs.unreadable,
    )


def _counts(counts: Mapping[str, int]) -> str:
    """``3 of this, 2 of that``, the most frequent ones."""
    ordered = sorted(counts.items(), key=lambda entry: (-entry[1], entry[0]))
    listed = [f"{count:,} {name[:_LONGEST_NAME]!r}" for name, count in ordered[:_LISTED]]
    rest = len(ordered) - _LISTED
    return ", ".join(listed) + (f" and {rest:,} more" if rest > 0 else "")


@dataclass(frozen=True)
class _Rows:
    """Detections gathered into rows: those of one frame that share an id are one.

    Attributes:
        row: Row of each detection, (n,).
        first: First detection of each row, (r,); rows are ordered by frame, then as it.
        object_index: Index into ``object_ids`` for each row, -1 for none, (r,).
        object_ids: Distinct ids in the order of their first appearance.
    """

    row: IntArray
    first: IntArray
    object_index: IntArray
    object_ids: tuple[str, ...]

    @classmethod
    def of(cls, frame: IntArray, used: IntArray, found: Detections) -> _Rows:
        """Gather detections ``used``, which lie in ``frame``, (n,) each."""
        order = np.argsort(frame, kind="stable")
        ids = found.ids[used]
        names, codes = encode_texts(ids[order])
        in_order = np.empty(len(order), np.int64)
        in_order[order] = codes
        if "" in names:
            none = names.index("")
            anonymous = in_order == none
            names.remove("")
            in_order = np.where(anonymous, -1, in_order - (in_order > none))
        # Detections without id each get a key of their own.
        key = np.where(in_order >= 0, in_order, len(names) + np.arange(len(used)))
        # Both in one number, which is sorted faster than pairs.
        places = frame * (len(names) + len(used)) + key
        _, first, group = np.unique(places, return_index=True, return_inverse=True)
        sequence = np.lexsort((first, frame[first]))
        rank = np.empty(len(sequence), np.int64)
        rank[sequence] = np.arange(len(sequence))
        first = first[sequence]
        return cls(rank[group.reshape(-1)], first, in_order[first], tuple(names))


def _directions(
    inputs: Inputs, looks: PlacedLooks, wanted: BoolArray
) -> tuple[FloatArray, IntArray, list[str]]:
    """World azimuths of all wanted detections, and why some have none.

    Returns:
        Directions (n, 2), codes into ``directions.REASONS`` and the two of cameras (n,), and
        problems in words.
    """
    found = inputs.detections
    edges, codes = np.full((len(found), 2), np.nan), np.zeros(len(found), np.int64)
    no_camera = len(directions.REASONS)
    problems = []
    sensor_of = looks.sensor_index[found.look_index]
    has_bearing = found.has_bearing & ~found.has_box
    for index, (sensor, _) in enumerate(inputs.sensors):
        mine = wanted & (sensor_of == index)
        rows = np.flatnonzero(mine & found.has_box)
        if sensor.camera is None:
            codes[rows] = no_camera
        elif len(rows):
            try:
                edges[rows], codes[rows] = blockwise(
                    partial(_of_boxes, inputs, looks, sensor), rows
                )
            except ModelError as error:
                codes[rows] = no_camera + 1
                problems.append(f"camera {sensor.camera.topic or 'of the model file'}: {error}")
        rows = np.flatnonzero(mine & has_bearing)
        edges[rows], codes[rows] = blockwise(partial(_of_bearings, inputs, looks, sensor), rows)
        rows = np.flatnonzero(mine & found.has_volume & ~found.has_box & ~has_bearing)
        edges[rows], codes[rows] = blockwise(partial(_of_volumes, inputs, looks), rows)
    return edges, codes, problems


def _of_boxes(
    inputs: Inputs, looks: PlacedLooks, sensor: Sensor, rows: IntArray
) -> tuple[FloatArray, IntArray]:
    """Directions and codes of detections that have a box in the image of a sensor's camera."""
    assert sensor.camera is not None
    look = inputs.detections.look_index[rows]
    return directions.box_directions(
        sensor.camera.calibrations,
        sensor.camera.rows_at(inputs.stamps_ns[look]),
        looks.rotations[look],
        inputs.detections.boxes[rows],
    )


def _of_bearings(
    inputs: Inputs, looks: PlacedLooks, sensor: Sensor, rows: IntArray
) -> tuple[FloatArray, IntArray]:
    """Directions and codes of detections that have bearings."""
    found = inputs.detections
    return directions.bearing_directions(
        looks.rotations[found.look_index[rows]], found.bearings[rows], optical=sensor.optical
    )


def _of_volumes(inputs: Inputs, looks: PlacedLooks, rows: IntArray) -> tuple[FloatArray, IntArray]:
    """Directions and codes of detections that have a box in space."""
    look = inputs.detections.look_index[rows]
    return directions.volume_directions(
        looks.rotations[look], inputs.detections.volumes[rows], looks.shifts[look]
    )


def _frames(inputs: Inputs, looks: PlacedLooks) -> tuple[Frames, IntArray]:
    """Looks with a pose as frames: those of one stamp and sensor frame are one.

    Returns:
        The frames, and the frame of each look, -1 for looks without one, (m,).
    """
    frame_of_look = np.full(inputs.detections.n_looks, -1)
    placed = np.flatnonzero(looks.posed & looks.mounted)
    names, codes = encode_texts(
        np.array([sensor.frame for sensor, _ in inputs.sensors] + [None], dtype=object)[:-1]
    )
    sensor_code = codes[looks.sensor_index[placed]] if names else placed
    stamps = inputs.stamps_ns[placed]
    pairs = np.stack([stamps, sensor_code], axis=1)
    _, first, group = np.unique(pairs, axis=0, return_index=True, return_inverse=True)
    group = group.reshape(-1)
    frame_of_look[placed] = group
    # Complete once the last of its messages was logged.
    log_times = np.zeros(len(first), np.int64)
    np.maximum.at(log_times, group, inputs.detections.log_times_ns[placed])
    chosen = placed[first]
    covariances = looks.covariances[chosen] if looks.covariances is not None else None
    return (
        Frames(
            inputs.stamps_ns[chosen],
            log_times,
            looks.poses[chosen],
            covariances,
            looks.views[chosen],
        ),
        frame_of_look,
    )
