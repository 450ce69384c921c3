"""Protobuf messages, read from the wire format: all messages of a batch at once.

A span of bytes that holds a message is cut into records (field number, place, value), the
next record of all spans together; what is wanted is then picked by field number, and records
that hold messages are the spans of the next level.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from google.protobuf.descriptor_pb2 import FieldDescriptorProto

from mclass.logs.decode.base import ChannelDecoder, Column, demand
from mclass.logs.decode.protobuf_schema import (
    FIXED_TYPES,
    NANOS,
    SECONDS,
    STAMP,
    Branch,
    Leaf,
    Node,
    read_schema,
)
from mclass.logs.decode.ragged import (
    ByteArray,
    offsets_from,
    read_bytes,
    read_rows,
    read_texts,
    read_words,
    spread,
)
from mclass.logs.decode.skeleton import Alike, Place, find_alike
from mclass.logs.decode.wireformat import (
    BLOB,
    NO_RECORDS,
    VARINT,
    Cut,
    Records,
    Spans,
    cut_records,
    unpack_varints,
)
from mclass.records import IntArray

if TYPE_CHECKING:
    from mclass.logs.channels import ChannelInfo, MessageBatch

BAD_STAMP = "a stamp is out of range"
BAD_PACKING = "packed numbers do not fill their field"

_Type = FieldDescriptorProto
# Beyond this many seconds, nanoseconds do not fit into 64 bits.
_MAX_SECONDS = 9_223_372_035


class ProtobufDecoder(ChannelDecoder):
    """Decoder of ``protobuf`` channels."""

    def __init__(self, channel: ChannelInfo) -> None:
        self._root, self._paths = read_schema(channel.schema_name, channel.schema_data)
        self._select = lru_cache(maxsize=16)(self._root.select)

    @property
    def paths(self) -> Mapping[str, str]:
        """Kind of every leaf by its path."""
        return self._paths

    def _decode(
        self, batch: MessageBatch, rows: IntArray, wanted: tuple[str, ...]
    ) -> dict[str, Column]:
        buffer = np.frombuffer(batch.buffer, dtype=np.uint8)
        begin = batch.offsets[rows]
        messages = np.arange(len(rows), dtype=np.int64)
        spans = Spans(begin, begin + batch.lengths[rows], messages)
        walk = _Walk(buffer)
        walk.read_node(self._select(frozenset(wanted)), _Rows(spans, messages, messages, ()))
        return walk.columns


@dataclass(frozen=True)
class _Rows:
    """The messages of one level, each in one span, in several to be merged, or in none.

    Attributes:
        spans: Where they lie.
        row: The row that each span belongs to, (s,), increasing.
        message: The message, of the batch, that each row belongs to, (m,).
        levels: Offsets of the sequences around, outermost first.
    """

    spans: Spans
    row: IntArray
    message: IntArray
    levels: tuple[IntArray, ...]

    def take(self, index: IntArray) -> _Rows:
        """Rows of their own for some of the spans."""
        spans = self.spans.take(index)
        return _Rows(spans, np.arange(len(index)), spans.message, ())

    def fill(self, found: Records, values: npt.NDArray[Any], default: Any) -> Column:
        """Column of a single field from its records' values; the last in a row holds."""
        filled = np.full(len(self.message), default, dtype=values.dtype)
        filled[self.row[found.span]] = values
        return Column(filled, self.levels)

    def list(self, found: Records, values: npt.NDArray[Any], counts: IntArray | None) -> Column:
        """Column of a repeated field whose records hold ``counts`` values, or one each."""
        per_row = np.bincount(self.row[found.span], counts, minlength=len(self.message))
        return Column(values, (*self.levels, offsets_from(per_row.astype(np.int64))))

    def inner(self, found: Records, *, repeated: bool) -> _Rows:
        """The messages in these records."""
        row = self.row[found.span]
        spans = Spans(found.at, found.at + found.value, self.message[row])
        if not repeated:
            return _Rows(spans, row, self.message, self.levels)
        offsets = offsets_from(np.bincount(row, minlength=len(self.message)))
        return _Rows(spans, np.arange(len(row)), spans.message, (*self.levels, offsets))


