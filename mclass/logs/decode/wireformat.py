"""The protobuf wire format, many spans of bytes at once: varints, and records of messages."""

from __future__ import annotations

from collections.abc import Iterator, Set
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from mclass.logs.decode.base import NARROW, CutError, DamagedError, demand
from mclass.logs.decode.ragged import ByteArray, offsets_from, read_rows
from mclass.records import IntArray

CUT_SHORT = "a field reaches beyond its message"
BAD_VARINT = "a number does not end"
BAD_TAG = "no protobuf field has this type or number"

VARINT, WORD64, BLOB, WORD32 = 0, 1, 2, 5
"""Wire types that are in use; groups (3 and 4) are not supported."""

# Payload bytes by wire type, without those that a varint tells; -1 for wire types not in use.
_SIZES = np.array([0, 8, 0, -1, -1, 4, -1, -1], dtype=np.int64)
_MAX_NUMBER = (1 << 29) - 1
_MAX_VARINT = 10


@dataclass(frozen=True)
class Records:
    """Fields found in spans.

    Attributes:
        span: Index of the span that each lies in, (r,).
        number: Field number, (r,).
        wire: Wire type, (r,).
        at: Position of the payload in the buffer, (r,); behind the length for a ``BLOB``.
        value: A varint's value (its 64 bits, signed), a ``BLOB``'s length, else 0, (r,).
    """

    span: IntArray
    number: IntArray
    wire: IntArray
    at: IntArray
    value: IntArray

    def take(self, index: npt.NDArray[Any]) -> Records:
        """Some of the records."""
        return Records(
            self.span[index],
            self.number[index],
            self.wire[index],
            self.at[index],
            self.value[index],
        )

    def of_field(self, number: int) -> Records:
        """Those of one field, by span and within a span as they lie there."""
        found = self.take(np.flatnonzero(self.number == number))
        if (found.span[1:] < found.span[:-1]).any():
            return found.take(np.argsort(found.span, kind="stable"))
        return found


def read_varints(
    buffer: ByteArray, at: IntArray, end: IntArray, messages: IntArray
) -> tuple[IntArray, IntArray]:
    """Varints that start at these positions, all before ``end``.

    Returns:
        Their 64 bits as signed numbers, and their sizes [bytes], (n,) each.

    Raises:
        DamagedError: If one reaches beyond its end, or beyond ten bytes.
    """
    first = buffer[at]
    sizes = np.ones(len(at), dtype=np.int64)
    more = np.flatnonzero(first >= 0x80)
    if not len(more):
        return first.astype(np.int64), sizes
    values = (first & 0x7F).astype(np.uint64)
    for count in range(1, _MAX_VARINT):
        position = at[more] + count
        demand(position < end[more], messages[more], BAD_VARINT)
        byte = buffer[position]
        values[more] |= (byte & 0x7F).astype(np.uint64) << np.uint64(7 * count)
        sizes[more] += 1
        more = more[byte >= 0x80]
        if not len(more):
            return values.view(np.int64), sizes
    raise DamagedError([(BAD_VARINT, messages[more])])


def cut_records(
    buffer: ByteArray, at: IntArray, end: IntArray, messages: IntArray, wanted: Set[int]
) -> Records:
    """Cut spans into records and keep those of the wanted fields.

    Args:
        buffer: Bytes that hold all spans.
        at: Where each span starts, (s,).
        end: Where each span ends, (s,).
        messages: The message that each span belongs to, (s,).
        wanted: Field numbers.

    Raises:
        DamagedError: If a span is not made of records.
    """
    wanted_numbers = np.array(sorted(wanted), dtype=np.int64)
    rounds = [Records(*(np.empty(0, dtype=np.int64) for _ in range(5)))]
    found: list[tuple[str, IntArray]] = []
    active = np.flatnonzero(at < end)
    at = at.copy()
    while len(active) >= NARROW:
        try:
            record, stop = _next_records(buffer, at[active], end[active], messages[active])
        except DamagedError as damage:
            found += damage.found
            active = active[~np.isin(messages[active], damage.messages)]
            continue
        rounds.append(_wanted_records(record, active, wanted_numbers))
        at[active] = stop
        active = active[stop < end[active]]
    rows: list[tuple[int, int, int, int, int]] = []
    view = buffer.data
    for span in active.tolist():
        try:
            cut = _cut_span(view, int(at[span]), int(end[span]), wanted)
            rows.extend((span, *row) for row in cut)
        except CutError as error:  # noqa: PERF203
            found.append((str(error), messages[span : span + 1]))
    if found:
        raise DamagedError(found)
    if rows:
        rounds.append(Records(*np.array(rows, dtype=np.int64).T))
    return Records(
        np.concatenate([part.span for part in rounds]),
        np.concatenate([part.number for part in rounds]),
        np.concatenate([part.wire for part in rounds]),
        np.concatenate([part.at for part in rounds]),
        np.concatenate([part.value for part in rounds]),
    )


