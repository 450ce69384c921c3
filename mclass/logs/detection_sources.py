"""Which channels hold the detections.

Where the model file does not decide, they come from one topic: the best by family
(`families.DETECTIONS`), then fields guessed by name, then image annotations; among equals the
one with more messages, then the first by topic. Annotations beside a real detection channel
say the same twice.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from mclass.errors import LogError
from mclass.logs import families
from mclass.logs.annotations import annotation_paths
from mclass.logs.channels import ChannelInfo
from mclass.logs.families import (
    ANNOTATIONS_RANK,
    GUESSED_RANK,
    MAPPED_RANK,
    Role,
    plain_schema_name,
)
from mclass.logs.field_mapping import mapped_detection_fields
from mclass.logs.fields import DetectionFields, family_detection_fields
from mclass.logs.guesses import guess_detection_fields
from mclass.logs.reader import LogReader
from mclass.logs.tables import Decoders
from mclass.logs.topics import channels_of
from mclass.model import FieldMapping

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


def named_detections(
    reader: LogReader, decoders: Decoders, mapping: FieldMapping
) -> list[DetectionSource]:
    """The channels of one topic that the model file names for detections."""
    found = []
    for channel in channels_of(reader, mapping.topic, "detections"):
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


def choose_detections(
    by_role: Mapping[Role | None, Sequence[ChannelInfo]], decoders: Decoders
) -> tuple[tuple[DetectionSource, ...], tuple[DetectionSource, ...], dict[int, str]]:
    """The best detection channel of the log, those that lost, and why others cannot be used."""
    candidates, unusable = [], {}
    for channel in by_role.get("detections", ()):
        source = _known_source(channel, decoders)
        source = source or _guessed_source(channel, decoders.paths(channel))
        if source is None:
            unusable[channel.id] = "its schema has no labels where its type has them"
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
    # A topic may have several channels, one for each of its publishers.
    best = candidates[:1]
    same = [
        s for s in candidates if (s.channel.topic, s.rank) == (best[0].channel.topic, best[0].rank)
    ]
    chosen = tuple(
        decoders.full_match(s.channel, partial(_guessed_source, s.channel)) or s
        if s.rank == GUESSED_RANK
        else s
        for s in same
    )
    return chosen, tuple(s for s in candidates if s not in same), unusable


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
