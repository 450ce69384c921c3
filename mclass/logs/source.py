"""The bytes of a log: opened and recognised, read in pieces, never as a whole."""

from __future__ import annotations

import abc
import hashlib
import os
import stat
import tempfile
import threading
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import IO

from mclass.errors import LogError
from mclass.logs.in_place import recover

MAGIC = b"\x89MCAP0\r\n"

# Large: a thread that hashes waits for the interpreter between blocks.
_HASH_BLOCK = 1 << 23
_SPOOL_BLOCK = 1 << 20
_CHECKED_BLOCK = 1 << 20

_OTHER_FORMATS = (
    (b"#ROSBAG", "is a ROS 1 bag, not MCAP. Convert it: mcap convert in.bag out.mcap"),
    (b"SQLite format 3", "is a SQLite database (a rosbag2 .db3?), not MCAP. Convert it: "
     "mcap convert in.db3 out.mcap"),
    (b"\x1f\x8b", "is compressed with gzip. Decompress it first: gunzip -k FILE"),
    (b"\x28\xb5\x2f\xfd", "is compressed with zstd. Decompress it first: zstd -d FILE"),
    (b"\x04\x22\x4d\x18", "is compressed with lz4. Decompress it first: lz4 -d FILE"),
    (b"PK\x03\x04", "is a zip archive. Unpack it first"),
    (b"version https://git-lfs", "is a Git LFS pointer, not the log. Fetch it: git lfs pull"),
)  # fmt: skip


class Source(abc.ABC):
    """Random access to the bytes of an open log.

    Attributes:
        name: The log's name for messages.
        size: Bytes in it when it was opened.
        block: Bytes that `peek` reads at least.
    """

    block = 1 << 16

    def __init__(self, name: str, size: int) -> None:
        self.name = name
        self.size = size
        self._block = b""
        self._block_offset = 0

    @abc.abstractmethod
    def read(self, offset: int, length: int) -> bytes:
        """Bytes from ``offset``; fewer than ``length`` only where the log ends.

        Raises:
            LogError: If the disk or the store fails.
        """

    def peek(self, offset: int, length: int) -> bytes:
        """As ``read``, for the small reads of a walk along records: whole blocks are kept."""
        start = offset - self._block_offset
        if start < 0 or start + length > len(self._block):
            self._block = self.read(offset, max(length, self.block))
            self._block_offset, start = offset, 0
        return self._block[start : start + length]

    def checksum(self, start: int, end: int) -> int:
        """CRC-32 of a range of bytes, in bounded memory.

        Raises:
            LogError: If the disk or the store fails.
        """
        crc = 0
        for offset in range(start, end, _CHECKED_BLOCK):
            crc = zlib.crc32(self.read(offset, min(_CHECKED_BLOCK, end - offset)), crc)
        return crc

    def expect(self, ranges: Iterable[tuple[int, int]]) -> None:
        """Say which bytes are read next, so that what is far away can be fetched in time.

        Args:
            ranges: Begin and end of each, by increasing begin.
        """
        del ranges  # a disk needs no notice

    @abc.abstractmethod
    def hash(self) -> str:
        """What tells this content from any other; empty if there is no such thing.

        ``sha256:`` and the hash of a file; for a URL the version that its store tells.

        Raises:
            LogError: If the disk fails.
        """

    @property
    def descriptor(self) -> int | None:
        """Of the file, for copies inside the kernel; None if there is none."""
        return None

    @abc.abstractmethod
    def close(self) -> None:
        """Let go of the log; harmless when done twice."""


class FileSource(Source):
    """A log in a file. Threads may read at the same time.

    Args:
        file: Open for reading, unbuffered.
        name: The log's name for messages.
    """

    def __init__(self, file: IO[bytes], name: str) -> None:
        super().__init__(name, os.fstat(file.fileno()).st_size)
        self._file = file
        self._lock = threading.Lock()

    def read(self, offset: int, length: int) -> bytes:
        """See `Source.read`."""
        length = max(0, min(length, self.size - offset))
        if not length:
            return b""
        try:
            data = self._read(offset, length)
            while len(data) < length:
                more = self._read(offset + len(data), length - len(data))
                if not more:
                    break
                data += more
        except OSError as error:
            raise LogError(f"cannot be read: {_reason(error)}.", path=self.name) from error
        return data

    def hash(self) -> str:
        """See `Source.hash`."""
        digest = hashlib.sha256()
        for offset in range(0, self.size, _HASH_BLOCK):
            digest.update(self.read(offset, _HASH_BLOCK))
        return f"sha256:{digest.hexdigest()}"

    @property
    def descriptor(self) -> int | None:
        """See `Source.descriptor`."""
        return self._file.fileno()

    def close(self) -> None:
        """See `Source.close`."""
        self._file.close()

    def _read(self, offset: int, length: int) -> bytes:
        if hasattr(os, "pread"):
            return os.pread(self._file.fileno(), length, offset)
        with self._lock:
            self._file.seek(offset)
            return self._file.read(length)


