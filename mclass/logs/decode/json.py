"""JSON messages: parsed one by one, then taken apart level by level.

A field that a message leaves out, or sets to null, is `ABSENT` for a ``float``, ``""``, ``b""``,
false, or an empty sequence. An ``int`` or ``time`` has no such value: its message is left out.
"""

from __future__ import annotations

import base64
import binascii
import itertools
import json
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timezone
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import numpy.typing as npt

from mclass.errors import LogError
from mclass.logs.decode.base import ABSENT, MAX_LEAVES, ChannelDecoder, Column, DamagedError
from mclass.logs.decode.ragged import offsets_from
from mclass.records import IntArray

if TYPE_CHECKING:
    from mclass.logs.channels import ChannelInfo, MessageBatch

MAX_DEPTH = 64

_NAN = float("nan")

NOT_JSON = "not a JSON object"

# What json.loads returns; checked wherever it is used.
Value: TypeAlias = Any

_STAMP_KEYS = (("sec", "nsec"), ("sec", "nanosec"), ("secs", "nsecs"), ("seconds", "nanos"))
_DATE_TIME = re.compile(
    r"(\d{4})-(\d\d)-(\d\d)[Tt ](\d\d):(\d\d):(\d\d)(?:\.(\d+))?([Zz]|[+-]\d\d:\d\d)"
)
_EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)
_INTEGER = re.compile(r"-?\d{1,20}")
_ELEMENT = "[]"


class JsonDecoder(ChannelDecoder):
    """Decoder of ``json`` channels, with or without a JSON Schema."""

    def __init__(self, channel: ChannelInfo) -> None:
        self._schema_kinds: dict[str, str] = {}
        self._learned_kinds: dict[str, str] = {}
        try:
            schema = json.loads(channel.schema_data or b"{}")
        except (ValueError, RecursionError):
            # JSON names its own fields, so a schema in another language is no obstacle.
            return
        _SchemaReader(schema, self._schema_kinds).read(schema, "", ())

    @property
    def paths(self) -> Mapping[str, str]:
        """Kind of every leaf by its path: those of the schema, then those learned."""
        return {**self._learned_kinds, **self._schema_kinds}

    def learn(self, batch: MessageBatch) -> None:
        """Add the paths and kinds that the messages of a batch show."""
        documents, _ = _parse(batch, np.arange(len(batch.offsets)))
        for document in documents:
            self._learn_value(document, "", 0)

    def _learn_value(self, value: Value, path: str, depth: int) -> None:
        if depth > MAX_DEPTH or len(self._learned_kinds) >= MAX_LEAVES:
            return
        if isinstance(value, dict) and _stamp_keys(value) is None:
            for name, inner in value.items():
                if name and "." not in name and _ELEMENT not in name:
                    self._learn_value(inner, f"{path}.{name}" if path else name, depth + 1)
        elif isinstance(value, list):
            for inner in value:
                self._learn_value(inner, path + _ELEMENT, depth + 1)
        elif value is not None:
            kind = _kind_of(value)
            known = self._learned_kinds.get(path, kind)
            self._learned_kinds[path] = _common_kind(known, kind)

    def _decode(
        self, batch: MessageBatch, rows: IntArray, wanted: tuple[str, ...]
    ) -> dict[str, Column]:
        documents, found = _parse(batch, rows)
        kinds = self.paths
        root = _Node()
        for path in wanted:
            root.add(path, kinds[path], exact=path in self._schema_kinds)
        walk = _Walk({}, found)
        walk.read(root, documents, np.arange(len(rows), dtype=np.int64), ())
        if walk.found:
            raise DamagedError(walk.found)
        return walk.columns


def _parse(batch: MessageBatch, rows: IntArray) -> tuple[list[Value], list[tuple[str, IntArray]]]:
    """Parsed messages, None for those that are no object, and which these are."""
    buffer = memoryview(batch.buffer)
    documents: list[Value] = []
    starts = batch.offsets[rows]
    for start, stop in zip(starts.tolist(), (starts + batch.lengths[rows]).tolist(), strict=True):
        try:
            document = json.loads(bytes(buffer[start:stop]))
        except (ValueError, RecursionError):
            document = None
        documents.append(document if isinstance(document, dict) else None)
    bad = [index for index, document in enumerate(documents) if document is None]
    return documents, [(NOT_JSON, np.array(bad, dtype=np.int64))] if bad else []


