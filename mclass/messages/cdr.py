"""CDR, ROS 2's serialisation, little endian: messages as mappings to bytes and back.

Every primitive is aligned to its own size, counted from behind the four bytes of the header.
Arrays of numbers are written and read in bulk. A message made of one kind of number alone
(a pose, a covariance, a colour) may be given as an array of its numbers in order, and a
sequence of such messages as an array of rows.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from mclass.errors import LogError
from mclass.messages.definitions import PRIMITIVE_SIZES, Definition, Field
from mclass.messages.prepared import Prepared, Value

_HEADER = b"\x00\x01\x00\x00"
_MAX_ALIGNMENT = 8
_PADDING = tuple(bytes(count) for count in range(_MAX_ALIGNMENT))
_FORMATS: Mapping[str, str] = {
    "bool": "?",
    "int8": "b",
    "uint8": "B",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
}
_PRIMITIVES = {name: struct.Struct(f"<{letter}") for name, letter in _FORMATS.items()}
_DTYPES = {name: np.dtype(f"<{letter}") for name, letter in _FORMATS.items()}
_COUNT = struct.Struct("<I")

_Write: TypeAlias = Callable[[bytearray, Any], None]


class CdrCodec:
    """Encoder and decoder of one message type."""

    def __init__(self, definitions: Mapping[str, Definition], name: str) -> None:
        """Prepare for the message ``name`` of ``definitions`` (key ``package/Type``)."""
        self.name = name
        self._definitions = definitions
        self._writers: dict[str, _Write] = {}

    @cached_property
    def _write(self) -> _Write:
        return self._message_writer(self.name)

    def encode(self, value: Value) -> bytes:
        """Bytes of a message, the encapsulation header included.

        Args:
            value: Field name to value: numbers, strings, nested mappings or `Prepared`
                ones, sequences of these, arrays. Fields left out are zero or empty.

        Raises:
            LogError: If a value does not fit its field.
        """
        out = bytearray()
        try:
            self._write(out, value)
        except (struct.error, TypeError, ValueError, OverflowError, AttributeError) as error:
            raise LogError(f"{self.name} cannot hold this message: {error}") from error
        return b"".join((_HEADER, out))

    def decode(self, data: bytes | bytearray | memoryview) -> dict[str, Any]:
        """Message from bytes; arrays of numbers are views into ``data``.

        Raises:
            LogError: If the bytes are not such a message in little-endian CDR.
        """
        view = memoryview(data)
        if len(view) < len(_HEADER) or bytes(view[:2]) != _HEADER[:2]:
            raise LogError(f"not a {self.name}: it does not begin with a little-endian CDR header")
        reader = _Reader(view[len(_HEADER) :], self.name)
        return self._read_message(reader, self.name)

    def _message_writer(self, name: str) -> _Write:
        """Writer of one message type; types never contain themselves."""
        if name in self._writers:
            return self._writers[name]
        fields = [
            (field.name, self._field_writer(field), self._default(field))
            for field in self._definitions[name].fields
        ]
        known = frozenset(field_name for field_name, _, _ in fields)
        numbers = _single_primitive(self._definitions, name)
        number_writer = None if numbers is None else _array_writer(*numbers)

        def write_fields(out: bytearray, value: Value) -> None:
            for field_name, write, default in fields:
                write(out, value.get(field_name, default))
            if not known.issuperset(value):
                raise ValueError(f"{name} has no field {sorted(set(value) - known)}")

        def write_message(out: bytearray, value: Any) -> None:
            if isinstance(value, Prepared):
                # What alignment adds depends on where the message begins, modulo 8.
                phase = len(out) % _MAX_ALIGNMENT
                data = value.encoded((name, phase))
                if data is None:
                    padded = bytearray(phase)
                    write_fields(padded, value.value)
                    data = value.keep((name, phase), bytes(padded[phase:]))
                out += data
            elif number_writer is not None and not isinstance(value, (dict, Mapping)):
                number_writer(out, value)
            else:
                write_fields(out, value)

        self._writers[name] = write_message
        return write_message

    def _field_writer(self, field: Field) -> _Write:
        """Writer of one field, be it a value, an array or a sequence."""
        if field.type in PRIMITIVE_SIZES:
            if field.array is None:
                return _primitive_writer(field.type)
            return _array_writer(field.type, field.array)
        if field.type in self._definitions:
            write = self._message_writer(field.type)
        elif field.type == "string":
            write = _write_string
        else:
            raise LogError(f"{self.name}: fields of type {field.type} cannot be written")
        if field.array is None:
            return write
        return self._sequence_writer(field, write)

    def _sequence_writer(self, field: Field, write: _Write) -> _Write:
        """Writer of several strings or messages."""
        expected = field.array
        numbers = None
        if field.type in self._definitions:
            numbers = _single_primitive(self._definitions, field.type)
        primitive, width = numbers or ("", 0)
        rows_writer = _array_writer(primitive, None) if primitive else None

        def write_sequence(out: bytearray, values: Any) -> None:
            if expected == -1:
                _align(out, 4)
                out += _COUNT.pack(len(values))
            elif len(values) != expected:
                raise ValueError(f"{field.name} takes {expected} elements, not {len(values)}")
            if rows_writer is not None and isinstance(values, np.ndarray):
                if values.shape[1:] != (width,):
                    raise ValueError(f"{field.name} takes rows of {width} numbers")
                rows_writer(out, values)
            else:
                for value in values:
                    write(out, value)

        return write_sequence

    def _default(self, field: Field) -> Any:
        """What a field holds when the message does not say."""
        if field.array == -1:
            return ()
        if field.array is not None:
            if field.type in PRIMITIVE_SIZES:
                return np.zeros(field.array, _DTYPES[field.type])
            return [self._default(Field(field.name, field.type, None))] * field.array
        if field.type == "string":
            return ""
        return {} if field.type in self._definitions else 0

    def _read_message(self, reader: _Reader, name: str) -> dict[str, Any]:
        """One message from where the reader stands."""
        return {
            field.name: self._read_field(reader, field) for field in self._definitions[name].fields
        }

    def _read_field(self, reader: _Reader, field: Field) -> Any:
        """One field from where the reader stands."""
        if field.type in PRIMITIVE_SIZES:
            if field.array is None:
                return reader.number(field.type)
            return reader.array(field.type, reader.count() if field.array == -1 else field.array)
        if field.array is None:
            return self._read_element(reader, field)
        count = reader.count() if field.array == -1 else field.array
        return [self._read_element(reader, field) for _ in range(count)]

    def _read_element(self, reader: _Reader, field: Field) -> Any:
        """One string or message."""
        if field.type in self._definitions:
            return self._read_message(reader, field.type)
        return reader.string()


def encode(definitions: Mapping[str, Definition], name: str, value: Value) -> bytes:
    """Encode one message; `CdrCodec` is faster for many of a type.

    Args:
        definitions: Of the message and all that it uses.
        name: Its key in ``definitions``.
        value: See `CdrCodec.encode`.
    """
    return CdrCodec(definitions, name).encode(value)


class _Reader:
    """A place in the body of a message."""

    def __init__(self, body: memoryview, name: str) -> None:
        self._body = body
        self._name = name
        self._position = 0

    def number(self, type_name: str) -> Any:
        """The next number; much quicker than an array of one."""
        number = _PRIMITIVES[type_name]
        start = self._position + -self._position % number.size
        self._position = start + number.size
        if self._position > len(self._body):
            raise self._early(self._position)
        return number.unpack_from(self._body, start)[0]

    def array(self, type_name: str, count: int) -> npt.NDArray[Any]:
        """The next ``count`` numbers."""
        dtype = _DTYPES[type_name]
        if count:
            self._position += -self._position % dtype.itemsize
        return np.frombuffer(self._take(count * dtype.itemsize), dtype)

    def count(self) -> int:
        """Length of the sequence that follows."""
        count: int = self.number("uint32")
        # Every element takes a byte at least, so a count beyond the rest is a lie.
        if count > len(self._body) - self._position:
            raise LogError(f"{self._name}: a sequence of {count} elements does not fit the message")
        return count

    def string(self) -> str:
        """The next string."""
        data = bytes(self._take(self.count()))
        return data.removesuffix(b"\0").decode("utf-8", "replace")

    def _take(self, size: int) -> memoryview:
        end = self._position + size
        if end > len(self._body):
            raise self._early(end)
        self._position, start = end, self._position
        return self._body[start:end]

    def _early(self, end: int) -> LogError:
        missing = end - len(self._body)
        return LogError(f"{self._name}: the message ends {missing} bytes early")


def _align(out: bytearray, size: int) -> None:
    """Pad to a multiple of ``size``."""
    out += _PADDING[-len(out) % size]


def _primitive_writer(type_name: str) -> _Write:
    pack = _PRIMITIVES[type_name].pack
    size = PRIMITIVE_SIZES[type_name]

    def write(out: bytearray, value: Any) -> None:
        out += _PADDING[-len(out) % size]
        out += pack(value)

    return write


def _write_string(out: bytearray, value: Any) -> None:
    # Logs can hold halves of surrogate pairs, which UTF-8 cannot express.
    data = value.encode("utf-8", "replace")
    out += _PADDING[-len(out) % 4]
    out += _COUNT.pack(len(data) + 1)
    out += data
    out += b"\0"


def _array_writer(type_name: str, expected: int | None) -> _Write:
    """Writer of numbers: ``expected`` many, -1 for a sequence, None for any number uncounted."""
    dtype = _DTYPES[type_name]
    few = struct.Struct(f"<{expected or 0}{_FORMATS[type_name]}") if (expected or 0) > 0 else None

    def write(out: bytearray, values: Any) -> None:
        if few is not None and isinstance(values, tuple):
            out += _PADDING[-len(out) % dtype.itemsize]
            out += few.pack(*values)
            return
        array = number_array(values, dtype)
        if expected == -1:
            _align(out, 4)
            out += _COUNT.pack(array.size)
        elif expected is not None and array.size != expected:
            raise ValueError(f"{expected} numbers are needed, not {array.size}")
        if array.size:
            _align(out, dtype.itemsize)
            out += array.data.cast("B")

    return write


def number_array(values: Any, dtype: np.dtype[Any]) -> npt.NDArray[Any]:
    """Numbers as a contiguous array of ``dtype``.

    Raises:
        ValueError: If an integer does not fit, rather than wrap it.
    """
    if isinstance(values, (bytes, bytearray, memoryview)):
        return np.frombuffer(values, dtype)
    if dtype.kind not in "iu":
        return np.ascontiguousarray(values, dtype)
    # Plain integers stay objects until checked: NumPy turns a mixture of great ones into floats.
    array = values if isinstance(values, np.ndarray) else np.asarray(values, object)
    if array.dtype != dtype and array.size:
        whole = array.dtype.kind in "iub" or (
            array.dtype.kind == "O" and all(isinstance(item, (int, np.integer)) for item in array)
        )
        if not whole:
            raise ValueError(f"{array.dtype} values in a field of {dtype}")
        limits, low, high = np.iinfo(dtype), array.min(), array.max()
        if low < limits.min or high > limits.max:
            raise ValueError(f"values from {low} to {high} in a field of {dtype}")
    return np.ascontiguousarray(array, dtype)


def _single_primitive(definitions: Mapping[str, Definition], name: str) -> tuple[str, int] | None:
    """The one primitive and the count of a message that is nothing but so many of it."""
    leaves = list(_leaves(definitions, name))
    types = {type_name for type_name, _ in leaves}
    if len(types) != 1 or not types <= PRIMITIVE_SIZES.keys():
        return None
    return types.pop(), sum(count for _, count in leaves)


def _leaves(definitions: Mapping[str, Definition], name: str) -> Iterator[tuple[str, int]]:
    """Type and count of every leaf; the type is empty for a sequence."""
    for field in definitions[name].fields:
        if field.array == -1:
            yield "", 0
        elif field.type in definitions:
            for type_name, count in _leaves(definitions, field.type):
                yield type_name, count * (field.array or 1)
        else:
            yield field.type, 1 if field.array is None else field.array