def open_source(path: str | os.PathLike[str]) -> Source:
    """Open a log. A pipe is copied to a temporary file first.

    A log that a run with ``--in-place`` left unfinished is restored first.

    Raises:
        LogError: If it is missing, unreadable, no file, or not MCAP; says what it is instead.
    """
    name = os.fspath(path)
    file: IO[bytes] | None = None
    try:
        # Asked before opening: opening a device can already do harm.
        mode = os.stat(name).st_mode
        if stat.S_ISDIR(mode):
            raise LogError(_folder_advice(Path(name)), path=name)
        if not (stat.S_ISREG(mode) or stat.S_ISFIFO(mode)):
            raise LogError("is a device or socket. Give a file or a pipe.", path=name)
        recover(name)
        file = open(name, "rb", buffering=0)  # noqa: SIM115 (the source keeps it)
        if stat.S_ISFIFO(mode):
            file = _spool(file, name)
        source = FileSource(file, name)
        check_magic(source)
    except OSError as error:
        if file is not None:
            file.close()
        raise LogError(f"cannot be opened: {_reason(error)}.", path=name) from error
    except ValueError as error:
        raise LogError("is not a file name (it holds a zero character).", path=name) from error
    except BaseException:
        if file is not None:
            file.close()
        raise
    return source


def _spool(pipe: IO[bytes], name: str) -> IO[bytes]:
    """Copy a pipe to an unnamed temporary file; refuse before copying what is not MCAP."""
    with pipe:
        head = b""
        while len(head) < 64 and (more := pipe.read(64 - len(head))):
            head += more
        if not head.startswith(MAGIC):
            raise LogError(_not_mcap(head, len(head)), path=name)
        spool = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115 (returned)
        try:
            block = head
            while block:
                view = memoryview(block)
                while view:
                    view = view[spool.write(view) :]
                block = pipe.read(_SPOOL_BLOCK)
        except BaseException:
            spool.close()
            raise
    return spool


def check_magic(source: Source) -> None:
    """Refuse what is not MCAP.

    Raises:
        LogError: If it is not; says what it is instead.
    """
    head = source.read(0, 64)
    # A file that is whole but for a bit of its first bytes can be read all the same.
    ends_well = source.read(max(source.size - len(MAGIC), 0), len(MAGIC)) == MAGIC
    if not head.startswith(MAGIC) and not (ends_well and head[8:9] == b"\x01"):
        raise LogError(_not_mcap(head, source.size), path=source.name)


def _not_mcap(head: bytes, size: int) -> str:
    """Say what a file is that does not begin as MCAP does."""
    if not head:
        return "is empty (0 bytes). Was the disk full, or the recording never started?"
    if MAGIC.startswith(head):
        return f"is cut off within its first bytes ({size} in all); nothing in it can be used."
    for magic, what in _OTHER_FORMATS:
        if head.startswith(magic):
            return what + "."
    if b"MCAP0" in head[:16]:
        return (
            "is an MCAP file mangled as if it were text (its line endings or bytes above 127 were "
            "converted). Copy it again in binary mode; check .gitattributes, FTP and mail settings."
        )
    if not any(head):
        return "begins with zeros instead of the MCAP magic. Was it written completely?"
    return f"is not an MCAP file (it begins with {head[:8]!r}). Give a .mcap log."


def _folder_advice(folder: Path) -> str:
    try:
        logs = sorted(entry.name for entry in folder.glob("*.mcap"))
    except OSError:
        logs = []
    if not logs:
        return "is a folder. Give a .mcap file."
    shown = ", ".join(logs[:3]) + (", ..." if len(logs) > 3 else "")
    return f"is a folder. Give one of the logs in it: {shown}."


def _reason(error: OSError) -> str:
    return (error.strerror or str(error)).lower()