@dataclass
class _Node:
    """What is wanted of a value: itself as a leaf, its members, its elements."""

    path: str | None = None
    kind: str = ""
    exact: bool = True
    members: dict[str, _Node] = field(default_factory=dict)
    element: _Node | None = None

    def add(self, path: str, kind: str, *, exact: bool) -> None:
        """Want the leaf at ``path``; ``exact`` if its kind is the schema's, not learned."""
        node = self
        for part in path.split("."):
            name = part.partition(_ELEMENT)[0]
            # A path that starts with brackets or holds them twice has levels without a name.
            if name:
                node = node.members.setdefault(name, _Node())
            for _ in range((len(part) - len(name)) // len(_ELEMENT)):
                node.element = node.element or _Node()
                node = node.element
        node.path, node.kind, node.exact = path, kind, exact


@dataclass
class _Walk:
    """One pass over parsed messages; ``found`` collects those that contradict the schema."""

    columns: dict[str, Column]
    found: list[tuple[str, IntArray]]

    def read(
        self, node: _Node, values: list[Value], messages: IntArray, levels: tuple[IntArray, ...]
    ) -> None:
        """Take values apart; each belongs to a message and lies in these sequences."""
        if node.path is not None:
            self.columns[node.path] = Column(self.convert(node, values, messages), levels)
        if node.members:
            objects = self.only(dict, values, messages, "an object was expected")
            for name, child in node.members.items():
                inner = [None if item is None else item.get(name) for item in objects]
                self.read(child, inner, messages, levels)
        if node.element is not None:
            lists = self.only(list, values, messages, "an array was expected")
            lengths = [0 if item is None else len(item) for item in lists]
            counts = np.array(lengths, dtype=np.int64)
            inner = list(itertools.chain.from_iterable(item for item in lists if item))
            offsets = offsets_from(counts)
            self.read(node.element, inner, np.repeat(messages, counts), (*levels, offsets))

    def only(
        self, wanted: type, values: list[Value], messages: IntArray, reason: str
    ) -> list[Value]:
        """The values with those of other types as None, and their messages as found."""
        good = [value is None or isinstance(value, wanted) for value in values]
        if all(good):
            return values
        self.found.append((reason, messages[~np.array(good)]))
        return [value if fits else None for value, fits in zip(values, good, strict=True)]

    def convert(self, node: _Node, values: list[Value], messages: IntArray) -> npt.NDArray[Any]:
        """Values of one leaf as an array."""
        kind = node.kind
        types = set(map(type, values))
        if kind == "int" and not node.exact and float in types:
            kind = "float"
        if kind == "float" and types <= {float}:
            return np.array(values, dtype=np.float64)
        converter, dtype = _CONVERTERS[kind]
        converted = []
        bad = []
        for index, value in enumerate(values):
            try:
                converted.append(converter(value))
            except (ValueError, TypeError, OverflowError):  # noqa: PERF203
                converted.append(converter(_HARMLESS[kind]))
                bad.append(index)
        if bad:
            self.found.append((f"{node.path} is missing or no {kind}", messages[bad]))
        array = np.empty(len(converted), dtype=dtype)
        array[:] = converted
        return array


@dataclass
class _SchemaReader:
    """Finds the leaves of a JSON Schema."""

    root: Value
    kinds: dict[str, str]
    visits: Iterator[int] = field(default_factory=itertools.count)

    def read(self, schema: Value, path: str, references: tuple[str, ...]) -> None:
        """Add the leaves of the schema of the value at ``path``."""
        if not isinstance(schema, dict) or path.count(".") > MAX_DEPTH:
            return
        if next(self.visits) > MAX_LEAVES:
            raise LogError(f"the schema has more than {MAX_LEAVES} fields.")
        reference = schema.get("$ref")
        if isinstance(reference, str) and reference not in references:
            self.read(self.resolve(reference), path, (*references, reference))
        for keyword in ("allOf", "anyOf", "oneOf"):
            for inner in _as_list(schema.get(keyword)):
                self.read(inner, path, references)
        types = _as_list(schema.get("type"))
        properties = schema.get("properties")
        if isinstance(properties, dict):
            self.read_properties(schema, properties, path, references)
        elif "items" in schema:
            self.read(schema["items"], path + _ELEMENT, references)
        elif "string" in types and path:
            is_time = schema.get("format") == "date-time"
            is_bytes = schema.get("contentEncoding") == "base64"
            self.kinds[path] = "time" if is_time else "bytes" if is_bytes else "string"
        elif path:
            for name, kind in (("number", "float"), ("integer", "int"), ("boolean", "bool")):
                if name in types:
                    self.kinds[path] = kind
                    break

    def read_properties(
        self, schema: Value, properties: Value, path: str, references: tuple[str, ...]
    ) -> None:
        """Add the leaves of an object, or the object itself if it is a stamp."""
        if path and any(set(properties) == set(keys) for keys in _STAMP_KEYS):
            self.kinds[path] = "int" if schema.get("title") == "duration" else "time"
            return
        for name, inner in properties.items():
            if name and "." not in name and _ELEMENT not in name:
                self.read(inner, f"{path}.{name}" if path else name, references)

    def resolve(self, reference: str) -> Value:
        """The part of the schema that ``#/a/b`` points to, None if there is none."""
        if not reference.startswith("#"):
            return None
        part = self.root
        for name in reference[1:].split("/")[1:]:
            key = name.replace("~1", "/").replace("~0", "~")
            part = part.get(key) if isinstance(part, dict) else None
        return part


def _as_list(value: Value) -> Sequence[Value]:
    return value if isinstance(value, list) else [value]


def _stamp_keys(value: Mapping[str, Value]) -> tuple[str, str] | None:
    """The names of seconds and nanoseconds if the object is a stamp."""
    if len(value) == 2:
        for keys in _STAMP_KEYS:
            if all(isinstance(value.get(key), int) for key in keys):
                return keys
    return None


def _kind_of(value: Value) -> str:
    if isinstance(value, dict):
        return "time"
    if isinstance(value, str):
        return "time" if _DATE_TIME.fullmatch(value) else "string"
    return {bool: "bool", int: "int"}.get(type(value), "float")


def _common_kind(known: str, kind: str) -> str:
    """Kind of a leaf that has been seen as both."""
    if {known, kind} == {"int", "float"}:
        return "float"
    return "string" if "string" in (known, kind) else known


def _to_float(value: Value) -> float:
    if value is None:
        return ABSENT
    if isinstance(value, bool) or (isinstance(value, str) and "_" in value):
        raise ValueError
    number = float(value)
    return _NAN if math.isnan(number) else number


def _to_int(value: Value) -> int:
    if isinstance(value, str):
        is_integer = _INTEGER.fullmatch(value) is not None
    else:
        is_integer = isinstance(value, float) and value.is_integer()
    if is_integer:
        value = int(value)
    elif isinstance(value, dict):
        return _to_time(value)
    if isinstance(value, bool) or not isinstance(value, int):
        raise ValueError
    return _fitting(value)


def _fitting(value: int) -> int:
    if not -(2**63) <= value < 2**63:
        raise OverflowError
    return value


def _to_bool(value: Value) -> bool:
    if not isinstance(value, bool | None):
        raise ValueError
    return bool(value)


def _to_text(value: Value) -> str:
    if isinstance(value, int) and not isinstance(value, bool):
        return str(value)
    if not isinstance(value, str | None):
        raise ValueError
    if value is None or value.isascii():
        return value or ""
    # Escapes can smuggle in half characters, which no encoding could write again.
    return value.encode("utf-16", "surrogatepass").decode("utf-16", "replace")


def _to_bytes(value: Value) -> bytes:
    if value is None:
        return b""
    if not isinstance(value, str):
        raise ValueError
    try:
        return base64.b64decode(value, validate=True)
    except binascii.Error as error:
        raise ValueError from error


def _to_time(value: Value) -> int:
    if isinstance(value, dict):
        keys = _stamp_keys(value)
        if keys is None:
            raise ValueError
        return _fitting(value[keys[0]] * 1_000_000_000 + value[keys[1]])
    match = _DATE_TIME.fullmatch(value) if isinstance(value, str) else None
    if match is None:
        return _to_int(value)
    *parts, fraction, zone = match.groups()
    second = int(parts[5])
    # A leap second has no place in a day of datetime.
    moment = datetime(*map(int, parts[:5]), tzinfo=timezone.utc)  # type: ignore[misc, arg-type]
    since = moment - _EPOCH
    minutes = 0 if zone in "Zz" else int(zone[1:3]) * 60 + int(zone[4:])
    minutes = -minutes if zone.startswith("-") else minutes
    seconds = since.days * 86_400 + since.seconds + second - minutes * 60
    return _fitting(seconds * 1_000_000_000 + int((fraction or "").ljust(9, "0")[:9]))


_CONVERTERS: Mapping[str, tuple[Callable[[Value], Any], Any]] = {
    "float": (_to_float, np.float64),
    "int": (_to_int, np.int64),
    "bool": (_to_bool, np.bool_),
    "string": (_to_text, object),
    "bytes": (_to_bytes, object),
    "time": (_to_time, np.int64),
}
# What stands in for a value that cannot be converted, until its message is left out.
_HARMLESS: Mapping[str, Value] = {
    "float": None,
    "int": 0,
    "bool": None,
    "string": None,
    "bytes": None,
    "time": 0,
}
