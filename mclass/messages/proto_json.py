"""JSON form of the messages that protobuf files declare, as Foxglove writes it.

Field names stay as they are; 64-bit integers are strings, which JavaScript would round
otherwise; bytes are base64; a timestamp or duration is ``{"sec": ..., "nsec": ...}``; null
stands for infinity, for which JSON has no number.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
from google.protobuf.descriptor_pb2 import FieldDescriptorProto

from mclass.errors import LogError
from mclass.messages.prepared import Prepared, Value
from mclass.messages.proto_files import messages_of

_F = FieldDescriptorProto
_TIMES: Mapping[str, Mapping[str, str]] = {
    name: {"seconds": "sec", "nanos": "nsec"}
    for name in ("google.protobuf.Timestamp", "google.protobuf.Duration")
}
_BIG = (
    _F.TYPE_INT64,
    _F.TYPE_UINT64,
    _F.TYPE_FIXED64,
    _F.TYPE_SFIXED64,
)
_REAL = (_F.TYPE_DOUBLE, _F.TYPE_FLOAT)
_TEXT = (_F.TYPE_STRING, _F.TYPE_BYTES)


class JsonCodec:
    """Encoder and decoder of one message type."""

    def __init__(self, name: str) -> None:
        """Prepare for the message with the full name ``name``; see `proto_files.files_of`."""
        self.name = name
        self._declared = messages_of(name)

    def encode(self, value: Value) -> bytes:
        """Bytes of a message; see `protobuf.ProtobufCodec.encode` for values.

        Raises:
            LogError: If a value does not fit its field, or is NaN or minus infinity.
        """
        try:
            return self._encode(self.name, value)
        except (TypeError, ValueError, OverflowError, AttributeError) as error:
            raise LogError(f"{self.name} cannot hold this message: {error}") from error

    def decode(self, data: bytes | bytearray | memoryview) -> dict[str, Any]:
        """Message from bytes; absent fields hold what proto3 says, unknown ones are left out.

        Raises:
            LogError: If the bytes are not such a message.
        """
        try:
            return self._decode(self.name, json.loads(bytes(data)))
        except (TypeError, ValueError, AttributeError, RecursionError) as error:
            raise LogError(f"not a {self.name}: {error}") from error

    def _encode(self, name: str, value: Any) -> bytes:
        if isinstance(value, Prepared):
            key = (name, "json")
            return value.encoded(key) or value.keep(key, self._encode(name, value.value))
        fields = {field.name: field for field in self._declared[name].field}
        if not isinstance(value, Mapping):
            value = dict(zip(fields, value, strict=True))
        if not fields.keys() >= value.keys():
            raise ValueError(f"{name} has no field {sorted(value.keys() - fields.keys())}")
        names = _TIMES.get(name, {})
        # Absent fields are written too: viewers list what a message has by its content. Only
        # numbers that are optional mean something by being absent.
        parts = [
            b'"%s":%s' % (names.get(key, key).encode(), self._field(field, value.get(key)))
            for key, field in fields.items()
            if key in value or not field.proto3_optional or field.type == _F.TYPE_MESSAGE
        ]
        return b"{%s}" % b",".join(parts)

    def _field(self, field: FieldDescriptorProto, content: Any) -> bytes:
        if field.label == _F.LABEL_REPEATED:
            items = () if content is None else content
            return b"[%s]" % b",".join(self._single(field, item) for item in items)
        return self._single(field, content)

    def _single(self, field: FieldDescriptorProto, content: Any) -> bytes:
        """One value as JSON; None for the zero of its type."""
        if field.type == _F.TYPE_MESSAGE:
            return self._encode(field.type_name[1:], {} if content is None else content)
        if field.type == _F.TYPE_BYTES:
            content = base64.b64encode(content or b"").decode("ascii")
        elif field.type == _F.TYPE_STRING:
            content = "" if content is None else content
            if not isinstance(content, str):
                raise TypeError(f"{field.name} takes text, not {type(content).__name__}")
        elif field.type in _REAL:
            content = float(0.0 if content is None else content)
            content = None if content == math.inf else content
        elif field.type == _F.TYPE_BOOL:
            content = bool(content)
        else:
            content = 0 if content is None else content.__index__()
            # Times keep plain numbers, as all who read Foxglove's JSON expect.
            if field.type in _BIG and field.name != "seconds":
                content = str(content)
        # Escapes keep halves of surrogate pairs apart, which UTF-8 could not hold.
        return json.dumps(content, allow_nan=False).encode("ascii")

    def _decode(self, name: str, content: Any) -> dict[str, Any]:
        if not isinstance(content, dict):
            raise TypeError(f"{name} is an object, not {type(content).__name__}")
        names = _TIMES.get(name, {})
        message = {}
        for field in self._declared[name].field:
            key = names.get(field.name, field.name)
            given = content.get(key)
            if given is None and key in content and field.type in _REAL:
                given = math.inf
            if field.label != _F.LABEL_REPEATED:
                message[field.name] = self._value(field, given)
                continue
            if given is not None and not isinstance(given, list):
                raise TypeError(f"{field.name} is an array, not {type(given).__name__}")
            items = [self._value(field, item) for item in given or ()]
            message[field.name] = np.array(items, float) if field.type in _REAL else items
        return message

    def _value(self, field: FieldDescriptorProto, given: Any) -> Any:
        if field.type == _F.TYPE_MESSAGE:
            return self._decode(field.type_name[1:], {} if given is None else given)
        if field.type == _F.TYPE_BYTES:
            return base64.b64decode(given or "", validate=True)
        if field.type == _F.TYPE_STRING:
            if given is not None and not isinstance(given, str):
                raise TypeError(f"{field.name} is text, not {type(given).__name__}")
            return given or ""
        if field.type in _REAL:
            return 0.0 if given is None else float(given)
        return bool(given) if field.type == _F.TYPE_BOOL else int(given or 0)


@cache
def codec(name: str) -> JsonCodec:
    """Encoder and decoder of a message by its full name.

    Raises:
        MclassError: If the message is not known here.
    """
    return JsonCodec(name)


@cache
def schema_text(name: str) -> str:
    """JSON Schema of a message by its full name, as logs embed it.

    Every type is written out where it is used: not all viewers follow references.
    """
    schema = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": name,
        **_message_schema(name, name),
    }
    return json.dumps(schema, indent=2) + "\n"


def _message_schema(root: str, name: str) -> dict[str, Any]:
    names = _TIMES.get(name, {})
    properties = {}
    for field in messages_of(root)[name].field:
        single = _field_schema(root, field)
        repeated = field.label == _F.LABEL_REPEATED
        properties[names.get(field.name, field.name)] = (
            {"type": "array", "items": single} if repeated else single
        )
    return {"type": "object", "properties": properties}


def _field_schema(root: str, field: FieldDescriptorProto) -> dict[str, Any]:
    if field.type == _F.TYPE_MESSAGE:
        return _message_schema(root, field.type_name[1:])
    if field.type == _F.TYPE_BYTES:
        return {"type": "string", "contentEncoding": "base64"}
    if field.type in _TEXT or (field.type in _BIG and field.name != "seconds"):
        return {"type": "string"}
    if field.type in _REAL:
        return {"type": "number"}
    return {"type": "boolean" if field.type == _F.TYPE_BOOL else "integer"}
