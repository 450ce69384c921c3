"""The data section of a log being written, and what its summary will say of it."""

from __future__ import annotations

import zlib
from collections.abc import Callable

import numpy as np
import zstandard
from mcap.records import ChunkIndex

from mclass.logs.closing import Contents
from mclass.logs.in_place import InPlaceFile
from mclass.logs.pending import PendingFile
from mclass.logs.source import Source
from mclass.logs.uploads import UploadFile
from mclass.logs.wire import ChunkHead, heads_at, pack_chunk_head, pack_message_index
from mclass.records import IntArray


class DataSection:
    """Records one behind the other.

    Args:
        file: That they are written to, from its start on.

    Attributes:
        contents: What the summary will say.
        position: Bytes written so far.
        crc: Of these bytes; None when not all of them were seen.
    """

    def __init__(self, file: PendingFile | UploadFile | InPlaceFile) -> None:
        self._file = file
        self.contents = Contents()
        self.position = 0
        self.crc: int | None = 0

    def emit(self, data: bytes | bytearray | memoryview) -> None:
        """Append bytes.

        Raises:
            LogError: If the disk is full or fails.
        """
        self._file.write(data)
        self.position += len(data)
        if self.crc is not None:
            self.crc = zlib.crc32(data, self.crc)

    def copy(self, source: Source, start: int, end: int, done: Callable[[int], None]) -> None:
        """Append a range of bytes of a log; they do not count in ``crc``.

        Raises:
            LogError: If the disk is full or fails, or the log lost bytes in the meantime.
        """
        self._file.copy(source, start, end, done)
        self.position += end - start

    def write_chunk(self, data: bytes, starts: IntArray, compression: str) -> None:
        """Write records as a chunk with its message indexes; nothing if there are no messages."""
        if not len(starts):
            self.emit(data)
            return
        heads = heads_at(data, starts)
        times = heads["log_time"]
        packed = zstandard.ZstdCompressor().compress(data) if compression else data
        head = ChunkHead(
            int(times.min()),
            int(times.max()),
            len(data),
            zlib.crc32(data),
            compression,
            0,
            len(packed),
        )
        offset = self.position
        self.emit(pack_chunk_head(head))
        self.emit(packed)
        length = self.position - offset
        places, counts = {}, {}
        for channel in np.unique(heads["channel"]).tolist():
            rows = np.flatnonzero(heads["channel"] == channel)
            places[channel], counts[channel] = self.position, len(rows)
            self.emit(pack_message_index(channel, times[rows], starts[rows]))
        chunk = ChunkIndex(
            chunk_length=length,
            chunk_start_offset=offset,
            compression=compression,
            compressed_size=len(packed),
            message_end_time=head.end_time,
            message_index_length=self.position - offset - length,
            message_index_offsets=places,
            message_start_time=head.start_time,
            uncompressed_size=len(data),
        )
        self.contents.add_chunk(chunk, counts)
