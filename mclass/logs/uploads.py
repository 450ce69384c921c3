"""An output at a URL, that appears under its name complete or not at all."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

from mclass.errors import LogError
from mclass.logs.pending import PendingFile
from mclass.logs.source import Source
from mclass.logs.stores import Store
from mclass.places import Place, Url


def pending_file(
    output: Place, *, overwrite: bool, source: Source | None
) -> PendingFile | UploadFile:
    """What becomes the output when it is published.

    Args:
        output: Where it is to appear.
        overwrite: Whether what is there may be replaced.
        source: A log that must stay as it is.

    Raises:
        LogError: If nothing can or may be written there.
        UsageError: If what is needed for a URL is not installed.
    """
    if isinstance(output, Url):
        return UploadFile(output, overwrite=overwrite, source=source)
    return PendingFile(output, overwrite=overwrite, source=source)


class UploadFile:
    """Written to a temporary file, uploaded when it is whole; takes the calls of `PendingFile`.

    Args:
        output: Where it is to appear.
        overwrite: Whether an object that is there may be replaced.
        source: A log that must stay as it is.

    Raises:
        LogError: If nothing can or may be written there.
        UsageError: If what is needed for the URL is not installed.
    """

    def __init__(self, output: Url, *, overwrite: bool, source: Source | None) -> None:
        if source is not None and source.name == str(output):
            raise LogError(
                "is the input itself, which is never changed. Choose another output.",
                path=str(output),
            )
        self._overwrite = overwrite
        self._store = Store(output)
        self._store.check_writable()
        if not overwrite and self._store.exists():
            self._store.refuse_existing()
        self._folder = Path()
        self._file: PendingFile | None = None

    def open(self) -> None:
        """Create the temporary file.

        Raises:
            LogError: If the folder of temporary files is read-only or full.
        """
        self._folder = Path(tempfile.mkdtemp(prefix="mclass-"))
        self._file = PendingFile(self._folder / "output.mcap", overwrite=True, source=None)
        self._file.open()

    def write(self, data: bytes | bytearray | memoryview) -> None:
        """See `PendingFile.write`."""
        assert self._file is not None
        self._file.write(data)

    def copy(self, source: Source, start: int, end: int, done: Callable[[int], None]) -> None:
        """See `PendingFile.copy`."""
        assert self._file is not None
        self._file.copy(source, start, end, done)

    def publish(self) -> None:
        """Upload the file.

        Raises:
            LogError: If the disk or the store fails, or an object of that name has appeared.
        """
        assert self._file is not None
        self._file.publish()
        self._store.upload(self._folder / "output.mcap", overwrite=self._overwrite)

    def discard(self) -> None:
        """Delete the temporary file."""
        if self._file is not None:
            self._file.discard()
            self._file = None
            shutil.rmtree(self._folder, ignore_errors=True)
