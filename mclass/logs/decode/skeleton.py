"""Protobuf messages with one skeleton: of one length, with the same fields at the same places.

What a writer writes mostly differs in its values alone. One message is cut into records, the
bytes between the values of all others are compared with its own, and where they are equal
every value lies where it lies in the first.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from mclass.logs.decode.base import NARROW, CutError
from mclass.logs.decode.protobuf_schema import STAMP, Branch, Leaf, Node
from mclass.logs.decode.ragged import ByteArray, read_words
from mclass.logs.decode.wireformat import (
    BLOB,
    VARINT,
    Spans,
    cut_span,
    join_sevens,
)
from mclass.records import BoolArray, IntArray

# Longer messages mostly hold something long that nobody wants, and would be copied for nothing.
_LONGEST = 512
# Cutting one message in Python must pay: one in so many of those left must have its skeleton.
_SHARE = 4
_MAX_SKELETONS = 8
_SAMPLE = 64
_BLOCK = 1 << 16


@dataclass(frozen=True)
class Place:
    """Where a value is, in bytes from the start of its message."""

    at: int
    size: int
    wire: int


@dataclass(frozen=True)
class Alike:
    """Messages of one skeleton.

    Attributes:
        index: Which of the spans they are, (n,), increasing.
        at: Where they start, (n,).
        content: Their bytes, (n, l).
        places: Their values by the path of the leaf; `SECONDS` and `NANOS` lie below a stamp's.
    """

    index: IntArray
    at: IntArray
    content: ByteArray
    places: Mapping[str, Place]

    def words(self, place: Place, dtype: np.dtype[Any]) -> npt.NDArray[Any]:
        """Numbers of fixed size, (n,)."""
        count, size = self.content.shape
        return np.ndarray((count,), dtype, self.content, place.at, (size,))

    def varints(self, place: Place) -> IntArray:
        """Varints' 64 bits as signed numbers, (n,)."""
        first = place.at + place.size - 8
        if place.size <= 8 and first >= 0:
            words = self.words(Place(first, 8, place.wire), np.dtype("<u8"))
            return join_sevens(words >> np.uint64(64 - 8 * place.size)).view(np.int64)
        bits = np.zeros(len(self.content), dtype=np.uint64)
        for count in range(place.size):
            byte = (self.content[:, place.at + count] & 0x7F).astype(np.uint64)
            bits |= byte << np.uint64(7 * count)
        return bits.view(np.int64)


@dataclass(frozen=True)
class _Skeleton:
    """What messages of one layout have in common.

    Attributes:
        frame: Their bytes, (l,), zero where the mask is.
        mask: The bits that are equal in all, (l,): field numbers and lengths, and of each byte
            of a varint whether it goes on.
        places: As in `Alike`.
    """

    frame: ByteArray
    mask: ByteArray
    places: Mapping[str, Place]

    def fits(self, content: ByteArray) -> BoolArray:
        """Which of these messages, (n, l), have it, (n,)."""
        # Many messages a step, since NumPy is slow with short rows; not all, for the cache.
        count = min(len(content), max(1, _BLOCK // len(self.frame)))
        mask, frame = np.tile(self.mask, count), np.tile(self.frame, count)
        joined = content.reshape(-1)
        for start in range(0, len(joined), len(mask)):
            block = joined[start : start + len(mask)]
            if not ((block & mask[: len(block)]) == frame[: len(block)]).all():
                return np.asarray(((content & self.mask) == self.frame).all(axis=1))
        return np.ones(len(content), dtype=np.bool_)


def find_alike(buffer: ByteArray, spans: Spans, node: Node) -> tuple[list[Alike], IntArray]:
    """Messages whose skeletons are frequent among them.

    Args:
        buffer: The bytes.
        spans: One message each.
        node: Their fields, none of them repeated at any level.

    Returns:
        Those found, by skeleton, and the indices, (r,), of the other spans.
    """
    found: list[Alike] = []
    lengths = spans.end - spans.at
    rest = np.arange(len(lengths))
    while len(rest) >= NARROW and len(found) < _MAX_SKELETONS:
        sample = rest[:: -(-len(rest) // _SAMPLE)]
        sizes = np.minimum(lengths[sample], _LONGEST + 1)
        size = int(np.bincount(sizes).argmax())
        skeleton = _skeleton(buffer, int(spans.at[sample[sizes.tolist().index(size)]]), size, node)
        same = lengths[rest] == size
        enough = max(NARROW, len(rest) // _SHARE)
        if skeleton is None or np.count_nonzero(same) < enough:
            break
        at = spans.at[rest[same]]
        content = read_words(buffer, at, np.dtype(f"V{size}")).view(np.uint8).reshape(-1, size)
        fits = skeleton.fits(content)
        if np.count_nonzero(fits) < enough:
            break
        if not fits.all():
            same[same], at, content = fits, at[fits], content[fits]
        found.append(Alike(rest[same], at, content, skeleton.places))
        rest = rest[~same]
    return found, rest


def _skeleton(buffer: ByteArray, at: int, size: int, node: Node) -> _Skeleton | None:
    """The skeleton of one message; None if it is damaged, empty or long."""
    if not 0 < size <= _LONGEST:
        return None
    content = buffer[at : at + size]
    mask = np.full(size, 0xFF, dtype=np.uint8)
    places: dict[str, Place] = {}
    try:
        _cut(content.data, 0, size, node, "", mask, places)
    except CutError:
        return None
    return _Skeleton(content & mask, mask, places)


def _cut(
    content: memoryview,
    at: int,
    end: int,
    node: Node,
    prefix: str,
    mask: ByteArray,
    places: dict[str, Place],
) -> None:
    """Find the values between ``at`` and ``end``; a field's last one holds."""
    for number, wire, start, _, stop in cut_span(content, at, end):
        item = node.fields.get(number)
        if isinstance(item, Branch) and wire == BLOB:
            _cut(content, start, stop, item.node, prefix, mask, places)
            continue
        if isinstance(item, Leaf) and item.is_stamp and wire == BLOB:
            _cut(content, start, stop, STAMP, f"{item.path}.", mask, places)
            continue
        mask[start:stop] = 0x80 if wire == VARINT else 0
        if isinstance(item, Leaf) and wire == item.wire:
            places[prefix + item.path] = Place(start, stop - start, wire)
