"""ROS messages, CDR or ROS 1: all messages of a batch are walked through their layout at once.

One cursor a message moves from run to run; what is wanted is gathered at all cursors together.
Elements of a sequence become cursors themselves. Where each of them starts is known by
arithmetic if their size is fixed. If not, the k-th elements of all messages are skipped
together, and once few messages have elements left, these one by one in plain Python.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from mclass.errors import LogError
from mclass.logs.decode.base import NARROW, ChannelDecoder, Column, CutError, DamagedError, demand
from mclass.logs.decode.layout import (
    Elements,
    Numbers,
    Scalar,
    Struct,
    Text,
    compile_layout,
)
from mclass.logs.decode.ragged import (
    ByteArray,
    offsets_from,
    read_rows,
    read_texts,
    read_words,
    spread,
)
from mclass.messages.definitions import Dialect, normalise_name, parse_definitions
from mclass.records import BoolArray, IntArray

if TYPE_CHECKING:
    from mclass.logs.channels import ChannelInfo, MessageBatch

CUT_SHORT = "payload ends before its last field"
LONG_STRING = "a string is longer than its message"
LONG_SEQUENCE = "a sequence is longer than its message"
LEFT_OVER = "payload goes on behind its last field"
NO_HEADER = "payload too short for a CDR header"
OTHER_HEADER = "CDR header is not that of plain CDR (parameter lists and XCDR2 are not supported)"

_HEADER_SIZE = 4
_CDR_PADDING = 3
_LENGTH = np.dtype("<u4")
_LENGTHS = {False: struct.Struct("<I"), True: struct.Struct(">I")}


class RosDecoder(ChannelDecoder):
    """Decoder of ``cdr`` (``ros2msg``) and ``ros1`` (``ros1msg``) channels."""

    def __init__(self, channel: ChannelInfo) -> None:
        try:
            text = channel.schema_data.decode("utf-8")
        except UnicodeDecodeError as error:
            raise LogError(f"schema {channel.schema_name!r} is not UTF-8 text.") from error
        self._is_cdr = channel.message_encoding == "cdr"
        dialect: Dialect = "ros2msg" if self._is_cdr else "ros1msg"
        definitions = parse_definitions(channel.schema_name, text, dialect)
        self._layout, self._paths = compile_layout(
            definitions, normalise_name(channel.schema_name), aligned=self._is_cdr
        )
        self._select = lru_cache(maxsize=16)(self._layout.select)

    @property
    def paths(self) -> Mapping[str, str]:
        """Kind of every leaf by its path."""
        return self._paths

    def _decode(
        self, batch: MessageBatch, rows: IntArray, wanted: tuple[str, ...]
    ) -> dict[str, Column]:
        buffer = np.frombuffer(batch.buffer, dtype=np.uint8)
        begin = batch.offsets[rows]
        end = begin + batch.lengths[rows]
        big = None
        if self._is_cdr:
            big = _big_endian(buffer, begin, end)
            begin = begin + _HEADER_SIZE
        walk = _Walk(buffer, begin, end, big if big is not None and big.any() else None)
        messages = np.arange(len(rows), dtype=np.int64)
        padding = _CDR_PADDING if self._is_cdr else 0
        try:
            stops = walk.read_struct(self._select(frozenset(wanted)), begin, messages, ())
            demand(end - stops <= padding, messages, LEFT_OVER)
        except (DamagedError, CutError) as error:
            # The walk ends at the first fault, so all messages are looked at one by one.
            raise DamagedError(walk.find_faults(self._layout, padding)) from error
        return walk.columns


def _big_endian(buffer: ByteArray, begin: IntArray, end: IntArray) -> BoolArray:
    """Whether each CDR payload is big-endian, by its header."""
    short = end - begin < _HEADER_SIZE
    if short.any():
        raise DamagedError([(NO_HEADER, np.flatnonzero(short))])
    header = read_words(buffer, begin, np.dtype(">u2"))
    if (header > 1).any():
        raise DamagedError([(OTHER_HEADER, np.flatnonzero(header > 1))])
    big: BoolArray = header == 0
    return big


@dataclass
class _Walk:
    """One pass over the payloads of a batch.

    Attributes:
        buffer: Bytes that hold all payloads.
        base: Where each message's alignment counts from, (n,).
        end: Where each message ends, (n,).
        big: Whether each message is big-endian, (n,); None if none is.
        columns: Filled on the way.
    """

    buffer: ByteArray
    base: IntArray
    end: IntArray
    big: BoolArray | None
    columns: dict[str, Column] = field(default_factory=dict)

    def read_struct(
        self, layout: Struct, at: IntArray, messages: IntArray, levels: tuple[IntArray, ...]
    ) -> IntArray:
        """Read structures that start at the cursors.

        Args:
            layout: Of the structure, with what is wanted of it.
            at: Cursors: positions in the buffer, (m,).
            messages: The message that each cursor belongs to, (m,).
            levels: Offsets of the sequences around, outermost first.

        Returns:
            Where each structure ends, (m,).

        Raises:
            DamagedError: If a structure reaches beyond its message.
            CutError: The same, where elements were skipped one by one.
        """
        base, end = self.base[messages], self.end[messages]
        for run in layout.runs:
            phase = (at - base) & 7
            stop = at + run.sizes[phase]
            demand(stop <= end, messages, CUT_SHORT)
            for leaf in run.leaves:
                words = leaf.scalar.words if leaf.count is None else leaf.count
                raw = read_words(self.buffer, at + leaf.offsets[phase], leaf.scalar.dtype, words)
                if leaf.count is None:
                    values = _widen(self.values(raw, leaf.scalar, messages))
                else:
                    values = self.values(raw.reshape(len(at), words), leaf.scalar, messages)
                self.columns[leaf.path] = Column(values, levels)
            at = stop
            if isinstance(run.tail, Elements):
                at = self.read_elements(run.tail, at, messages, levels)
            elif isinstance(run.tail, Numbers):
                at = self.read_numbers(run.tail, at, messages, levels)
            elif run.tail is not None:
                at = self.read_text(run.tail, at, messages, levels)
        return at

    def read_text(
        self, tail: Text, at: IntArray, messages: IntArray, levels: tuple[IntArray, ...]
    ) -> IntArray:
        """Read strings; cursors stand behind their lengths."""
        lengths = self.lengths(at, messages)
        stop = at + lengths
        demand(stop <= self.end[messages], messages, LONG_STRING)
        if tail.wanted:
            if tail.terminated:
                lengths = lengths - ((lengths > 0) & (self.buffer[stop - 1] == 0))
            self.columns[tail.path] = Column(read_texts(self.buffer, at, lengths), levels)
        return stop

    def read_numbers(
        self, tail: Numbers, at: IntArray, messages: IntArray, levels: tuple[IntArray, ...]
    ) -> IntArray:
        """Read sequences of scalars; cursors stand behind their lengths."""
        counts = self.lengths(at, messages)
        padding = -(at - self.base[messages]) & (tail.align - 1)
        start = at + np.where(counts > 0, padding, 0)
        stop = start + counts * tail.scalar.size
        demand(stop <= self.end[messages], messages, LONG_SEQUENCE)
        if tail.wanted:
            raw = read_rows(self.buffer, start, counts, tail.scalar.dtype, tail.scalar.words)
            values = self.values(raw, tail.scalar, np.repeat(messages, counts))
            self.columns[tail.path] = Column(values, (*levels, offsets_from(counts)))
        return stop

    def read_elements(
        self, tail: Elements, at: IntArray, messages: IntArray, levels: tuple[IntArray, ...]
    ) -> IntArray:
        """Read sequences of structures: where each starts first, then all elements as one."""
        layout = tail.struct
        if tail.count is None:
            counts = self.lengths(at, messages)
        else:
            counts = np.full(len(at), tail.count, dtype=np.int64)
        room = (self.end[messages] - at) // layout.min_size
        demand(counts <= room, messages, LONG_SEQUENCE)
        offsets = offsets_from(counts)
        if layout.is_fixed:
            starts, stop = self.fixed_starts(layout, at, messages, counts)
            demand(stop <= self.end[messages], messages, LONG_SEQUENCE)
        else:
            starts, stop = self.varying_starts(layout, at, messages, counts)
        if layout.wants_any:
            self.read_struct(layout, starts, np.repeat(messages, counts), (*levels, offsets))
        return stop

    def fixed_starts(
        self, layout: Struct, at: IntArray, messages: IntArray, counts: IntArray
    ) -> tuple[IntArray, IntArray]:
        """Where each element of fixed size starts (total,), and where each sequence ends (m,)."""
        sizes = layout.runs[0].sizes
        phase = (at - self.base[messages]) & 7
        first = sizes[phase]
        # The widest number fixes the phase behind it, so all but the first have equal sizes.
        stride = sizes[(phase + first) & 7]
        ranks = spread(np.zeros_like(counts), counts)
        second = np.repeat(at + first, counts)
        starts = second + (ranks - 1) * np.repeat(stride, counts)
        starts[ranks == 0] = at[counts > 0]
        return starts, at + np.where(counts > 0, first + (counts - 1) * stride, 0)

    def varying_starts(
        self, layout: Struct, at: IntArray, messages: IntArray, counts: IntArray
    ) -> tuple[IntArray, IntArray]:
        """As ``fixed_starts`` for elements that must be read to know where they end."""
        offsets = offsets_from(counts)
        starts = np.empty(offsets[-1], dtype=np.int64)
        stop = at.copy()
        active = np.flatnonzero(counts > 0)
        done = 0
        while len(active) >= NARROW:
            starts[offsets[active] + done] = stop[active]
            stop[active] = self.read_struct(layout.bare, stop[active], messages[active], ())
            done += 1
            active = active[counts[active] > done]
        for row in active.tolist():
            skipper = self.skipper(int(messages[row]))
            position = int(stop[row])
            for slot in range(int(offsets[row]) + done, int(offsets[row + 1])):
                starts[slot] = position
                position = skipper.skip(layout, position)
            stop[row] = position
        return starts, stop

    def skipper(self, message: int) -> _Skipper:
        """For one message."""
        return _Skipper(
            self.buffer.data,
            int(self.base[message]),
            int(self.end[message]),
            _LENGTHS[self.big is not None and bool(self.big[message])],
        )

    def find_faults(self, layout: Struct, padding: int) -> list[tuple[str, IntArray]]:
        """Reasons, and the messages that cannot be read for them."""
        found: dict[str, list[int]] = {}
        for message in range(len(self.base)):
            skipper = self.skipper(message)
            try:
                stop = skipper.skip(layout, skipper.base)
                if skipper.end - stop > padding:
                    raise CutError(LEFT_OVER)
            except CutError as error:
                found.setdefault(str(error), []).append(message)
        return [(reason, np.array(messages)) for reason, messages in found.items()]

    def lengths(self, at: IntArray, messages: IntArray) -> IntArray:
        """The lengths that the cursors stand behind, (m,)."""
        raw = read_words(self.buffer, at - _LENGTH.itemsize, _LENGTH)
        return self.swapped(raw, messages).astype(np.int64)

    def values(self, raw: npt.NDArray[Any], scalar: Scalar, messages: IntArray) -> npt.NDArray[Any]:
        """Numbers, truth values or nanoseconds from words of the wire, (m, ...)."""
        words = self.swapped(raw, messages)
        if scalar.words == 2:
            seconds = words[:, 0].astype(np.int64)
            stamps: IntArray = seconds * 1_000_000_000 + words[:, 1]
            return stamps
        return words != 0 if scalar.kind == "bool" else words

    def swapped(self, raw: npt.NDArray[Any], messages: IntArray) -> npt.NDArray[Any]:
        """Words with those of big-endian messages turned around."""
        if self.big is not None:
            big = self.big[messages]
            raw[big] = raw[big].byteswap()
        return raw


@dataclass(frozen=True)
class _Skipper:
    """Finds the ends of structures in one message, whose attributes are as in ``_Walk``."""

    buffer: memoryview
    base: int
    end: int
    length: struct.Struct

    def skip(self, layout: Struct, at: int) -> int:
        """End of the structure that starts at ``at``."""
        for run in layout.runs:
            at += run.size_list[(at - self.base) & 7]
            if at > self.end:
                raise CutError(CUT_SHORT)
            tail = run.tail
            if tail is None:
                continue
            count = tail.count if isinstance(tail, Elements) else None
            if count is None:
                (count,) = self.length.unpack_from(self.buffer, at - _LENGTH.itemsize)
            if isinstance(tail, Text):
                at += count
                if at > self.end:
                    raise CutError(LONG_STRING)
            elif isinstance(tail, Numbers):
                if count:
                    at += -(at - self.base) & (tail.align - 1)
                at += count * tail.scalar.size
                if at > self.end:
                    raise CutError(LONG_SEQUENCE)
            else:
                at = self.skip_elements(tail.struct, at, count)
        return at

    def skip_elements(self, layout: Struct, at: int, count: int) -> int:
        """End of a sequence whose first element starts at ``at``."""
        if count * layout.min_size > self.end - at:
            raise CutError(LONG_SEQUENCE)
        if not layout.is_fixed:
            for _ in range(count):
                at = self.skip(layout, at)
        elif count:
            sizes = layout.runs[0].size_list
            at += sizes[(at - self.base) & 7]
            at += (count - 1) * sizes[(at - self.base) & 7]
            if at > self.end:
                raise CutError(LONG_SEQUENCE)
        return at


def _widen(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Single numbers as float64 or int64; truth values and uint64 stay."""
    if values.dtype.kind == "f":
        # A signalling NaN is worth no warning; it becomes a plain one.
        with np.errstate(invalid="ignore"):
            return values.astype(np.float64)
    if values.dtype.kind in "iu" and values.dtype != np.uint64:
        return values.astype(np.int64)
    return values
