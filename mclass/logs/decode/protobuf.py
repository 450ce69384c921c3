"""Protobuf messages, read from the wire format: all messages of a batch at once.

A span of bytes that holds a message is cut into records (field number, place, value), the
next record of all spans together; what is wanted is then picked by field number, and records
that hold messages are the spans of the next level.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from google.protobuf.descriptor_pb2 import FieldDescriptorProto

from mclass.logs.decode.base import ChannelDecoder, Column, demand
from mclass.logs.decode.protobuf_schema import FIXED_TYPES, Branch, Leaf, Node, read_schema
from mclass.logs.decode.ragged import (
    ByteArray,
    offsets_from,
    read_bytes,
    read_rows,
    read_texts,
    read_words,
    spread,
)
from mclass.logs.decode.wireformat import (
    BLOB,
    VARINT,
    WORD32,
    WORD64,
    Records,
    cut_records,
    unpack_varints,
)
from mclass.records import IntArray

if TYPE_CHECKING:
    from mclass.logs.reader import ChannelInfo, MessageBatch

BAD_STAMP = "a stamp is out of range"
BAD_PACKING = "packed numbers do not fill their field"

_Type = FieldDescriptorProto
_SECONDS, _NANOS = 1, 2
_STAMP = Node(
    {
        _SECONDS: Leaf("seconds", "int", _Type.TYPE_INT64, repeated=False, default=0),
        _NANOS: Leaf("nanos", "int", _Type.TYPE_INT32, repeated=False, default=0),
    }
)
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
        spans = _Spans(begin, begin + batch.lengths[rows], messages)
        walk = _Walk(buffer)
        walk.read_node(self._select(frozenset(wanted)), spans, messages, ())
        return walk.columns


@dataclass(frozen=True)
class _Spans:
    """Where messages lie: one span each, or several to be merged, or none if left out.

    Attributes:
        at: Where each span starts, (s,).
        end: Where each span ends, (s,).
        item: Row, at this level, that each span belongs to, (s,).
    """

    at: IntArray
    end: IntArray
    item: IntArray


@dataclass
class _Walk:
    """One pass over the payloads of a batch; ``columns`` is filled on the way."""

    buffer: ByteArray
    columns: dict[str, Column] = field(default_factory=dict)

    def read_node(
        self, node: Node, spans: _Spans, messages: IntArray, levels: tuple[IntArray, ...]
    ) -> None:
        """Read what is wanted of all messages of one level.

        Args:
            node: Wanted fields.
            spans: Where the messages lie.
            messages: The batch's message that each row of this level belongs to, (m,).
            levels: Offsets of the sequences around, outermost first.
        """
        owners = messages[spans.item]
        records = cut_records(self.buffer, spans.at, spans.end, owners, node.numbers)
        for number, item in node.fields.items():
            found = records.of_field(number)
            fits = np.isin(found.wire, _wire_types(item))
            if not fits.all():
                # As in protobuf itself: what has another type than the schema's is unknown.
                found = found.take(fits)
            rows = spans.item[found.span]
            if isinstance(item, Leaf) and item.type != _Type.TYPE_MESSAGE:
                self.read_leaf(item, found, rows, messages, levels)
                continue
            inner = _Spans(found.at, found.at + found.value, rows)
            inner_messages, inner_levels = messages, levels
            if item.repeated:
                inner = replace(inner, item=np.arange(len(rows), dtype=np.int64))
                inner_messages = messages[rows]
                inner_levels = (*levels, offsets_from(np.bincount(rows, minlength=len(messages))))
            if isinstance(item, Leaf):
                values = self.stamps(inner, inner_messages)
                self.columns[item.path] = Column(values, inner_levels)
            else:
                self.read_node(item.node, inner, inner_messages, inner_levels)

    def read_leaf(
        self,
        leaf: Leaf,
        found: Records,
        rows: IntArray,
        messages: IntArray,
        levels: tuple[IntArray, ...],
    ) -> None:
        """Read a leaf from its records, each of which belongs to a row of this level."""
        counts = np.ones(len(rows), dtype=np.int64)
        values: npt.NDArray[Any]
        if leaf.kind == "string":
            values = read_texts(self.buffer, found.at, found.value)
        elif leaf.kind == "bytes":
            values = np.empty(len(rows), dtype=object)
            values[:] = read_bytes(self.buffer, found.at, found.value)
        elif leaf.repeated:
            values, counts = self.packed_numbers(leaf, found, messages[rows])
        else:
            values = self.numbers(leaf, found)
        if leaf.repeated:
            per_row = np.bincount(rows, counts, minlength=len(messages)).astype(np.int64)
            self.columns[leaf.path] = Column(values, (*levels, offsets_from(per_row)))
        else:
            filled = np.full(len(messages), leaf.default, dtype=values.dtype)
            filled[rows] = values
            self.columns[leaf.path] = Column(filled, levels)

    def numbers(self, leaf: Leaf, found: Records) -> npt.NDArray[Any]:
        """The number in each record."""
        dtype = FIXED_TYPES.get(leaf.type)
        if dtype is None:
            return _from_varints(found.value, leaf.type)
        values = read_words(self.buffer, found.at, dtype)
        if leaf.repeated or dtype == np.uint64:
            return values
        return values.astype(np.float64 if dtype.kind == "f" else np.int64)

    def packed_numbers(
        self, leaf: Leaf, found: Records, messages: IntArray
    ) -> tuple[npt.NDArray[Any], IntArray]:
        """The numbers of records that hold one or are packed, and how many each holds."""
        counts = np.ones(len(found.at), dtype=np.int64)
        single = self.numbers(leaf, found.take(found.wire != BLOB))
        is_packed = found.wire == BLOB
        if not is_packed.any():
            return single, counts
        packed = found.take(is_packed)
        dtype = FIXED_TYPES.get(leaf.type)
        if dtype is None:
            bits, counts[is_packed] = unpack_varints(
                self.buffer, packed.at, packed.value, messages[is_packed]
            )
            values = _from_varints(bits, leaf.type)
        else:
            demand(packed.value % dtype.itemsize == 0, messages[is_packed], BAD_PACKING)
            counts[is_packed] = packed.value // dtype.itemsize
            values = read_rows(self.buffer, packed.at, counts[is_packed], dtype)
        if len(single):
            first = offsets_from(counts)[:-1]
            joined = np.empty(counts.sum(), dtype=values.dtype)
            joined[first[~is_packed]] = single
            joined[spread(first[is_packed], counts[is_packed])] = values
            values = joined
        return values, counts

    def stamps(self, spans: _Spans, messages: IntArray) -> IntArray:
        """Nanoseconds of Timestamp or Duration messages."""
        walk = _Walk(self.buffer)
        walk.read_node(_STAMP, spans, messages, ())
        seconds = walk.columns["seconds"].values
        demand(np.abs(seconds) <= _MAX_SECONDS, messages, BAD_STAMP)
        values: IntArray = seconds * 1_000_000_000 + walk.columns["nanos"].values
        return values


def _wire_types(item: Leaf | Branch) -> tuple[int, ...]:
    """Wire types that a field of this type can have."""
    if isinstance(item, Branch) or item.kind in ("string", "bytes"):
        return (BLOB,)
    if item.type == _Type.TYPE_MESSAGE:
        return (BLOB,)
    dtype = FIXED_TYPES.get(item.type)
    wire = VARINT if dtype is None else WORD64 if dtype.itemsize == 8 else WORD32
    return (wire, BLOB) if item.repeated else (wire,)


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
