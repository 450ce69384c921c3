"""Appending to a log itself, so that a crash at any byte leaves it restorable.

New data goes where the data section of a log ends, over its summary. Before the first byte is
changed, everything from there on is saved in a journal beside the log, ``.NAME.journal``, and
flushed to the disk. The journal is deleted when the longer log is whole and on the disk:

- no journal: the log is whole, either the old or the new one;
- a journal that is not whole: the log is still the old one;
- a whole journal: the log is restored from it, the next time one of our commands opens the log,
  or at once when the run fails.

The journal is locked while a run is at work, so that no other takes it for left behind.
"""

from __future__ import annotations

import contextlib
import os
import stat
import struct
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

from mclass.errors import LogError
from mclass.logs.locks import take_lock

_MAGIC = b"mclass journal 1\n"
_HEAD = struct.Struct("<QQIII")
"""Where the saved tail begins, size of the log; checksums of the tail, and of the log's bytes at
its beginning and before the tail."""

_COMPARED = 1 << 16
_BLOCK = 1 << 20


def journal_of(log: Path) -> Path:
    """The journal's path for a log's real path."""
    return log.with_name(f".{log.name}.journal")


class InPlaceFile:
    """The log itself, open for more; takes the calls of `mclass.logs.pending.PendingFile`.

    What is already in the log is not written: up to the end of its data, writes and copies must
    be what stands there.

    Args:
        log: Path of the log; a symbolic link is followed.
        data_end: Where its data section ends.

    Raises:
        LogError: If it cannot be written to.
    """

    def __init__(self, log: Path, data_end: int) -> None:
        self._name = str(log)
        self._log = Path(os.path.realpath(log))
        self._journal = journal_of(self._log)
        self._data_end = data_end
        self._position = 0
        self._file = self._held = -1
        with _errors(self._name):
            if not stat.S_ISREG(os.stat(self._log).st_mode):
                raise LogError("is no file; --in-place needs one.", path=self._name)

    def open(self) -> None:
        """Save the log's end in the journal.

        Raises:
            LogError: If the log or its folder cannot be written to, or the disk is full.
        """
        with _errors(self._name):
            self._file = os.open(self._log, os.O_RDWR | getattr(os, "O_BINARY", 0))
            size = os.fstat(self._file).st_size
            tail = _read(self._file, self._data_end, size)
            head = _HEAD.pack(
                self._data_end, size, zlib.crc32(tail), *_fingerprint(self._file, self._data_end)
            )
            try:
                flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
                self._held = os.open(self._journal, flags, 0o666)
            except FileExistsError:
                raise _busy(self._name) from None
            take_lock(self._held, wait=True)
            if not os.fstat(self._held).st_nlink:
                raise _busy(self._name)
            _write(self._held, _MAGIC + head + tail)
            os.fsync(self._held)
            _sync_folder(self._journal)

    def write(self, data: bytes | bytearray | memoryview) -> None:
        """Append bytes.

        Raises:
            LogError: If the disk is full or fails.
        """
        if self._position >= self._data_end:
            with _errors(self._name):
                os.lseek(self._file, self._position, os.SEEK_SET)
                _write(self._file, data)
        self._position += len(data)

    def copy(self, source: object, start: int, end: int, done: Callable[[int], None]) -> None:
        """Pass over bytes that stand in the log already."""
        assert start == self._position
        assert end <= self._data_end
        self._position = end
        done(end)

    def publish(self) -> None:
        """Flush everything to the disk and let go of the old end.

        Raises:
            LogError: If the disk is full or fails.
        """
        with _errors(self._name):
            os.ftruncate(self._file, self._position)
            os.fsync(self._file)
            self._close_log()
            _delete(self._journal)
        self._close_journal()

    def discard(self) -> None:
        """Restore the log unless it was published."""
        self._close_log()
        if self._held >= 0:
            with contextlib.suppress(LogError):
                if self._journal.exists():
                    _restore(self._log, self._journal, self._name)
            self._close_journal()

    def _close_log(self) -> None:
        if self._file >= 0:
            file, self._file = self._file, -1
            os.close(file)

    def _close_journal(self) -> None:
        if self._held >= 0:
            held, self._held = self._held, -1
            os.close(held)


def recover(path: str | os.PathLike[str]) -> bool:
    """Restore a log that a run with ``--in-place`` left unfinished.

    Args:
        path: The log; a symbolic link is followed.

    Returns:
        Whether there was anything to restore.

    Raises:
        LogError: If a run is still at work on it, or it cannot be restored.
    """
    name = os.fspath(path)
    log = Path(os.path.realpath(path))
    journal = journal_of(log)
    if not os.path.lexists(journal):
        return False
    with _errors(name):
        try:
            held = os.open(journal, os.O_RDWR)
        except FileNotFoundError:
            return False
        try:
            if not take_lock(held, wait=False):
                raise _busy(name)
            # The run may have ended well in the moment before its lock was taken.
            if os.path.lexists(journal):
                _restore(log, journal, name)
        finally:
            os.close(held)
    return True


def _restore(log: Path, journal: Path, name: str) -> None:
    """Put the saved end back in its place and delete the journal."""
    with _errors(name):
        saved = journal.read_bytes()
        start = len(_MAGIC) + _HEAD.size
        # The log is only touched once its journal is whole.
        if len(saved) < start or not saved.startswith(_MAGIC):
            _delete(journal)
            return
        tail = saved[start:]
        data_end, size, tail_crc, *compared = _HEAD.unpack(saved[len(_MAGIC) : start])
        if len(tail) != size - data_end or zlib.crc32(tail) != tail_crc:
            _delete(journal)
            return
        file = os.open(log, os.O_RDWR | getattr(os, "O_BINARY", 0))
        try:
            if _fingerprint(file, data_end) != tuple(compared):
                raise _foreign(journal, name)
            os.lseek(file, data_end, os.SEEK_SET)
            _write(file, tail)
            os.ftruncate(file, size)
            os.fsync(file)
        finally:
            os.close(file)
        _delete(journal)


def _delete(journal: Path) -> None:
    os.unlink(journal)
    _sync_folder(journal)


def _fingerprint(file: int, data_end: int) -> tuple[int, int]:
    """Checksums of the log's beginning and of what stands before its tail."""
    first = _read(file, 0, min(_COMPARED, data_end))
    last = _read(file, max(0, data_end - _COMPARED), data_end)
    return zlib.crc32(first), zlib.crc32(last)


def _busy(name: str) -> LogError:
    return LogError(
        "is being written to by another run with --in-place. Wait until it has ended.", path=name
    )


def _foreign(journal: Path, name: str) -> LogError:
    return LogError(
        f"has a journal {journal.name} of an unfinished run with --in-place beside it, but the "
        "journal was made for other content. Put the log and the journal that belong together "
        "back, or delete the journal if the log is as it should be.",
        path=name,
    )


def _read(file: int, start: int, end: int) -> bytes:
    os.lseek(file, start, os.SEEK_SET)
    blocks = []
    while start < end and (block := os.read(file, min(_BLOCK, end - start))):
        blocks.append(block)
        start += len(block)
    return b"".join(blocks)


def _write(file: int, data: bytes | bytearray | memoryview) -> None:
    view = memoryview(data)
    while view:
        view = view[os.write(file, view) :]


def _sync_folder(path: Path) -> None:
    # Some file systems cannot; the file itself is safe by then.
    with contextlib.suppress(OSError):
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


@contextlib.contextmanager
def _errors(name: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise LogError(
            f"cannot be written in place: {reason}. Write a copy instead, without --in-place.",
            path=name,
        ) from error