def _next_records(
    buffer: ByteArray, at: IntArray, end: IntArray, messages: IntArray
) -> tuple[Records, IntArray]:
    """The record at each cursor, with the cursor's index as span, and where it ends."""
    heads, sizes = read_varints(buffer, at, end, messages)
    wires, numbers = heads & 7, heads >> 3
    payload_sizes = _SIZES[wires]
    demand((payload_sizes >= 0) & (numbers > 0) & (numbers <= _MAX_NUMBER), messages, BAD_TAG)
    at = at + sizes
    varying = np.flatnonzero(payload_sizes == 0)
    values = np.zeros(len(at), dtype=np.int64)
    if len(varying):
        demand(at[varying] < end[varying], messages[varying], CUT_SHORT)
        values[varying], sizes = read_varints(buffer, at[varying], end[varying], messages[varying])
        is_blob = wires[varying] == BLOB
        at[varying] += np.where(is_blob, sizes, 0)
        payload_sizes[varying] = np.where(is_blob, values[varying], sizes)
    demand((payload_sizes >= 0) & (payload_sizes <= end - at), messages, CUT_SHORT)
    return Records(np.arange(len(at)), numbers, wires, at, values), at + payload_sizes


def _wanted_records(records: Records, spans: IntArray, wanted: IntArray) -> Records:
    """Those of the wanted fields, with their true spans."""
    records = Records(spans, records.number, records.wire, records.at, records.value)
    if (records.number == records.number[0]).all():
        return records if records.number[0] in wanted else records.take(np.arange(0))
    return records.take(np.flatnonzero(np.isin(records.number, wanted)))


def _cut_span(
    buffer: memoryview, at: int, end: int, wanted: Set[int]
) -> Iterator[tuple[int, int, int, int]]:
    """The records of one span: all that ``Records`` tells of each but its span."""
    while at < end:
        head, at = _varint(buffer, at, end)
        wire, number = head & 7, head >> 3
        value = 0
        start = at
        if not 0 < number <= _MAX_NUMBER:
            raise CutError(BAD_TAG)
        if wire == VARINT:
            value, at = _varint(buffer, at, end)
        elif wire == BLOB:
            value, start = _varint(buffer, at, end)
            at = start + value
        elif wire in (WORD64, WORD32):
            at += 8 if wire == WORD64 else 4
        else:
            raise CutError(BAD_TAG)
        if at > end:
            raise CutError(CUT_SHORT)
        if number in wanted:
            yield number, wire, start, value - (value >> 63 << 64)


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


def unpack_varints(
    buffer: ByteArray, at: IntArray, lengths: IntArray, messages: IntArray
) -> tuple[IntArray, IntArray]:
    """Varints that fill blobs.

    Returns:
        The 64 bits of all, as signed numbers, and how many each blob holds, (b,).

    Raises:
        DamagedError: If a blob does not end with its last varint, or one is too long.
    """
    joined = read_rows(buffer, at, lengths, np.dtype(np.uint8))
    offsets = offsets_from(lengths)
    is_last = joined < 0x80
    filled = lengths > 0
    demand(is_last[offsets[1:][filled] - 1], messages[filled], BAD_VARINT)
    counts = np.diff(offsets_from(is_last.astype(np.int64))[offsets])
    stops = np.flatnonzero(is_last) + 1
    starts = np.concatenate([[0], stops[:-1]]).astype(np.int64)[: len(stops)]
    owners = np.repeat(messages, counts)
    demand(stops - starts <= _MAX_VARINT, owners, BAD_VARINT)
    values, _ = read_varints(joined, starts, stops, owners)
    return values, counts
