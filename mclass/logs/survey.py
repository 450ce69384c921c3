"""What is in a log, and what of it would be used: for `inspect log` and `init`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from scipy.sparse import csr_array

from mclass import camera
from mclass.errors import LogError
from mclass.logs.channels import ChannelInfo
from mclass.logs.detections import Detections, encode_texts
from mclass.logs.families import role_of
from mclass.logs.inputs import InputReader, Inputs
from mclass.logs.labels import translate_labels
from mclass.logs.reader import LogReader
from mclass.logs.topics import own_prefix
from mclass.model import Model
from mclass.records import BoolArray, FloatArray, IntArray, PoseTrack

_PAIRED_LABELS = 100


@dataclass(frozen=True)
class ChannelUse:
    """One channel.

    Attributes:
        topic: Name.
        schema: Message type.
        encoding: Of its messages.
        count: Messages, None if unknown.
        rate: Messages a second of the log, None if unknown.
        role: What its type or fields are good for, empty for nothing.
        used: Whether `estimate` reads it.
        why: Why it is, or is not, used.
    """

    topic: str
    schema: str
    encoding: str
    count: int | None
    rate: float | None
    role: str
    used: bool
    why: str


@dataclass(frozen=True)
class SensorUse:
    """One sensor.

    Attributes:
        topic: Of its detections.
        frame: Its frame, empty if unknown.
        optical: Whether it is a camera.
        camera_topic: Its calibration's channel, empty for none or the model file's.
        calibrated: Whether its pixels can be turned into rays.
        image_size: Width and height [pixel], None if unknown.
        placed: Whether its place on the robot is known, and not assumed.
        looks: Number of its messages.
    """

    topic: str
    frame: str
    optical: bool
    camera_topic: str
    calibrated: bool
    image_size: tuple[int, int] | None
    placed: bool
    looks: int


@dataclass(frozen=True)
class Course:
    """When and where what was seen.

    Attributes:
        track: The poses that would be used.
        looks_ns: When each detection message was taken, by the clock of the track [ns], (m,).
        covered: Which of them a pose covers, (m,).
        poses_world_child: Of the track at these times; NaN where none covers them, (m, 3).
        label_looks: Message of each label, (k,).
        labels: Index of each label into `Survey.labels`, (k,).
    """

    track: PoseTrack
    looks_ns: IntArray
    covered: BoolArray
    poses_world_child: FloatArray
    label_looks: IntArray
    labels: IntArray


@dataclass(frozen=True)
class Survey:
    """A log at a glance.

    Attributes:
        channels: All of them, by topic.
        detections: Topics of the used detections.
        pose_topic: Topic of the used poses; empty for transforms or none.
        pose_kind: ``Odometry``, ``transforms``, ...; empty for none.
        transform: Parent and child when poses come from transforms.
        world_frame: Frame of the poses, empty if unknown.
        robot_frame: What the poses are of, empty if unknown.
        pose_count: Usable poses.
        placed: Detection messages that a pose covers.
        sensors: Of the detections.
        labels: How often each name was seen, names as the detector gives them, frequent first.
        together: How often two of ``labels`` were returned for one thing in one look, frequent
            first: both names and the count.
        label_names: Names by number, from the log.
        unknown_labels: Those of ``labels`` that the model lacks; empty without a model.
        looks: Detection messages.
        detection_count: Detections in them.
        ids: Distinct object ids.
        encoding: For channels written beside.
        pose_problems: Poses left out or mended, by reason.
        unreadable: Messages that could not be decoded, by topic and reason.
        notes: Choices in words.
        problem: Why `estimate` would fail, empty if it would not.
        course: When and where what was seen; None when nothing could be read.
    """

    channels: tuple[ChannelUse, ...]
    detections: tuple[str, ...] = ()
    pose_topic: str = ""
    pose_kind: str = ""
    transform: tuple[str, str] | None = None
    world_frame: str = ""
    robot_frame: str = ""
    pose_count: int = 0
    placed: int = 0
    sensors: tuple[SensorUse, ...] = ()
    labels: Mapping[str, int] = field(default_factory=dict)
    together: tuple[tuple[str, str, int], ...] = ()
    label_names: Mapping[str, str] = field(default_factory=dict)
    unknown_labels: Mapping[str, int] = field(default_factory=dict)
    looks: int = 0
    detection_count: int = 0
    ids: int = 0
    encoding: Literal["ros2", "protobuf", "json"] | None = None
    pose_problems: Mapping[str, int] = field(default_factory=dict)
    unreadable: Mapping[str, Mapping[str, int]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    problem: str = ""
    course: Course | None = None


def survey(reader: LogReader, model: Model | None = None) -> Survey:
    """Look through a log without failing on what it lacks.

    Args:
        reader: The open log.
        model: What its ``log`` section names is used; None to go by the log alone.
    """
    try:
        inputs = InputReader(reader, model, None, None).read()
    except LogError as error:
        rows = tuple(_channel_use(reader, channel, None) for channel in reader.channels)
        return Survey(channels=_sorted(rows), problem=str(error))
    found, track, source = inputs.detections, inputs.track, inputs.pose_source
    labels = _counted(found.labels.tolist())
    unknown: Mapping[str, int] = {}
    if model is not None:
        indices = translate_labels(list(labels), model, inputs.numbered)
        pairs = zip(labels.items(), indices.tolist(), strict=True)
        unknown = {name: count for (name, count), index in pairs if index < 0}
    max_gap_ns = model.log.max_gap_ns if model is not None else 500_000_000
    problem = ""
    if not inputs.sources.detections:
        problem = "no detections were recognised; name a topic as log.detections"
    elif source is None:
        problem = "no poses were recognised; name a topic as log.odometry"
    is_chain = source is not None and source.channel is None
    covered = track.covered(inputs.stamps_ns, max_gap_ns)
    return Survey(
        channels=_sorted(
            tuple(_channel_use(reader, channel, inputs) for channel in reader.channels)
        ),
        detections=tuple(dict.fromkeys(used.channel.topic for used in inputs.sources.detections)),
        pose_topic=source.channel.topic if source is not None and source.channel else "",
        pose_kind=source.kind if source is not None else "",
        transform=(track.poses.frame, track.poses.child_frame) if is_chain else None,
        world_frame=track.poses.frame,
        robot_frame=track.poses.child_frame or inputs.robot_frame,
        pose_count=len(track),
        placed=int(covered.sum()),
        sensors=_sensors(inputs),
        labels=labels,
        together=_together(found, list(labels)[:_PAIRED_LABELS]),
        label_names=inputs.numbered,
        unknown_labels=unknown,
        looks=found.n_looks,
        detection_count=len(found),
        ids=len(set(found.ids.tolist()) - {""}),
        encoding=inputs.encoding,
        pose_problems=inputs.tally.counts,
        unreadable=inputs.unreadable,
        notes=inputs.notes,
        problem=problem,
        course=_course(inputs, covered, list(labels)),
    )


def _course(inputs: Inputs, covered: BoolArray, labels: list[str]) -> Course:
    found, track = inputs.detections, inputs.track
    poses = np.full((found.n_looks, 3), np.nan)
    if covered.any():
        poses[covered] = track.at(inputs.stamps_ns[covered])[0]
    known, codes = encode_texts(found.labels)
    places = {name: index for index, name in enumerate(labels)}
    return Course(
        track=track.poses,
        looks_ns=inputs.stamps_ns,
        covered=covered,
        poses_world_child=poses,
        label_looks=found.look_index[found.label_detection],
        labels=np.array([places[name] for name in known], dtype=np.int64)[codes],
    )


def _sorted(rows: tuple[ChannelUse, ...]) -> tuple[ChannelUse, ...]:
    return tuple(sorted(rows, key=lambda row: (row.topic, row.schema)))


def _counted(names: list[str]) -> dict[str, int]:
    """How often each name occurs, frequent ones first."""
    counts: dict[str, int] = {}
    for name in names:
        counts[name] = counts.get(name, 0) + 1
    return dict(sorted(counts.items(), key=lambda entry: (-entry[1], entry[0])))


def _together(found: Detections, names: list[str]) -> tuple[tuple[str, str, int], ...]:
    """How often two names were returned for one thing: in one detection, or under one id."""
    if len(names) < 2:
        return ()
    known, codes = encode_texts(found.labels)
    number = {name: index for index, name in enumerate(names)}
    rank = np.array([number.get(name, -1) for name in known])[codes]
    _, owner = encode_texts(found.ids)
    anonymous = found.ids == ""
    owner = np.where(anonymous, -1 - np.arange(len(found)), owner)
    _, thing = np.unique(np.stack([found.look_index, owner]), axis=1, return_inverse=True)
    listed = rank >= 0
    pairs = np.unique(
        np.stack([thing.reshape(-1)[found.label_detection[listed]], rank[listed]]), axis=1
    )
    returned = csr_array(
        (np.ones(pairs.shape[1], np.int64), (pairs[1], pairs[0])), shape=(len(names), len(found))
    )
    counts = (returned @ returned.T).toarray()
    both = [
        (names[first], names[second], int(counts[first, second]))
        for first, second in zip(*np.nonzero(np.triu(counts, 1)), strict=True)
    ]
    return tuple(sorted(both, key=lambda pair: (-pair[2], pair[:2])))


def _sensors(inputs: Inputs) -> tuple[SensorUse, ...]:
    found = []
    for sensor, looks in inputs.sensors:
        used = sensor.camera
        size = None
        calibrated = False
        if used is not None:
            width, height = used.calibrations.image_sizes[-1]
            size = (int(width), int(height)) if width > 0 and height > 0 else None
            calibrated = camera.is_known_model(used.calibrations.model) and bool(
                camera.has_focal_length(used.calibrations.intrinsics).all()
            )
        found.append(
            SensorUse(
                topic=str(inputs.detections.topics[looks[0]]),
                frame=sensor.frame,
                optical=sensor.optical,
                camera_topic=used.topic if used is not None else "",
                calibrated=calibrated,
                image_size=size,
                placed=sensor.placed,
                looks=len(looks),
            )
        )
    return tuple(found)


def _channel_use(reader: LogReader, channel: ChannelInfo, inputs: Inputs | None) -> ChannelUse:
    """Role of a channel, and whether and why it is used."""
    role, used, why = str(role_of(channel.schema_name) or ""), False, "not a type that is read"
    if channel.topic.startswith(own_prefix(reader)):
        why = "written by an earlier run"
    elif channel.message_count == 0:
        why = "holds no messages"
    elif inputs is None:
        why = "nothing is used, as something else is wrong"
    elif channel.id in inputs.sources.unusable:
        why = inputs.sources.unusable[channel.id]
    else:
        role, used, why = _detection_use(channel, inputs) or _other_use(channel, role, inputs)
    start, end = reader.start_ns, reader.end_ns
    rate = None
    if channel.message_count and start is not None and end is not None and end > start:
        rate = channel.message_count / ((end - start) * 1e-9)
    return ChannelUse(
        channel.topic,
        channel.schema_name,
        channel.message_encoding,
        channel.message_count,
        rate,
        role,
        used,
        why,
    )


def _detection_use(channel: ChannelInfo, inputs: Inputs) -> tuple[str, bool, str] | None:
    """Use of a channel that holds detections, by its type or its field names."""
    chosen = inputs.sources.detections
    for source in (*chosen, *inputs.sources.other_detections):
        if source.channel.id == channel.id:
            if source in chosen:
                return "detections", True, source.kind
            preferred = f"{chosen[0].channel.topic} ({chosen[0].kind}) is preferred"
            return "detections", False, preferred
    return None


def _other_use(channel: ChannelInfo, role: str, inputs: Inputs) -> tuple[str, bool, str]:
    """Use of any other channel, by its role."""
    source = inputs.pose_source
    if source is not None and source.channel is not None and source.channel.id == channel.id:
        return "pose", True, source.kind
    cameras = {sensor.camera.topic for sensor, _ in inputs.sensors if sensor.camera}
    by_chain = source is not None and source.channel is None
    used, yes, no = {
        "detections": (False, "", "the model file names other detections"),
        "transforms": (
            channel.id in inputs.read_channels,
            "poses" if by_chain else "where the sensor sits",
            "not needed",
        ),
        "camera": (channel.topic in cameras, "calibration", "of no sensor in use"),
        "label names": (True, "names of numbered labels", ""),
    }.get(
        role, (False, "", f"{source.name} ({source.kind}) is preferred" if source else "unusable")
    )
    return (role, used, yes if used else no) if role else ("", False, "not a type that is read")
