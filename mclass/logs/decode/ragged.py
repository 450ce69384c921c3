"""Arrays of unequal rows in one buffer: index them, cut strings and numbers out of them."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from mclass.records import IntArray

ByteArray = npt.NDArray[np.uint8]

# Above this many numbers a row, copying row by row beats an index for every number.
_LONG_ROW = 64


def offsets_from(counts: IntArray) -> IntArray:
    """Row boundaries (n + 1,) of consecutive rows of these lengths (n,)."""
    offsets = np.zeros(len(counts) + 1, dtype=np.int64)
    np.cumsum(counts, out=offsets[1:])
    return offsets


def spread(starts: IntArray, counts: IntArray, step: int = 1) -> IntArray:
    """``start, start + step, ...`` of every row, ``count`` values each, end to end."""
    offsets = offsets_from(counts)
    first = np.repeat(starts - offsets[:-1] * step, counts)
    positions: IntArray = first + np.arange(offsets[-1], dtype=np.int64) * step
    return positions


def read_words(
    buffer: ByteArray, starts: IntArray, dtype: np.dtype[Any], words: int = 1
) -> npt.NDArray[Any]:
    """Numbers at any byte positions, aligned or not.

    Args:
        buffer: The bytes, (b,).
        starts: Positions of the first word of each row, (n,); all rows must lie in the buffer.
        dtype: Of a word, with its byte order.
        words: Consecutive words of a row.

    Returns:
        Shape (n,) for one word, else (n, words).
    """
    size = dtype.itemsize * words
    shape = () if words == 1 else (words,)
    if not len(starts):
        return np.empty((0, *shape), dtype)
    everywhere = np.ndarray(
        (len(buffer) - size + 1, *shape), dtype, buffer, 0, (1, *(dtype.itemsize for _ in shape))
    )
    result: npt.NDArray[Any] = everywhere[starts]
    return result


def read_rows(
    buffer: ByteArray, starts: IntArray, counts: IntArray, dtype: np.dtype[Any], words: int = 1
) -> npt.NDArray[Any]:
    """Rows of consecutive numbers, ``counts`` items of ``words`` words each, end to end."""
    size = dtype.itemsize * words
    if int(counts.sum()) <= _LONG_ROW * len(counts):
        return read_words(buffer, spread(starts, counts, size), dtype, words)
    rows = [
        np.frombuffer(buffer, dtype, count * words, start)
        for start, count in zip(starts.tolist(), counts.tolist(), strict=True)
        if count
    ]
    joined = np.concatenate(rows)
    return joined if words == 1 else joined.reshape(-1, words)


def read_bytes(buffer: ByteArray, starts: IntArray, lengths: IntArray) -> list[bytes]:
    """The bytes of every row."""
    joined = read_rows(buffer, starts, lengths, np.dtype(np.uint8)).tobytes()
    stops = np.cumsum(lengths)
    return [
        joined[start:stop]
        for start, stop in zip((stops - lengths).tolist(), stops.tolist(), strict=True)
    ]


def read_texts(buffer: ByteArray, starts: IntArray, lengths: IntArray) -> npt.NDArray[np.object_]:
    """UTF-8 strings, damaged characters replaced; equal strings are one object."""
    texts = np.empty(len(starts), dtype=object)
    if not lengths.any():
        texts.fill("")
        return texts
    width = int(lengths[0])
    if (lengths == width).all():
        # Frame names and the like: one string throughout, so each is as the one before it.
        joined = read_words(buffer, starts, np.dtype(f"V{width}")).view(np.uint8)
        if (joined[width:] == joined[:-width]).all():
            texts.fill(joined[:width].tobytes().decode("utf-8", "replace"))
            return texts
    known: dict[bytes, str] = {}
    strings = read_bytes(buffer, starts, lengths)
    for raw in strings:
        if raw not in known:
            known[raw] = raw.decode("utf-8", "replace")
    texts[:] = [known[raw] for raw in strings]
    return texts
