"""Which channels of a log are used, and as what.

The rules, where the model file does not decide:

- Detections come from one channel: the best by family (`families.DETECTIONS`), then fields
  guessed by name, then image annotations; among equals the one with more messages, then the
  first by topic. Annotations beside a real detection channel say the same twice.
- Poses come from odometry, else a pose with covariance, else a plain pose, else transforms,
  else velocities; among equals the one that covers most detections, then the one with more
  messages, then the first by topic.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

from mclass.errors import LogError
from mclass.logs import families, mounting
from mclass.logs.annotations import annotation_paths
from mclass.logs.families import (
    ANNOTATIONS_RANK,
    GUESSED_RANK,
    MAPPED_RANK,
    TRANSFORM_RANK,
    VELOCITY_RANK,
    CameraFamily,
    Role,
    VelocityFamily,
    first_present,
    plain_schema_name,
    role_of,
)
from mclass.logs.field_mapping import mapped_detection_fields, mapped_pose_fields
from mclass.logs.fields import (
    DetectionFields,
    PoseFields,
    family_detection_fields,
    family_pose_fields,
)
from mclass.logs.guesses import guess_detection_fields
from mclass.logs.reader import ChannelInfo, LogReader
from mclass.logs.tables import Decoders
from mclass.model import FieldMapping, Model, TransformSource

# Types that are never detections, so that their field names need not be looked at.
_OTHER_PACKAGES = (
    "foxglove.",
    "mclass",
    "sensor_msgs/",
    "std_msgs/",
    "nav_msgs/",
    "geometry_msgs/",
    "tf2_msgs/",
    "tf/",
    "visualization_msgs/",
    "rcl_interfaces/",
    "diagnostic_msgs/",
    "rosgraph_msgs/",
)


@dataclass(frozen=True)
class DetectionSource:
    """A channel of detections; ``fields`` None for image annotations."""

    channel: ChannelInfo
    kind: str
    rank: int
    fields: DetectionFields | None
    paths: tuple[str, ...]


@dataclass(frozen=True)
class PoseSource:
    """Where poses may come from: a channel's fields, its velocities, or a transform chain."""

    name: str
    kind: str
    rank: int
    channel: ChannelInfo | None = None
    fields: PoseFields | None = None
    velocity: VelocityFamily | None = None
    transform: TransformSource | None = None
    paths: tuple[str, ...] = ()


@dataclass(frozen=True)
class CameraSource:
    """A channel of calibrations; ``fields`` by their names in `CameraFamily.fields`."""

    channel: ChannelInfo
    family: CameraFamily
    fields: Mapping[str, str]
    paths: tuple[str, ...]


@dataclass
class Sources:
    """What a log offers, before any choice among poses.

    Attributes:
        detections: Used detection channels.
        other_detections: Candidates that lost.
        poses: All candidates, best rank first.
        cameras: Calibration channels.
        transforms: Transform channels with the paths to read.
        label_names: Channels that name numbered labels.
        unusable: Why a channel of a known role cannot be used, by channel id.
    """

    detections: tuple[DetectionSource, ...] = ()
    other_detections: tuple[DetectionSource, ...] = ()
    poses: tuple[PoseSource, ...] = ()
    cameras: tuple[CameraSource, ...] = ()
    transforms: dict[int, tuple[str, ...]] = field(default_factory=dict)
    label_names: tuple[ChannelInfo, ...] = ()
    unusable: dict[int, str] = field(default_factory=dict)


def find_sources(reader: LogReader, decoders: Decoders, model: Model | None) -> Sources:
    """Sort the channels of a log by what they can be used for.

    Args:
        reader: The open log.
        decoders: Its decoders.
        model: Its ``log`` section may name channels; None to go by the log alone.

    Raises:
        LogError: If the model names a topic or field that the log does not have.
    """
    settings = model.log if model is not None else None
    sources, own = Sources(), own_prefix(reader)
    by_role: dict[Role | None, list[ChannelInfo]] = {}
    for channel in reader.channels:
        if channel.message_count == 0 or channel.topic.startswith(own):
            continue
        role = role_of(channel.schema_name)
        if role is not None:
            try:
                decoders.of(channel)
            except LogError as error:
                sources.unusable[channel.id] = str(error)
                continue
        by_role.setdefault(role, []).append(channel)
    mappings = settings.detections if settings else ()
    if mappings:
        sources.detections = tuple(
            source
            for mapping in mappings
            for source in _named_detections(reader, decoders, mapping)
        )
    else:
        _choose_detections(sources, by_role, decoders)
    named = settings.odometry if settings else None
    if named is not None:
        sources.poses = (_named_poses(reader, decoders, named),)
    else:
        sources.poses = _pose_candidates(by_role, decoders)
    _find_others(sources, by_role, decoders)
    if settings and settings.camera_info:
        topic = settings.camera_info
        _channels_of(reader, topic, "camera_info")
        sources.cameras = tuple(c for c in sources.cameras if c.channel.topic == topic)
        if not sources.cameras:
            raise LogError(
                "is no camera calibration. Name a topic of sensor_msgs/CameraInfo or "
                "foxglove.CameraCalibration as log.camera_info.",
                path=str(reader.path),
                topic=topic,
            )
    return sources


