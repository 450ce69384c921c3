"""What every encoding of the results does, and what it makes: messages ready to be written."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from mclass.classes import BACKGROUND
from mclass.outputs.names import TopicTokens
from mclass.records import LabelMeasurements
from mclass.results import BeliefBlock, ClassMaps, ObjectEstimate

NANOSECONDS = 1_000_000_000


@dataclass(frozen=True)
class Schema:
    """How the messages of a channel are encoded and described."""

    name: str
    message_encoding: str
    schema_encoding: str
    data: bytes


@dataclass(frozen=True)
class Message:
    """One encoded message for one topic."""

    topic: str
    schema: Schema
    data: bytes


@dataclass(frozen=True)
class OutputContext:
    """What all messages of one output share.

    Attributes:
        frame: World frame of everything.
        class_names: Without the background.
        prefix: Of all topics, ``/mclass``.
        arrow_length: Of viewers' arrows [m].
    """

    frame: str
    class_names: tuple[str, ...]
    prefix: str
    arrow_length: float
    _objects: TopicTokens = field(default_factory=TopicTokens)
    _classes: TopicTokens = field(default_factory=TopicTokens)

    @property
    def all_names(self) -> tuple[str, ...]:
        """The background, then the classes."""
        return (BACKGROUND, *self.class_names)

    def topic(self, *parts: str) -> str:
        """Topic below the prefix."""
        return "/".join((self.prefix, *parts))

    def object_token(self, object_id: str) -> str:
        """Topic part of an object."""
        return self._objects.token(object_id)

    def class_topic(self, name: str) -> str:
        """Topic of a class's map."""
        return self.topic("grid", self._classes.token(name))


class Encoder(Protocol):
    """One encoding of all results.

    ``channels`` are those that every output has, by topic; poses of objects come as the
    objects do. Methods raise LogError if a value cannot be encoded, ModelError if one is NaN.
    """

    channels: Mapping[str, Schema]

    def objects(
        self, estimates: Sequence[ObjectEstimate], changed: Sequence[ObjectEstimate], stamp_ns: int
    ) -> Iterator[Message]:
        """All objects, and poses of those that changed."""
        ...

    def maps(self, maps: ClassMaps) -> Iterator[Message]:
        """Class maps."""
        ...

    def belief(self, block: BeliefBlock) -> Iterator[Message]:
        """One block of a belief."""
        ...

    def measurements(self, measurements: LabelMeasurements) -> Iterator[Message]:
        """All measurements."""
        ...


def split_stamp(stamp_ns: int) -> tuple[int, int]:
    """Seconds, and nanoseconds from 0 to 10⁹ - 1."""
    return divmod(int(stamp_ns), NANOSECONDS)
