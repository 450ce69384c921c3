"""A file that appears under its name complete or not at all."""

from __future__ import annotations

import atexit
import contextlib
import errno
import os
import re
import stat
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from mclass.errors import LogError
from mclass.logs.locks import take_lock
from mclass.logs.source import Source

_COPY_STEP = 1 << 26
_READ_STEP = 1 << 20
# Less than this is on the disk in no time.
_FLUSHED_EARLY = 1 << 26
_NAME_CHARACTERS = 40
_NO_HARD_LINKS = frozenset(
    {errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS, errno.EMLINK, errno.EINVAL, errno.EXDEV}
)


class PendingFile:
    """Written as ``.NAME.part-PID`` in the output's folder, renamed when it is whole.

    A killed process leaves such a hidden part file at most, never one under the output's name;
    the next run for that output removes it. Part files are locked while they are written, so
    that those of other runs at work are told from those left behind.

    Args:
        output: Where the file is to appear; a symbolic link is followed.
        overwrite: Whether a file that is there may be replaced.
        source: A log that must stay as it is.

    Raises:
        LogError: If nothing can or may be written there.
    """

    def __init__(self, output: Path, *, overwrite: bool, source: Source | None) -> None:
        self._output = output
        self._overwrite = overwrite
        self._source = source
        self._file = -1
        self._part: Path | None = None
        self._flusher: ThreadPoolExecutor | None = None
        self._flushed: Future[None] | None = None
        with self._errors():
            self._target = Path(os.path.realpath(output))
            self._check()

    def open(self) -> None:
        """Create the part file.

        Raises:
            LogError: If the folder is missing, read-only or full.
        """
        flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
        stem = f".{self._target.name[:_NAME_CHARACTERS]}.part-"
        self._remove_leftovers(stem)
        name = f"{stem}{os.getpid()}"
        # An interrupt may strike anywhere, even before the caller's `with` block has begun.
        atexit.register(self.discard)
        with self._errors():
            for attempt in range(1000):
                self._part = self._target.with_name(name + (f"-{attempt}" if attempt else ""))
                try:
                    self._file = os.open(self._part, flags, 0o666)
                except FileExistsError:
                    self._part = None
                    continue
                take_lock(self._file, wait=True)
                if os.fstat(self._file).st_nlink:
                    return
                # Another run took it for a leftover in the moment before it was locked.
                self._close()
        raise LogError(f"its folder is full of files {name}-*. Delete them.", path=self._name)

    def _remove_leftovers(self, stem: str) -> None:
        """Delete part files of this output that no run holds; what cannot be deleted stays."""
        is_part = re.compile(re.escape(stem) + r"\d+(-\d+)?")
        with contextlib.suppress(OSError):
            for part in sorted(self._target.parent.iterdir()):
                if is_part.fullmatch(part.name) and part.is_file() and not part.is_symlink():
                    file = os.open(part, os.O_RDWR)
                    try:
                        if take_lock(file, wait=False):
                            part.unlink()
                    finally:
                        os.close(file)

    def write(self, data: bytes | bytearray | memoryview) -> None:
        """Append bytes.

        Raises:
            LogError: If the disk is full or fails.
        """
        view = memoryview(data)
        with self._errors():
            while view:
                view = view[os.write(self._file, view) :]

    def copy(self, source: Source, start: int, end: int, done: Callable[[int], None]) -> None:
        """Append a range of bytes of a log, inside the kernel where it can.

        Args:
            source: The log.
            start: First byte.
            end: Byte after the last one.
            done: Called now and then with the place reached.

        Raises:
            LogError: If the disk is full or fails, or the log lost bytes in the meantime.
        """
        source.expect([(start, end)])
        position = start
        while position < end and (copied := self._copy_in_kernel(source, position, end)):
            position += copied
            done(position)
        while position < end:
            block = source.read(position, min(_READ_STEP, end - position))
            if not block:
                raise LogError("became shorter while it was copied.", path=source.name)
            self.write(block)
            position += len(block)
            done(position)
        if end - start >= _FLUSHED_EARLY and self._flusher is None:
            # The disk works while what follows is computed, not only at the end.
            self._flusher = ThreadPoolExecutor(max_workers=1)
            self._flushed = self._flusher.submit(os.fsync, self._file)

    def publish(self) -> None:
        """Flush everything to the disk and give the file its name.

        Raises:
            LogError: If the disk is full or fails, or a file of that name has appeared.
        """
        assert self._part is not None
        with self._errors():
            if self._flushed is not None:
                # What fails to reach the disk is told once, to whoever asks first.
                self._flushed.result()
            os.fsync(self._file)
            self._close()
            self._check()
            if self._overwrite:
                os.replace(self._part, self._target)
            else:
                self._link()
        self._sync_folder()

    def discard(self) -> None:
        """Remove the part file, if there still is one."""
        self._close()
        if self._part is not None:
            with contextlib.suppress(OSError):
                os.unlink(self._part)
            self._part = None
        atexit.unregister(self.discard)

    @property
    def _name(self) -> str:
        return str(self._output)

    def _check(self) -> None:
        """Refuse an output that is the input, a folder, a device, or there already."""
        if not self._target.parent.is_dir():
            folder = self._target.parent
            raise LogError(f"there is no folder {folder}. Create it first.", path=self._name)
        try:
            found = os.stat(self._target)
        except FileNotFoundError:
            return
        descriptor = None if self._source is None else self._source.descriptor
        if descriptor is not None and os.path.samestat(found, os.fstat(descriptor)):
            raise LogError(
                "is the input itself, which is never changed. Choose another output.",
                path=self._name,
            )
        if not stat.S_ISREG(found.st_mode):
            raise LogError("is there and no file. Choose another output.", path=self._name)
        if not self._overwrite:
            self._refuse_existing()

    def _refuse_existing(self) -> None:
        raise LogError(
            "exists already. Choose another output, or add --overwrite.", path=self._name
        )

    def _link(self) -> None:
        """Give the file its name unless another has it: a link fails then, a rename would not."""
        assert self._part is not None
        try:
            os.link(self._part, self._target)
        except FileExistsError:
            self._refuse_existing()
        except OSError as error:
            if error.errno not in _NO_HARD_LINKS:
                raise
            os.rename(self._part, self._target)

    def _copy_in_kernel(self, source: Source, position: int, end: int) -> int:
        """Bytes copied; 0 where the system cannot do it."""
        if source.descriptor is None or not hasattr(os, "copy_file_range"):
            return 0
        count = min(_COPY_STEP, end - position)
        try:
            return os.copy_file_range(source.descriptor, self._file, count, offset_src=position)
        except OSError as error:
            if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EFBIG):
                raise self._as_log_error(error) from error
            return 0

    def _close(self) -> None:
        if self._flusher is not None:
            self._flusher.shutdown()
            self._flusher = None
        if self._file >= 0:
            file, self._file = self._file, -1
            os.close(file)

    def _sync_folder(self) -> None:
        # Some file systems cannot; the file itself is safe by then.
        with contextlib.suppress(OSError):
            folder = os.open(self._target.parent, os.O_RDONLY)
            try:
                os.fsync(folder)
            finally:
                os.close(folder)

    @contextlib.contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise self._as_log_error(error) from error
        except ValueError as error:
            raise LogError(f"cannot be a file name: {error}.", path=self._name) from error

    def _as_log_error(self, error: OSError) -> LogError:
        advice = {
            errno.ENOSPC: " Make room on the disk or choose another output.",
            errno.EDQUOT: " Your quota is used up; choose another output.",
            errno.EACCES: " Choose an output in a folder that you may write to.",
            errno.EROFS: " Choose an output on another disk.",
        }.get(error.errno or 0, "")
        reason = (error.strerror or str(error)).lower()
        return LogError(f"cannot be written: {reason}.{advice}", path=self._name)
