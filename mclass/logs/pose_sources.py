"""Which channels poses may come from.

Where the model file does not decide: odometry, else a pose with covariance, else a plain pose,
else transforms, else velocities; among equals the one that covers most detections, then the one
with more messages, then the first by topic.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from mclass.logs import families
from mclass.logs.channels import ChannelInfo
from mclass.logs.families import (
    MAPPED_RANK,
    TRANSFORM_RANK,
    VELOCITY_RANK,
    Role,
    VelocityFamily,
    plain_schema_name,
    role_of,
)
from mclass.logs.field_mapping import mapped_pose_fields
from mclass.logs.fields import PoseFields, family_pose_fields
from mclass.logs.reader import LogReader
from mclass.logs.tables import Decoders
from mclass.logs.topics import channels_of
from mclass.model import FieldMapping, TransformSource


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


def pose_candidates(
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


def named_poses(
    reader: LogReader, decoders: Decoders, named: FieldMapping | TransformSource
) -> PoseSource:
    """The pose source that the model file names."""
    if isinstance(named, TransformSource):
        name = f"transforms {named.parent} to {named.child}"
        return PoseSource(name, "transforms", MAPPED_RANK, transform=named)
    channel = max(
        channels_of(reader, named.topic, "odometry"),
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