def own_prefix(reader: LogReader) -> str:
    """Beginning of the topics that an earlier run wrote into this log."""
    recorded = reader.metadata("mclass") if "mclass" in reader.metadata_names else None
    return (recorded or {}).get("prefix", "/mclass").rstrip("/") + "/"


def topics_present(reader: LogReader) -> str:
    """All topics for an error message."""
    topics = sorted({channel.topic for channel in reader.channels})
    shown = ", ".join(topics[:40]) or "none"
    return shown + (f" and {len(topics) - 40} more" if len(topics) > 40 else "")


def _channels_of(reader: LogReader, topic: str, key: str) -> list[ChannelInfo]:
    """Channels of a topic that the model file names.

    Raises:
        LogError: If there is none.
    """
    found = [channel for channel in reader.channels if channel.topic == topic]
    if not found:
        raise LogError(
            f"no topic {topic}. Topics present: {topics_present(reader)}. Set log.{key}.",
            path=str(reader.path),
            topic=topic,
        )
    return found


def _named_detections(
    reader: LogReader, decoders: Decoders, mapping: FieldMapping
) -> list[DetectionSource]:
    """The channels of one topic that the model file names for detections."""
    found = []
    for channel in _channels_of(reader, mapping.topic, "detections"):
        if mapping.fields:
            source = _mapped_source(channel, decoders, mapping)
        else:
            known = _known_source(channel, decoders) or decoders.full_match(
                channel, partial(_guessed_source, channel)
            )
            if known is None:
                paths = decoders.of(channel).paths
                raise LogError(
                    "no labels were recognised in its messages. Give log.detections the field "
                    f"paths of label, id and box. Fields present: {', '.join(list(paths)[:30])}.",
                    path=str(reader.path),
                    topic=mapping.topic,
                )
            source = known
        found.append(source)
    return found


def _mapped_source(
    channel: ChannelInfo, decoders: Decoders, mapping: FieldMapping
) -> DetectionSource:
    """A detection channel whose fields the model file gives."""

    def find(paths: Mapping[str, str]) -> DetectionFields | None:
        try:
            return mapped_detection_fields(mapping, paths)
        except LogError as error:
            problems.append(error)
            return None

    problems: list[LogError] = []
    fields = decoders.full_match(channel, find)
    if fields is None:
        raise problems[-1]
    return DetectionSource(channel, "field mapping", MAPPED_RANK, fields, fields.paths)


def _known_source(channel: ChannelInfo, decoders: Decoders) -> DetectionSource | None:
    """A detection channel by its type.

    Messages that name their own fields may never have held a detection: their silence counts.
    """
    name = plain_schema_name(channel.schema_name)
    if name in families.ANNOTATION_SCHEMAS:
        wanted = decoders.full_match(channel, annotation_paths)
        if wanted is not None:
            return DetectionSource(channel, "ImageAnnotations", ANNOTATIONS_RANK, None, wanted)
    for family in families.DETECTIONS:
        if name in family.schemas:
            fields = decoders.full_match(channel, partial(family_detection_fields, family))
            if fields is None and channel.message_encoding == "json":
                fields = family_detection_fields(family, decoders.paths(channel), silent=True)
            if fields is not None:
                return DetectionSource(channel, family.name, family.rank, fields, fields.paths)
    return None


def _guessed_source(channel: ChannelInfo, paths: Mapping[str, str]) -> DetectionSource | None:
    """A detection channel by the names of its fields."""
    fields = guess_detection_fields(paths)
    if fields is None:
        return None
    return DetectionSource(channel, "fields by name", GUESSED_RANK, fields, fields.paths)


def _choose_detections(
    sources: Sources, by_role: Mapping[Role | None, Sequence[ChannelInfo]], decoders: Decoders
) -> None:
    """The best detection channel of the log, and those that lost."""
    candidates = []
    for channel in by_role.get("detections", ()):
        source = _known_source(channel, decoders)
        source = source or _guessed_source(channel, decoders.paths(channel))
        if source is None:
            sources.unusable[channel.id] = "its schema has no labels where its type has them"
        else:
            candidates.append(source)
    if all(source.rank > GUESSED_RANK for source in candidates):
        for channel in by_role.get(None, ()):
            if not plain_schema_name(channel.schema_name).startswith(_OTHER_PACKAGES):
                source = decoders.first_match(channel, partial(_guessed_source, channel))
                if source is not None:
                    candidates.append(source)
    candidates.sort(
        key=lambda source: (
            source.rank,
            -(source.channel.message_count or 0),
            source.channel.topic,
            source.channel.id,
        )
    )
    if candidates:
        # A topic may have several channels, one for each of its publishers.
        best = candidates[0]
        same = [
            s for s in candidates if (s.channel.topic, s.rank) == (best.channel.topic, best.rank)
        ]
        sources.detections = tuple(
            decoders.full_match(s.channel, partial(_guessed_source, s.channel)) or s
            if s.rank == GUESSED_RANK
            else s
            for s in same
        )
        sources.other_detections = tuple(s for s in candidates if s not in same)


