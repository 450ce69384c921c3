"""Protobuf messages as mappings to bytes and back, arrays of fixed-size numbers in bulk.

A packed field of ``double``, ``float`` or ``fixed`` numbers is the numbers' own bytes behind a
length, so arrays are written and read without a Python object for each number, which the
protobuf library would make.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeAlias

import numpy as np
from google.protobuf.descriptor_pb2 import DescriptorProto, FieldDescriptorProto

from mclass.errors import LogError
from mclass.messages.cdr import number_array
from mclass.messages.prepared import Prepared, Value
from mclass.messages.proto_files import messages_of

_F = FieldDescriptorProto
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5

_FORMATS: Mapping[int, str] = {
    _F.TYPE_DOUBLE: "<d",
    _F.TYPE_FLOAT: "<f",
    _F.TYPE_FIXED32: "<I",
    _F.TYPE_FIXED64: "<Q",
    _F.TYPE_SFIXED32: "<i",
    _F.TYPE_SFIXED64: "<q",
}
_FIXED: Mapping[int, np.dtype[Any]] = {kind: np.dtype(code) for kind, code in _FORMATS.items()}
_PACK = {kind: struct.Struct(code) for kind, code in _FORMATS.items()}
_SIGNED: Mapping[int, int] = {_F.TYPE_INT32: 32, _F.TYPE_INT64: 64, _F.TYPE_ENUM: 32}
_UNSIGNED: Mapping[int, int] = {_F.TYPE_UINT32: 32, _F.TYPE_UINT64: 64, _F.TYPE_BOOL: 1}
_MASK = 2**64 - 1

_Payload: TypeAlias = Callable[[Any], bytes]


@dataclass(frozen=True)
class _Field:
    """One field, ready to write and read."""

    name: str
    kind: int
    type_name: str
    repeated: bool
    tag: bytes
    packed_tag: bytes
    payload: _Payload
    left_out: bytes


class ProtobufCodec:
    """Encoder and decoder of one message type."""

    def __init__(self, name: str) -> None:
        """Prepare for the message with the full name ``name``; see `proto_files.files_of`."""
        self.name = name
        self._fields: dict[str, dict[int, _Field]] = {}
        self._declared = messages_of(name)
        self._prepare(name)

    def encode(self, value: Value) -> bytes:
        """Bytes of a message.

        Args:
            value: Field name to value: numbers, strings, bytes, nested mappings, `Prepared`
                ones or sequences in the order of their fields, sequences of these, arrays.

        Raises:
            LogError: If a value does not fit its field.
        """
        try:
            return self._encode(self.name, value)
        except (struct.error, TypeError, ValueError, OverflowError, AttributeError) as error:
            raise LogError(f"{self.name} cannot hold this message: {error}") from error

    def decode(self, data: bytes | bytearray | memoryview) -> dict[str, Any]:
        """Message from bytes; absent fields hold what proto3 says, unknown ones are left out.

        Raises:
            LogError: If the bytes are not such a message.
        """
        try:
            return self._decode(self.name, memoryview(data))
        except (struct.error, IndexError, ValueError) as error:
            raise LogError(f"not a {self.name}: {error}") from error

    def _prepare(self, name: str) -> None:
        """Fields of a message and of those in it; types never contain themselves."""
        if name in self._fields:
            return
        self._fields[name] = {}
        for field in self._declared[name].field:
            type_name = field.type_name.lstrip(".")
            if field.type == _F.TYPE_MESSAGE:
                self._prepare(type_name)
            payload, wire_type = self._payload(field.type, type_name)
            self._fields[name][field.number] = _Field(
                field.name,
                field.type,
                type_name,
                field.label == _F.LABEL_REPEATED,
                _varint(field.number << 3 | wire_type),
                _varint(field.number << 3 | _BYTES),
                payload,
                b""
                if field.type == _F.TYPE_MESSAGE or field.proto3_optional
                else payload(_DEFAULTS.get(field.type, 0)),
            )

    def _payload(self, kind: int, type_name: str) -> tuple[_Payload, int]:
        """What turns one value into its bytes behind the tag, and their wire type."""
        if kind in _PACK:
            return _PACK[kind].pack, _FIXED64 if _PACK[kind].size == 8 else _FIXED32
        if kind == _F.TYPE_MESSAGE:
            return lambda value: _with_length(self._encode(type_name, value)), _BYTES
        if kind == _F.TYPE_STRING:
            # Logs can hold halves of surrogate pairs, which UTF-8 cannot express.
            return lambda value: _with_length(value.encode("utf-8", "replace")), _BYTES
        if kind == _F.TYPE_BYTES:
            return lambda value: _with_length(bytes(value)), _BYTES
        bits = _SIGNED.get(kind) or _UNSIGNED[kind]
        low, high = (-(2 ** (bits - 1)), 2 ** (bits - 1)) if kind in _SIGNED else (0, 2**bits)

        def integer(value: Any) -> bytes:
            number = value.__index__()
            if not low <= number < high:
                raise ValueError(f"{number} is outside [{low}, {high})")
            return _varint(number & _MASK)

        return integer, _VARINT

    def _encode(self, name: str, value: Any) -> bytes:
        if isinstance(value, Prepared):
            return value.encoded(name) or value.keep(name, self._encode(name, value.value))
        fields = self._fields[name]
        if not isinstance(value, Mapping):
            if len(value) != len(fields):
                raise ValueError(f"{name} takes {len(fields)} values, not {len(value)}")
            value = dict(zip((field.name for field in fields.values()), value, strict=True))
        parts: list[Any] = []
        written = 0
        for field in fields.values():
            if field.name not in value:
                continue
            written += 1
            content = value[field.name]
            if field.repeated:
                parts += _repeated(field, content)
            else:
                payload = field.payload(content)
                if payload != field.left_out:
                    parts += (field.tag, payload)
        if written != len(value):
            known = {field.name for field in fields.values()}
            raise ValueError(f"{name} has no field {sorted(set(value) - known)}")
        return b"".join(parts)

    def _decode(self, name: str, data: memoryview) -> dict[str, Any]:
        fields = self._fields[name]
        message: dict[str, Any] = {}
        chunks: dict[str, list[Any]] = {}
        for number, wire_type, content in _wire_fields(data):
            field = fields.get(number)
            if field is None:
                continue
            if wire_type == _BYTES and field.repeated and field.kind in _FIXED:
                chunks.setdefault(field.name, []).append(np.frombuffer(content, _FIXED[field.kind]))
            elif wire_type == _BYTES and field.repeated and _is_varint(field.kind):
                packed = [_integer(field.kind, item) for item in _varints(content)]
                message.setdefault(field.name, []).extend(packed)
            else:
                single = self._single(field, wire_type, content)
                if field.repeated and field.kind in _FIXED:
                    chunks.setdefault(field.name, []).append(np.array([single], _FIXED[field.kind]))
                elif field.repeated:
                    message.setdefault(field.name, []).append(single)
                else:
                    message[field.name] = single
        for field_name, arrays in chunks.items():
            message[field_name] = arrays[0] if len(arrays) == 1 else np.concatenate(arrays)
        for field in fields.values():
            if field.name not in message:
                message[field.name] = self._absent(field)
        return message

    def _absent(self, field: _Field) -> Any:
        """What a field holds that the message does not carry."""
        if field.repeated:
            return np.zeros(0, _FIXED[field.kind]) if field.kind in _FIXED else []
        if field.kind == _F.TYPE_MESSAGE:
            return self._decode(field.type_name, memoryview(b""))
        return _DEFAULTS.get(field.kind, 0)

    def _single(self, field: _Field, wire_type: int, content: Any) -> Any:
        """One value of a field from the wire."""
        expected = field.tag[0] & 7
        if wire_type != expected:
            raise ValueError(f"field {field.name} has wire type {wire_type}, not {expected}")
        if field.kind == _F.TYPE_MESSAGE:
            return self._decode(field.type_name, content)
        if field.kind == _F.TYPE_STRING:
            return bytes(content).decode("utf-8", "replace")
        if field.kind == _F.TYPE_BYTES:
            return bytes(content)
        if field.kind in _PACK:
            return _PACK[field.kind].unpack(content)[0]
        return _integer(field.kind, content)


_DEFAULTS: Mapping[int, Any] = {
    _F.TYPE_STRING: "",
    _F.TYPE_BYTES: b"",
    _F.TYPE_BOOL: False,
    _F.TYPE_DOUBLE: 0.0,
    _F.TYPE_FLOAT: 0.0,
}


def _repeated(field: _Field, content: Any) -> list[Any]:
    """Bytes of a repeated field; numbers are packed."""
    if field.kind in _FIXED:
        numbers = number_array(content, _FIXED[field.kind])
        if not numbers.size:
            return []
        return [field.packed_tag, _varint(numbers.nbytes), numbers.data.cast("B")]
    if field.kind in (_F.TYPE_MESSAGE, _F.TYPE_STRING, _F.TYPE_BYTES):
        return [part for item in content for part in (field.tag, field.payload(item))]
    packed = b"".join(map(field.payload, content))
    return [field.packed_tag, _with_length(packed)] if packed else []


@cache
def codec(name: str) -> ProtobufCodec:
    """Encoder and decoder of a message by its full name.

    Raises:
        MclassError: If the message is not known here.
    """
    return ProtobufCodec(name)


def message_descriptor(name: str) -> DescriptorProto:
    """Descriptor of a message by its full name."""
    return messages_of(name)[name]


def _varint(number: int) -> bytes:
    """A non-negative integer, seven bits a byte, least significant first."""
    if number < 0x80:
        return bytes((number,))
    out = bytearray()
    while number >= 0x80:
        out.append(number & 0x7F | 0x80)
        number >>= 7
    out.append(number)
    return bytes(out)


def _with_length(data: bytes) -> bytes:
    return b"".join((_varint(len(data)), data))


def _read_varint(data: memoryview, position: int) -> tuple[int, int]:
    """A varint and where it ends."""
    number = shift = 0
    while True:
        byte = data[position]
        position += 1
        number |= (byte & 0x7F) << shift
        if byte < 0x80:
            return number & _MASK, position
        shift += 7
        if shift > 63:
            raise ValueError("a varint is longer than ten bytes")


def _varints(data: memoryview) -> Iterator[int]:
    position = 0
    while position < len(data):
        number, position = _read_varint(data, position)
        yield number


def _wire_fields(data: memoryview) -> Iterator[tuple[int, int, Any]]:
    """Number, wire type and content of every field: an integer for a varint, else bytes."""
    position = 0
    while position < len(data):
        key, position = _read_varint(data, position)
        number, wire_type = key >> 3, key & 7
        if wire_type == _VARINT:
            content, position = _read_varint(data, position)
            yield number, wire_type, content
            continue
        if wire_type == _BYTES:
            size, position = _read_varint(data, position)
        elif wire_type in (_FIXED64, _FIXED32):
            size = 8 if wire_type == _FIXED64 else 4
        else:
            raise ValueError(f"wire type {wire_type} at byte {position}")
        if size > len(data) - position:
            raise ValueError(f"field {number} of {size} bytes does not fit")
        yield number, wire_type, data[position : position + size]
        position += size


def _is_varint(kind: int) -> bool:
    return kind in _SIGNED or kind in _UNSIGNED


def _integer(kind: int, number: int) -> Any:
    """A varint as its field means it."""
    if kind == _F.TYPE_BOOL:
        return bool(number)
    if kind in _SIGNED:
        return number - 2**64 if number >= 2**63 else number
    return number
