"""The protobuf wire format, many spans of bytes at once: varints, and records of messages."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from mclass.logs.decode.base import NARROW, CutError, DamagedError, demand
from mclass.logs.decode.ragged import ByteArray, offsets_from, read_eights, read_rows
from mclass.records import IntArray

CUT_SHORT = "a field reaches beyond its message"
BAD_VARINT = "a number does not end"
BAD_TAG = "no protobuf field has this type or number"

VARINT, WORD64, BLOB, WORD32 = 0, 1, 2, 5
"""Wire types that are in use; groups (3 and 4) are not supported."""

# Bytes of a payload behind its varint, if it has one, by wire type.
_WIRES = {VARINT: 0, WORD64: 8, BLOB: 0, WORD32: 4}
_NONE = np.empty(0, dtype=np.int64)
_MAX_NUMBER = (1 << 29) - 1
_MAX_VARINT = 10
_ONE = np.uint64(1)
_GO_ON = np.uint64(0x8080_8080_8080_8080)
# Pairs of bytes, of pairs, of fours: what stays, what moves down to it, by how many bits.
_JOINS = tuple(
    (np.uint64(low), np.uint64(low << width), np.uint64(shift))
    for low, width, shift in (
        (0x007F_007F_007F_007F, 8, 1),
        (0x0000_3FFF_0000_3FFF, 16, 2),
        (0x0000_0000_0FFF_FFFF, 32, 4),
    )
)


@dataclass(frozen=True)
class Spans:
    """Stretches of bytes.

    Attributes:
        at: Where each starts, (s,).
        end: Where each ends, (s,).
        message: The message, of the batch, that each belongs to, (s,).
    """

    at: IntArray
    end: IntArray
    message: IntArray

    def take(self, index: npt.NDArray[Any]) -> Spans:
        """Some of the spans."""
        return Spans(self.at[index], self.end[index], self.message[index])


@dataclass(frozen=True)
class Records:
    """Fields of one number and wire type, by span and within a span as they lie there.

    Attributes:
        span: Index of the span that each lies in, (r,).
        at: Position of the payload in the buffer, (r,); behind the length for a ``BLOB``.
        value: A varint's value (its 64 bits, signed), a ``BLOB``'s length, else 0, (r,).
    """

    span: IntArray
    at: IntArray
    value: IntArray

    def take(self, index: npt.NDArray[Any]) -> Records:
        """Some of the records."""
        return Records(self.span[index], self.at[index], self.value[index])


NO_RECORDS = Records(_NONE, _NONE, _NONE)


@dataclass(frozen=True)
class Cut:
    """The records of spans; ``parts`` holds those of each field number and wire type."""

    parts: Mapping[tuple[int, int], Sequence[Records]]

    def of(self, number: int, wire: int) -> Records:
        """All records of a field that have this wire type."""
        parts = self.parts.get((number, wire), ())
        if len(parts) == 1:
            return parts[0]
        span, at, value = (
            np.concatenate([_NONE, *(getattr(part, name) for part in parts)])
            for name in ("span", "at", "value")
        )
        return Records(span, at, value).take(np.argsort(span, kind="stable"))


def read_varints(buffer: ByteArray, spans: Spans) -> tuple[IntArray, IntArray]:
    """The varint that each span, none of them empty, starts with.

    Returns:
        Their 64 bits as signed numbers, and their sizes [bytes], (n,) each.

    Raises:
        DamagedError: If one reaches beyond its span, or beyond ten bytes.
    """
    first = buffer[spans.at]
    values, sizes = first.astype(np.int64), np.ones(len(first), dtype=np.int64)
    more = np.flatnonzero(first >= 0x80)
    if not len(more):
        return values, sizes
    bits = values.view(np.uint64)
    at, end = spans.at[more], spans.end[more]
    words = read_eights(buffer, at)
    # The upper bit of the first byte that does not go on; 0 when all eight do.
    last = ~words & _GO_ON
    last &= ~last + _ONE
    bits[more] = join_sevens(words & (last - _ONE))
    size = np.frexp(last.astype(np.float64))[1] >> 3
    demand(at + size <= end, spans.message[more], BAD_VARINT)
    sizes[more] = size
    more = more[last == 0]
    for count in range(8, _MAX_VARINT):
        if not len(more):
            break
        position = spans.at[more] + count
        demand(position < spans.end[more], spans.message[more], BAD_VARINT)
        byte = buffer[position]
        bits[more] |= (byte & 0x7F).astype(np.uint64) << np.uint64(7 * count)
        sizes[more] = count + 1
        more = more[byte >= 0x80]
    if len(more):
        raise DamagedError([(BAD_VARINT, spans.message[more])])
    return values, sizes


def join_sevens(words: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint64]:
    """The lower seven bits of each of eight bytes as one number, the first byte lowest."""
    for low, high, shift in _JOINS:
        words = (words & low) | ((words & high) >> shift)
    return words


def cut_records(buffer: ByteArray, spans: Spans, wanted: Set[int]) -> Cut:
    """Cut spans into records and keep those of the wanted fields.

    Raises:
        DamagedError: If a span is not made of records.
    """
    parts: dict[tuple[int, int], list[Records]] = defaultdict(list)
    found: list[tuple[str, IntArray]] = []
    index = np.flatnonzero(spans.at < spans.end)
    rest = spans.take(index)
    while len(index) >= NARROW:
        try:
            stops = _cut_next(buffer, rest, index, wanted, parts)
        except DamagedError as damage:
            found += damage.found
            going = ~np.isin(rest.message, damage.messages)
        else:
            rest = Spans(stops, rest.end, rest.message)
            going = stops < rest.end
        if not going.all():
            rest, index = rest.take(going), index[going]
    rows: dict[tuple[int, int], list[tuple[int, int, int]]] = defaultdict(list)
    for span, at, end in zip(index.tolist(), rest.at.tolist(), rest.end.tolist(), strict=True):
        try:
            for number, wire, start, value, _ in cut_span(buffer.data, at, end):
                if number in wanted:
                    rows[number, wire].append((span, start, value))
        except CutError as error:  # noqa: PERF203
            found.append((str(error), spans.message[span : span + 1]))
    if found:
        raise DamagedError(found)
    for key, values in rows.items():
        parts[key].append(Records(*np.array(values, dtype=np.int64).T))
    return Cut(parts)


def _cut_next(
    buffer: ByteArray,
    spans: Spans,
    index: IntArray,
    wanted: Set[int],
    parts: dict[tuple[int, int], list[Records]],
) -> IntArray:
    """Add the next record of all spans, which bear these indices; where each ends, (s,)."""
    first = buffer[spans.at]
    if first[0] < 0x80 and (first == first[0]).all():
        # The spans mostly come from one writer, and it writes fields in one order.
        head = int(first[0])
        at, values, stops = _read_payloads(buffer, head, spans.at + 1, spans)
        if head >> 3 in wanted:
            parts[head >> 3, head & 7].append(Records(index, at, values))
        return stops
    heads, sizes = read_varints(buffer, spans)
    stops = spans.at + sizes
    for wire in np.unique(heads & 7).tolist():
        alike = np.flatnonzero(heads & 7 == wire)
        numbers = heads[alike] >> 3
        demand((numbers > 0) & (numbers <= _MAX_NUMBER), spans.message[alike], BAD_TAG)
        at, values, stops[alike] = _read_payloads(buffer, 8 | wire, stops[alike], spans.take(alike))
        for number in wanted & set(numbers.tolist()):
            chosen = np.flatnonzero(numbers == number)
            records = Records(index[alike[chosen]], at[chosen], values[chosen])
            parts[number, wire].append(records)
    return stops


def _read_payloads(
    buffer: ByteArray, head: int, at: IntArray, spans: Spans
) -> tuple[IntArray, IntArray, IntArray]:
    """``at`` and ``value`` of records with this head, which ends at ``at``, and their ends."""
    wire = head & 7
    if head <= 7 or wire not in _WIRES:
        raise DamagedError([(BAD_TAG, spans.message)])
    if wire in (WORD64, WORD32):
        stops = at + _WIRES[wire]
        demand(stops <= spans.end, spans.message, CUT_SHORT)
        return at, np.zeros_like(at), stops
    demand(at < spans.end, spans.message, CUT_SHORT)
    values, sizes = read_varints(buffer, Spans(at, spans.end, spans.message))
    if wire == VARINT:
        return at, values, at + sizes
    at = at + sizes
    demand((values >= 0) & (values <= spans.end - at), spans.message, CUT_SHORT)
    return at, values, at + values


def cut_span(buffer: memoryview, at: int, end: int) -> Iterator[tuple[int, int, int, int, int]]:
    """Number, wire type, payload's place, value and end of the records of one span.

    Raises:
        CutError: If the span is not made of records.
    """
    while at < end:
        head, at = _varint(buffer, at, end)
        wire, number = head & 7, head >> 3
        value = 0
        start = at
        if not 0 < number <= _MAX_NUMBER or wire not in _WIRES:
            raise CutError(BAD_TAG)
        if wire == VARINT:
            value, at = _varint(buffer, at, end)
        elif wire == BLOB:
            value, start = _varint(buffer, at, end)
            at = start + value
        else:
            at += _WIRES[wire]
        if at > end:
            raise CutError(CUT_SHORT)
        yield number, wire, start, value - (value >> 63 << 64), at


def _varint(buffer: memoryview, at: int, end: int) -> tuple[int, int]:
    """A varint's 64 bits, unsigned, and where it ends."""
    value = 0
    for shift in range(0, 7 * _MAX_VARINT, 7):
        if at >= end:
            raise CutError(BAD_VARINT if shift else CUT_SHORT)
        byte = buffer[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value & 0xFFFF_FFFF_FFFF_FFFF, at
    raise CutError(BAD_VARINT)


def unpack_varints(buffer: ByteArray, blobs: Spans) -> tuple[IntArray, IntArray]:
    """The varints that blobs are filled with.

    Returns:
        The 64 bits of all, as signed numbers, and how many each blob holds, (b,).

    Raises:
        DamagedError: If a blob does not end with its last varint, or one is too long.
    """
    lengths = blobs.end - blobs.at
    joined = read_rows(buffer, blobs.at, lengths, np.dtype(np.uint8))
    offsets = offsets_from(lengths)
    is_last = joined < 0x80
    filled = lengths > 0
    demand(is_last[offsets[1:][filled] - 1], blobs.message[filled], BAD_VARINT)
    counts = np.diff(offsets_from(is_last.astype(np.int64))[offsets])
    stops = np.flatnonzero(is_last) + 1
    starts = np.roll(stops, 1)
    starts[:1] = 0
    values, _ = read_varints(joined, Spans(starts, stops, np.repeat(blobs.message, counts)))
    return values, counts
