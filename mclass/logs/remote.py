"""A log at a URL: only the bytes that are asked for are fetched, neighbours in one go.

Requests cost more than bytes, so three things keep them few: the end of the log, where the
summary is, comes first and at once; what `RemoteSource.expect` announces is fetched in pieces
of some megabytes and ahead of time; small reads one after the other get ever larger blocks.
What was fetched is kept up to a limit, as logs are read more than once.
"""

from __future__ import annotations

import bisect
import os
import tempfile
import threading
from collections import OrderedDict
from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from mclass.logs.source import FileSource, Source, check_magic
from mclass.logs.stores import Store
from mclass.places import Url

_HEAD = 1 << 12
_TAIL = 1 << 17
_LEAST_BLOCK = 1 << 12
_PIECE = 1 << 23
_GAP = 1 << 15
_AHEAD = 3
_KEPT = 1 << 26
_MOST_SPANS = 256


class RemoteSource(Source):
    """Random access to the bytes of a log in a store.

    Args:
        store: Where it is.
        name: The log's name for messages.
        size: Bytes in it.
        version: Changes with the content; empty if not known.
    """

    block = _LEAST_BLOCK

    def __init__(self, store: Store, name: str, size: int, version: str) -> None:
        super().__init__(name, size)
        self._store = store
        self._version = version
        self._expected: list[tuple[int, int]] = []
        self._fetched: OrderedDict[tuple[int, int], Future[bytes]] = OrderedDict()
        self._held = 0
        self._next_block = _LEAST_BLOCK
        self._last_stop = -1
        self._lock = threading.Lock()
        self._pool = ThreadPoolExecutor(_AHEAD + 1, thread_name_prefix="mclass-fetch")
        self._set_expected([(0, _HEAD), (size - _TAIL, size)])

    def expect(self, ranges: Iterable[tuple[int, int]]) -> None:
        """See `Source.expect`."""
        # What the tail holds is there already; if it had to make room, a block will do.
        tail = max(self.size - _TAIL, 0)
        self._set_expected((start, min(stop, tail)) for start, stop in ranges)

    def read(self, offset: int, length: int) -> bytes:
        """See `Source.read`."""
        end = min(offset + length, self.size)
        parts = []
        while offset < end:
            (start, stop), future = self._piece(offset, end)
            data = future.result()
            parts.append(data[offset - start : end - start])
            offset = stop
        return parts[0] if len(parts) == 1 else b"".join(parts)

    def hash(self) -> str:
        """The store's word for the version; the content is not read for it."""
        return self._version

    def close(self) -> None:
        """Stop fetching; harmless when done twice."""
        self._pool.shutdown(wait=True, cancel_futures=True)
        self._fetched.clear()

    def _set_expected(self, ranges: Iterable[tuple[int, int]]) -> None:
        with self._lock:
            self._expected = _pieces(ranges, self.size)

    def _piece(self, offset: int, end: int) -> tuple[tuple[int, int], Future[bytes]]:
        """What was or is being fetched and holds the byte at ``offset``."""
        with self._lock:
            for span, future in self._fetched.items():
                if span[0] <= offset < span[1]:
                    self._fetched.move_to_end(span)
                    return span, future
            number = bisect.bisect_right(self._expected, (offset, self.size)) - 1
            if number < 0 or offset >= self._expected[number][1]:
                span = self._unexpected(offset, end)
                return span, self._fetch(span)
            for ahead in self._expected[number + 1 : number + 1 + _AHEAD]:
                if ahead not in self._fetched:
                    self._fetch(ahead)
            span = self._expected[number]
            return span, self._fetch(span)

    def _unexpected(self, offset: int, end: int) -> tuple[int, int]:
        """A block that nobody announced: larger and larger while reads go straight on."""
        goes_on = self._last_stop <= offset <= self._last_stop + self._next_block
        self._next_block = min(2 * self._next_block, _PIECE) if goes_on else _LEAST_BLOCK
        stop = min(max(end, offset + self._next_block), offset + _PIECE, self.size)
        self._last_stop = stop
        return offset, stop

    def _fetch(self, span: tuple[int, int]) -> Future[bytes]:
        future = self._pool.submit(self._store.read, *span)
        self._fetched[span] = future
        self._held += span[1] - span[0]
        while (self._held > _KEPT or len(self._fetched) > _MOST_SPANS) and len(
            self._fetched
        ) > _AHEAD + 1:
            (start, stop), _ = self._fetched.popitem(last=False)
            self._held -= stop - start
        return future


def open_remote(url: Url) -> Source:
    """Open a log at a URL.

    From a server that sends whole files only, it is copied to a temporary file first.

    Raises:
        LogError: If it is missing, may not be read, or is not MCAP.
        UsageError: If what is needed for the URL is not installed.
    """
    store = Store(url)
    facts = store.facts()
    if facts.has_ranges and facts.size is not None:
        source: Source = RemoteSource(store, str(url), facts.size, facts.version)
    else:
        source = _download(store, url)
    try:
        check_magic(source)
    except BaseException:
        source.close()
        raise
    return source


def _download(store: Store, url: Url) -> Source:
    descriptor, name = tempfile.mkstemp(prefix="mclass-")
    os.close(descriptor)
    try:
        store.download(Path(name))
        file = open(name, "rb", buffering=0)  # noqa: SIM115 (the source keeps it)
    finally:
        os.unlink(name)
    return FileSource(file, str(url))


def _pieces(ranges: Iterable[tuple[int, int]], size: int) -> list[tuple[int, int]]:
    """Ranges of bytes, by increasing start, as what is fetched at a time; near ones together."""
    pieces: list[tuple[int, int]] = []
    for start, stop in ranges:
        begin, end = max(start, 0), min(stop, size)
        if pieces and begin <= pieces[-1][1] + _GAP and end - pieces[-1][0] <= _PIECE:
            begin, last_end = pieces.pop()
            end = max(end, last_end)
        elif pieces:
            begin = max(begin, pieces[-1][1])
        while end - begin > _PIECE:
            pieces.append((begin, begin + _PIECE))
            begin += _PIECE
        if begin < end:
            pieces.append((begin, end))
    return pieces
