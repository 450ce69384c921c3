"""Which channels of a log are used, and as what."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from mclass.errors import LogError
from mclass.logs import families, mounting
from mclass.logs.channels import ChannelInfo
from mclass.logs.detection_sources import DetectionSource, choose_detections, named_detections
from mclass.logs.families import CameraFamily, Role, first_present, plain_schema_name, role_of
from mclass.logs.pose_sources import PoseSource, named_poses, pose_candidates
from mclass.logs.reader import LogReader
from mclass.logs.tables import Decoders
from mclass.logs.topics import channels_of, own_prefix
from mclass.model import Model


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
            source for mapping in mappings for source in named_detections(reader, decoders, mapping)
        )
    else:
        chosen, others, unusable = choose_detections(by_role, decoders)
        sources.detections, sources.other_detections = chosen, others
        sources.unusable.update(unusable)
    named = settings.odometry if settings else None
    if named is not None:
        sources.poses = (named_poses(reader, decoders, named),)
    else:
        sources.poses = pose_candidates(by_role, decoders)
    _find_others(sources, by_role, decoders)
    if settings and settings.camera_info:
        topic = settings.camera_info
        channels_of(reader, topic, "camera_info")
        sources.cameras = tuple(c for c in sources.cameras if c.channel.topic == topic)
        if not sources.cameras:
            raise LogError(
                "is no camera calibration. Name a topic of sensor_msgs/CameraInfo or "
                "foxglove.CameraCalibration as log.camera_info.",
                path=str(reader.path),
                topic=topic,
            )
    return sources


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
