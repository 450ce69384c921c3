"""Arrays of unequal rows in one buffer: index them, cut strings and numbers out of them."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from mclass.records import IntArray

ByteArray = npt.NDArray[np.uint8]

# Above this many numbers a row, copying row by row beats an index for every number.
_LONG_ROW = 64
# So many strings are told apart faster by array operations than by a dictionary.
_FEW_TEXTS = 100
_ALL = np.uint64(0xFFFF_FFFF_FFFF_FFFF)
_HASH_FACTOR = np.uint64(0x9E37_79B9_7F4A_7C15)


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


def read_eights(buffer: ByteArray, starts: IntArray) -> npt.NDArray[np.uint64]:
    """Eight bytes from each place as one number, (n,); zeros beyond the buffer's end."""
    if len(buffer) < 8:
        buffer = np.pad(buffer, (0, 8 - len(buffer)))
    inside = np.minimum(starts, len(buffer) - 8)
    words: npt.NDArray[np.uint64] = read_words(buffer, inside, np.dtype("<u8"))
    beyond = starts - inside
    return words >> (8 * beyond).astype(np.uint64) if beyond.any() else words


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
    found = _distinct(buffer, starts, lengths) if len(starts) > _FEW_TEXTS else None
    if found is not None:
        first, which = found
        strings = read_bytes(buffer, starts[first], lengths[first])
        distinct = np.array([*(raw.decode("utf-8", "replace") for raw in strings), ""], object)
        return np.asarray(distinct[which])
    known: dict[bytes, str] = {}
    strings = read_bytes(buffer, starts, lengths)
    for raw in strings:
        if raw not in known:
            known[raw] = raw.decode("utf-8", "replace")
    texts[:] = [known[raw] for raw in strings]
    return texts


def _distinct(
    buffer: ByteArray, starts: IntArray, lengths: IntArray
) -> tuple[IntArray, IntArray] | None:
    """Rows that are unlike each other, (k,), and which of these each row is like, (n,).

    None if it cannot be told in a few array operations: where rows are long, or two that differ
    have the same hash.
    """
    longest = int(lengths.max())
    if longest > _LONG_ROW:
        return None
    words = [lengths.view(np.uint64)]
    hashes = words[0]
    for at in range(0, longest, 8):
        bits = 8 * np.clip(lengths - at, 0, 8).astype(np.uint64)
        # All bits of a shift by 64 are gone.
        words.append(read_eights(buffer, starts + at) & ~(_ALL << bits))
        hashes = (hashes ^ words[-1]) * _HASH_FACTOR
    order = np.argsort(hashes)
    in_order = hashes[order]
    is_new = np.append(True, in_order[1:] != in_order[:-1])
    which = np.empty_like(order)
    which[order] = np.cumsum(is_new) - 1
    first = order[is_new]
    same = first[which]
    return (first, which) if all((word == word[same]).all() for word in words) else None