@dataclass
class _Walk:
    """One pass over the payloads of a batch; ``columns`` is filled on the way."""

    buffer: ByteArray
    columns: dict[str, Column] = field(default_factory=dict)

    def read_node(self, node: Node, rows: _Rows) -> None:
        """Read what is wanted of all messages of one level."""
        if node.has_lists or not (np.diff(rows.row) > 0).all():
            self.read_records(node, rows)
            return
        alike, rest = find_alike(self.buffer, rows.spans, node)
        if not alike:
            self.read_records(node, rows)
            return
        found = [(rows.row[group.index], group) for group in alike]
        for leaf in node.leaves:
            self.columns[leaf.path] = self.single(leaf, found, rows)
        if len(rest):
            walk = _Walk(self.buffer)
            walk.read_records(node, rows.take(rest))
            for path, column in walk.columns.items():
                self.columns[path].values[rows.row[rest]] = column.values

    def read_records(self, node: Node, rows: _Rows) -> None:
        """Read messages of any skeletons, one record of all after another."""
        cut = cut_records(self.buffer, rows.spans, node.fields.keys())
        for number, item in node.fields.items():
            # As in protobuf itself: what has another wire type than the schema's is unknown.
            if isinstance(item, Branch):
                inner = rows.inner(cut.of(number, BLOB), repeated=item.repeated)
                self.read_node(item.node, inner)
            elif item.is_stamp:
                inner = rows.inner(cut.of(number, BLOB), repeated=item.repeated)
                walk = _Walk(self.buffer)
                walk.read_node(STAMP, inner)
                seconds, nanos = (walk.columns[part] for part in (SECONDS, NANOS))
                self.columns[item.path] = _stamps(seconds, nanos, inner)
            elif item.repeated and item.wire != BLOB:
                self.columns[item.path] = self.number_lists(item, cut, number, rows)
            else:
                found = cut.of(number, item.wire)
                values = self.values(item, found)
                self.columns[item.path] = (
                    rows.list(found, values, None)
                    if item.repeated
                    else rows.fill(found, values, item.default)
                )

    def single(self, leaf: Leaf, found: Sequence[tuple[IntArray, Alike]], rows: _Rows) -> Column:
        """Column of a leaf in rows that lie alike."""
        if leaf.is_stamp:
            seconds, nanos = (
                self.single(replace(part, path=f"{leaf.path}.{part.path}"), found, rows)
                for part in STAMP.leaves
            )
            return _stamps(seconds, nanos, rows)
        parts = [(row, group, group.places.get(leaf.path)) for row, group in found]
        there = [(row, group, place) for row, group, place in parts if place is not None]
        if leaf.wire == BLOB and there:
            return Column(self.alike_texts(leaf, there, len(rows.message)), rows.levels)
        values = [_alike_numbers(leaf, group, place) for _, group, place in there]
        if values and len(values[0]) == len(rows.message):
            return Column(values[0], rows.levels)
        kind = values[0].dtype if values else self.values(leaf, NO_RECORDS).dtype
        filled = np.full(len(rows.message), leaf.default, kind)
        for (row, _, _), part in zip(there, values, strict=True):
            filled[row] = part
        return Column(filled, rows.levels)

    def alike_texts(
        self, leaf: Leaf, there: Sequence[tuple[IntArray, Alike, Place]], count: int
    ) -> npt.NDArray[np.object_]:
        """Strings or bytes in rows that lie alike, the default in all others, (count,)."""
        _, group, place = there[0]
        at = np.full(count, group.at[0] + place.at)
        sizes = np.full(count, place.size)
        for row, group, place in there:
            at[row], sizes[row] = group.at + place.at, place.size
        texts = self.texts(leaf, Records(at, at, sizes))
        if sum(len(row) for row, _, _ in there) < count:
            missing = np.ones(count, dtype=np.bool_)
            for row, _, _ in there:
                missing[row] = False
            texts[missing] = leaf.default
        return texts

    def values(self, leaf: Leaf, found: Records) -> npt.NDArray[Any]:
        """The value in each record."""
        return self.numbers(leaf, found) if leaf.wire != BLOB else self.texts(leaf, found)

    def texts(self, leaf: Leaf, found: Records) -> npt.NDArray[np.object_]:
        """The string or bytes in each record."""
        if leaf.kind == "string":
            return read_texts(self.buffer, found.at, found.value)
        values = np.empty(len(found.at), dtype=object)
        values[:] = read_bytes(self.buffer, found.at, found.value)
        return values

    def numbers(self, leaf: Leaf, found: Records) -> npt.NDArray[Any]:
        """The number in each record."""
        dtype = FIXED_TYPES.get(leaf.type)
        if dtype is None:
            return _from_varints(found.value, leaf.type)
        words = read_words(self.buffer, found.at, dtype)
        return words if leaf.repeated else _from_words(words)

    def number_lists(self, leaf: Leaf, cut: Cut, number: int, rows: _Rows) -> Column:
        """Numbers of a repeated field, which are packed or have a record each."""
        single, packed = cut.of(number, leaf.wire), cut.of(number, BLOB)
        values = self.numbers(leaf, single)
        if not len(packed.at):
            return rows.list(single, values, None)
        blobs = rows.inner(packed, repeated=False).spans
        dtype = FIXED_TYPES.get(leaf.type)
        if dtype is None:
            bits, counts = unpack_varints(self.buffer, blobs)
            unpacked = _from_varints(bits, leaf.type)
        else:
            demand(packed.value % dtype.itemsize == 0, blobs.message, BAD_PACKING)
            counts = packed.value // dtype.itemsize
            unpacked = read_rows(self.buffer, packed.at, counts, dtype)
        if not len(single.at):
            return rows.list(packed, unpacked, counts)
        # Both in one batch: put the records back in the order in which they lie.
        span = np.concatenate([single.span, packed.span])
        at = np.concatenate([single.at, packed.at])
        sizes = np.concatenate([np.ones_like(single.at), counts])
        order = np.lexsort((at, span))
        starts = np.empty_like(at)
        starts[order] = offsets_from(sizes[order])[:-1]
        joined = np.concatenate([values, unpacked])
        joined[spread(starts, sizes)] = np.concatenate([values, unpacked])
        return rows.list(Records(span, at, sizes), joined, sizes)