def _pose_candidates(
    by_role: Mapping[Role | None, Sequence[ChannelInfo]], decoders: Decoders
) -> tuple[PoseSource, ...]:
    """All channels that can give poses, best rank first."""
    found = []
    for channel in by_role.get("pose", ()):
        source = _pose_source(channel, decoders)
        if source is not None:
            found.append(source)
    if by_role.get("transforms"):
        found.append(PoseSource("transforms", "transforms", TRANSFORM_RANK))
    for channel in by_role.get("velocity", ()):
        source = _velocity_source(channel, decoders)
        if source is not None:
            found.append(source)
    return tuple(sorted(found, key=lambda source: (source.rank, source.name)))


def _pose_source(channel: ChannelInfo, decoders: Decoders) -> PoseSource | None:
    name, paths = plain_schema_name(channel.schema_name), decoders.paths(channel)
    for family in families.POSES:
        if name in family.schemas:
            fields = family_pose_fields(family, paths)
            if fields is not None:
                kind = name.replace("/", ".").rpartition(".")[2]
                return PoseSource(
                    channel.topic, kind, family.rank, channel, fields, paths=fields.paths
                )
    return None


def _velocity_source(channel: ChannelInfo, decoders: Decoders) -> PoseSource | None:
    name, paths = plain_schema_name(channel.schema_name), decoders.paths(channel)
    for family in families.VELOCITIES:
        wanted = (
            *(f"{family.linear}.{axis}" for axis in "xy"),
            f"{family.angular}.z",
            *family.stamp,
            *family.frame,
        )
        if name in family.schemas and all(path in paths for path in wanted):
            return PoseSource(
                channel.topic, family.name, VELOCITY_RANK, channel, velocity=family, paths=wanted
            )
    return None


def _named_poses(
    reader: LogReader, decoders: Decoders, named: FieldMapping | TransformSource
) -> PoseSource:
    """The pose source that the model file names."""
    if isinstance(named, TransformSource):
        name = f"transforms {named.parent} to {named.child}"
        return PoseSource(name, "transforms", MAPPED_RANK, transform=named)
    channel = max(
        _channels_of(reader, named.topic, "odometry"),
        key=lambda candidate: candidate.message_count or 0,
    )
    paths = decoders.of(channel).paths
    if not named.fields:
        if role_of(channel.schema_name) == "transforms":
            return PoseSource("transforms", "transforms", TRANSFORM_RANK)
        known = _pose_source(channel, decoders) or _velocity_source(channel, decoders)
        if known is not None:
            return known
    fields = mapped_pose_fields(named, paths)
    return PoseSource(
        channel.topic, "field mapping", MAPPED_RANK, channel, fields, paths=fields.paths
    )


def _find_others(
    sources: Sources, by_role: Mapping[Role | None, Sequence[ChannelInfo]], decoders: Decoders
) -> None:
    """Cameras, transforms and label names."""
    cameras = []
    for channel in by_role.get("camera", ()):
        name, paths = plain_schema_name(channel.schema_name), decoders.paths(channel)
        family = next(f for f in families.CAMERAS if name in f.schemas)
        fields = {
            key: path
            for key, alternatives in family.fields.items()
            if (path := first_present(alternatives, paths)) is not None
        }
        head = tuple(path for path in (family.stamp, family.frame) if path in paths)
        if "intrinsics" in fields and len(head) == 2:
            cameras.append(CameraSource(channel, family, fields, (*head, *fields.values())))
        else:
            sources.unusable[channel.id] = "its schema lacks the intrinsics, stamp or frame"
    sources.cameras = tuple(sorted(cameras, key=lambda camera: camera.channel.topic))
    for channel in by_role.get("transforms", ()):
        transform = mounting.transform_family(channel)
        wanted = transform and mounting.transform_paths(transform, decoders.paths(channel))
        if wanted:
            sources.transforms[channel.id] = wanted
        else:
            sources.unusable[channel.id] = "its schema lacks a part of a transform"
    sources.label_names = tuple(
        channel
        for channel in by_role.get("label names", ())
        if all(path in decoders.paths(channel) for path in families.LABEL_NAME_FIELDS)
    )
