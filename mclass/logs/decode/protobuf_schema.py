"""Protobuf schemas: the leaves of a message type, from the descriptors that logs embed.

Descriptors are only read. No classes are made from what a log says.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from google.protobuf.descriptor_pb2 import (
    DescriptorProto,
    EnumDescriptorProto,
    FieldDescriptorProto,
    FileDescriptorSet,
)
from google.protobuf.message import DecodeError
from google.protobuf.text_encoding import CUnescape

from mclass.errors import LogError
from mclass.logs.decode.base import ABSENT, MAX_LEAVES
from mclass.logs.decode.wireformat import BLOB, VARINT, WORD32, WORD64

MAX_NESTING = 64

STAMPS: Mapping[str, str] = {
    "google.protobuf.Timestamp": "time",
    "google.protobuf.Duration": "int",
}
"""Kind of the messages that are one leaf, by name."""

_Type = FieldDescriptorProto

FIXED_TYPES: Mapping[int, np.dtype[Any]] = {
    _Type.TYPE_DOUBLE: np.dtype("<f8"),
    _Type.TYPE_FLOAT: np.dtype("<f4"),
    _Type.TYPE_FIXED64: np.dtype("<u8"),
    _Type.TYPE_SFIXED64: np.dtype("<i8"),
    _Type.TYPE_FIXED32: np.dtype("<u4"),
    _Type.TYPE_SFIXED32: np.dtype("<i4"),
}
"""Numbers of fixed size on the wire, by field type."""

_KINDS: Mapping[int, str] = {
    **{number: "float" if dtype.kind == "f" else "int" for number, dtype in FIXED_TYPES.items()},
    _Type.TYPE_INT64: "int",
    _Type.TYPE_UINT64: "int",
    _Type.TYPE_INT32: "int",
    _Type.TYPE_UINT32: "int",
    _Type.TYPE_SINT32: "int",
    _Type.TYPE_SINT64: "int",
    _Type.TYPE_ENUM: "int",
    _Type.TYPE_BOOL: "bool",
    _Type.TYPE_STRING: "string",
    _Type.TYPE_BYTES: "bytes",
}


@dataclass(frozen=True)
class Leaf:
    """A number, string or stamp.

    Attributes:
        path: Its path, with ``[]`` behind each sequence.
        kind: Of the column.
        type: Field type; ``TYPE_MESSAGE`` for a stamp.
        repeated: Whether it is a sequence.
        default: Its value in messages that leave it out.
    """

    path: str
    kind: str
    type: int
    repeated: bool
    default: Any

    @property
    def is_stamp(self) -> bool:
        """Whether it is a message on the wire, with the fields of `STAMP`."""
        return self.type == _Type.TYPE_MESSAGE

    @property
    def wire(self) -> int:
        """Wire type of one value that is not packed."""
        if self.is_stamp or self.kind in ("string", "bytes"):
            return BLOB
        dtype = FIXED_TYPES.get(self.type)
        return VARINT if dtype is None else WORD64 if dtype.itemsize == 8 else WORD32


@dataclass(frozen=True)
class Branch:
    """A message within a message, or a sequence of them."""

    node: Node
    repeated: bool


@dataclass(frozen=True)
class Node:
    """The fields of a message by number."""

    fields: Mapping[int, Leaf | Branch]

    @cached_property
    def leaves(self) -> tuple[Leaf, ...]:
        """All leaves, of the messages within as well."""
        return tuple(
            leaf
            for item in self.fields.values()
            for leaf in (item.node.leaves if isinstance(item, Branch) else (item,))
        )

    @cached_property
    def has_lists(self) -> bool:
        """Whether anything within is repeated."""
        return any(
            item.repeated or (isinstance(item, Branch) and item.node.has_lists)
            for item in self.fields.values()
        )

    def select(self, wanted: frozenset[str]) -> Node:
        """The same tree with these leaves only."""
        fields: dict[int, Leaf | Branch] = {}
        for number, item in self.fields.items():
            if isinstance(item, Branch):
                node = item.node.select(wanted)
                if node.fields:
                    fields[number] = replace(item, node=node)
            elif item.path in wanted:
                fields[number] = item
        return Node(fields)


SECONDS, NANOS = "seconds", "nanos"

STAMP = Node(
    {
        1: Leaf(SECONDS, "int", _Type.TYPE_INT64, repeated=False, default=0),
        2: Leaf(NANOS, "int", _Type.TYPE_INT32, repeated=False, default=0),
    }
)
"""The fields of a stamp."""


def read_schema(name: str, data: bytes) -> tuple[Node, dict[str, str]]:
    """The leaves of a message type, and the kind of each by path.

    Maps, groups and extensions are left out, as are messages within themselves.

    Args:
        name: Full name of the message type.
        data: A serialised ``FileDescriptorSet``.

    Raises:
        LogError: If the data is no such set, does not define the type or a type it uses, or
            the type has more than ``MAX_LEAVES`` fields.
    """
    try:
        files = FileDescriptorSet.FromString(data).file
    except DecodeError as error:
        raise LogError(f"schema {name!r} is not a protobuf FileDescriptorSet.") from error
    reader = _Reader()
    for file in files:
        package = f"{_text(file.package)}." if file.package else ""
        reader.add_types(package, file.message_type, file.enum_type)
    if name not in reader.messages:
        raise LogError(f"schema {name!r} does not define the message it is named after.")
    node = reader.node(name, "", ())
    return node, reader.kinds


@dataclass
class _Reader:
    """Types by full name, and the leaves found so far."""

    messages: dict[str, DescriptorProto] = field(default_factory=dict)
    enums: dict[str, EnumDescriptorProto] = field(default_factory=dict)
    kinds: dict[str, str] = field(default_factory=dict)
    visits: Iterator[int] = field(default_factory=itertools.count)

    def add_types(
        self,
        package: str,
        messages: Iterable[DescriptorProto],
        enums: Iterable[EnumDescriptorProto],
    ) -> None:
        """Take note of the types of a file or message, nested ones included."""
        for enum in enums:
            self.enums[package + _text(enum.name)] = enum
        for message in messages:
            name = package + _text(message.name)
            self.messages[name] = message
            self.add_types(f"{name}.", message.nested_type, message.enum_type)

    def node(self, name: str, prefix: str, around: tuple[str, ...]) -> Node:
        """The fields of a message that lies within the messages ``around``."""
        if len(around) > MAX_NESTING:
            raise LogError(f"messages are nested more than {MAX_NESTING} deep.")
        fields: dict[int, Leaf | Branch] = {}
        for item in self.messages[name].field:
            if next(self.visits) > MAX_LEAVES:
                raise LogError(f"the schema has more than {MAX_LEAVES} fields.")
            if item.number in fields:
                raise LogError(f"{name} has two fields of number {item.number}.")
            repeated = item.label == _Type.LABEL_REPEATED
            path = f"{prefix}{_text(item.name)}{'[]' if repeated else ''}"
            inner = _text(item.type_name).lstrip(".")
            if item.type == _Type.TYPE_MESSAGE and inner not in STAMPS:
                if inner not in self.messages:
                    raise LogError(f"{name}.{item.name} is a {inner!r}, which is not defined.")
                is_map = self.messages[inner].options.map_entry
                if not is_map and inner not in (name, *around):
                    node = self.node(inner, f"{path}.", (*around, name))
                    fields[item.number] = Branch(node, repeated)
            elif item.type in _KINDS or inner in STAMPS:
                kind = STAMPS.get(inner) or _KINDS[item.type]
                self.kinds[path] = kind
                default = self.default(item, kind)
                fields[item.number] = Leaf(path, kind, item.type, repeated, default)
        return Node(fields)

    def default(self, item: FieldDescriptorProto, kind: str) -> Any:
        """What a message means that leaves the field out."""
        text = _text(item.default_value)
        if item.type == _Type.TYPE_ENUM:
            enum = self.enums.get(item.type_name.lstrip("."))
            values = {value.name: value.number for value in enum.value} if enum else {}
            # Without presence the first value is zero, with it the first listed is meant.
            return values.get(text, next(iter(values.values()), 0))
        if kind == "string":
            return text
        if kind == "bool":
            return text == "true"
        if kind == "float" and item.proto3_optional:
            return ABSENT
        try:
            if kind == "bytes":
                return CUnescape(text)
            return float(text or 0) if kind == "float" else int(text or 0)
        except ValueError as error:
            raise LogError(f"the default {text[:40]!r} of {item.name!r} is no {kind}.") from error


def _text(name: str | bytes) -> str:
    """A name in a descriptor, which comes as bytes when it is not UTF-8."""
    if isinstance(name, bytes):
        raise LogError(f"the schema holds a name that is not UTF-8: {name[:40]!r}.")
    return name