def _alike_numbers(leaf: Leaf, group: Alike, place: Place) -> npt.NDArray[Any]:
    """The number in each message, (n,)."""
    if place.wire == VARINT:
        return _from_varints(group.varints(place), leaf.type)
    return _from_words(group.words(place, FIXED_TYPES[leaf.type]))


def _from_words(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Numbers of fixed size as columns have them, (n,)."""
    wide = np.float64 if values.dtype.kind == "f" else np.int64
    # A signalling NaN is worth no warning; it becomes a plain one.
    with np.errstate(invalid="ignore"):
        return values.astype(np.uint64 if values.dtype == np.uint64 else wide)


def _stamps(seconds: Column, nanos: Column, rows: _Rows) -> Column:
    """Nanoseconds of Timestamp or Duration messages."""
    in_range = (seconds.values >= -_MAX_SECONDS) & (seconds.values <= _MAX_SECONDS)
    demand(in_range, rows.message, BAD_STAMP)
    return Column(seconds.values * 1_000_000_000 + nanos.values, rows.levels)


def _from_varints(bits: IntArray, field_type: int) -> npt.NDArray[Any]:
    """What 64 bits mean in a field of this type, (n,)."""
    values: npt.NDArray[Any] = bits
    if field_type == _Type.TYPE_BOOL:
        values = bits != 0
    elif field_type == _Type.TYPE_UINT64:
        values = bits.view(np.uint64)
    elif field_type == _Type.TYPE_UINT32:
        values = bits & 0xFFFF_FFFF
    elif field_type in (_Type.TYPE_INT32, _Type.TYPE_ENUM):
        values = bits.astype(np.int32).astype(np.int64)
    elif field_type in (_Type.TYPE_SINT32, _Type.TYPE_SINT64):
        zigzag = bits & 0xFFFF_FFFF if field_type == _Type.TYPE_SINT32 else bits
        halves = (zigzag.view(np.uint64) >> np.uint64(1)).view(np.int64)
        values = halves ^ -(zigzag & 1)
    return values
