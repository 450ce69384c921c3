"""What is at a URL, by fsspec: its size and version, ranges of its bytes, logs below it.

fsspec and what it needs for each kind of store are loaded when a URL is used. They take
credentials from where other tools of the store take them: environment, settings, roles. Their
errors come in many kinds and may quote an address with its signature, so none of their text is
passed on.
"""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

from mclass.errors import LogError, UsageError
from mclass.places import Place, Url

_WEB = ("http", "https")
LISTED = ("s3", "gs")
"""Kinds of stores that tell what they hold."""
_ATTEMPTS = 3
_PAUSE_S = 0.3
_PART_BYTES = 1 << 23
_MAX_PARTS = 9_000
_CREDENTIALS = {
    "s3": "AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, a profile, or FSSPEC_S3_ANON=true for what "
    "is public",
    "gs": "GOOGLE_APPLICATION_CREDENTIALS or `gcloud auth application-default login`",
}
_NO_CREDENTIALS = frozenset(
    {"NoCredentialsError", "PartialCredentialsError", "DefaultCredentialsError", "RefreshError"}
)
_CHATTERERS = ("aiobotocore", "botocore", "fsspec", "gcsfs", "google", "s3fs")

Answer = TypeVar("Answer")


class StoreError(LogError):
    """A store does not do what it was asked for: not a fault of the log's bytes."""


@dataclass(frozen=True)
class Facts:
    """What a store says of one object.

    Attributes:
        size: Bytes; None if it does not say.
        version: Differs when the content does; empty if the store tells nothing of the kind.
        has_ranges: Whether parts can be had.
    """

    size: int | None
    version: str
    has_ranges: bool


class Store:
    """The place of one URL.

    Args:
        url: Of an object or a folder.

    Raises:
        LogError: If its scheme is not known.
        UsageError: If what is needed for it is not installed.
    """

    def __init__(self, url: Url) -> None:
        self._url = url
        self._name = str(url)
        if url.scheme not in (*LISTED, *_WEB):
            raise StoreError(
                f"{url.scheme}:// is no known kind of URL; known: s3://, gs://, https://, http://.",
                path=self._name,
            )
        for name in _CHATTERERS:
            # Python prints warnings that nobody handles; errors are told in our own words.
            if not (logger := logging.getLogger(name)).handlers:
                logger.addHandler(logging.NullHandler())
        options: dict[str, Any] = {"use_listings_cache": False}
        if url.scheme in _WEB:
            # Of what is compressed on the way, ranges would be those of the compressed bytes.
            options["headers"] = {"Accept-Encoding": "identity"}
        try:
            fsspec = import_module("fsspec")
            self._asyn = import_module("fsspec.asyn")
            with self._errors():
                self._files: Any = fsspec.filesystem(url.scheme, **options)
        except ImportError:
            raise UsageError(f"{url}: URLs need more: pip install 'mclass[cloud]'") from None
        self._path: str = self._files._strip_protocol(url.address)

    def facts(self) -> Facts:
        """Size and version of an object.

        Raises:
            StoreError: If there is none, or it may not be read.
        """
        if self._url.scheme in _WEB:
            facts: Facts = self._try(lambda: self._asyn.sync(self._files.loop, self._web_facts))
            return facts
        found = self._try(lambda: self._files.info(self._path))
        if found["type"] != "file":
            raise StoreError("is a folder. Give a .mcap log.", path=self._name)
        tag = found.get("ETag") or found.get("etag") or ""
        return Facts(found["size"], f"etag:{tag}" if tag else "", has_ranges=True)

    def exists(self) -> bool:
        """Whether an object is there.

        Raises:
            StoreError: If that cannot be found out.
        """
        return bool(self._try(lambda: self._files.isfile(self._path)))

    def read(self, start: int, stop: int) -> bytes:
        """A range of an object's bytes.

        Raises:
            StoreError: If the store fails, or gives another number of bytes.
        """
        data: bytes = self._try(lambda: self._files.cat_file(self._path, start=start, end=stop))
        if len(data) != stop - start:
            raise StoreError(
                f"{len(data):,} bytes came where {stop - start:,} were asked for; "
                "it changed while it was read.",
                path=self._name,
            )
        return data

    def read_whole(self) -> bytes:
        """All bytes of a small object.

        Raises:
            StoreError: If the store fails.
        """
        data: bytes = self._try(lambda: self._files.cat_file(self._path))
        return data

    def download(self, file: Path) -> None:
        """Copy an object to a file.

        Raises:
            StoreError: If the store or the disk fails.
        """
        self._try(lambda: self._files.get_file(self._path, str(file)))

    def check_writable(self) -> None:
        """Refuse early what an upload would come to grief on.

        Raises:
            StoreError: If it is read-only, or its bucket is missing.
        """
        if self._url.scheme in _WEB:
            raise StoreError("can only be read. Write to a file, s3:// or gs://.", path=self._name)
        bucket, _, key = self._path.partition("/")
        if not bucket or not key or key.endswith("/"):
            raise StoreError("names no object. Give s3://BUCKET/NAME.mcap.", path=self._name)
        try:
            self._files.info(bucket)
        except FileNotFoundError:
            raise StoreError(
                f"there is no bucket {bucket}. Create it first.", path=self._name
            ) from None
        except Exception:
            # One may be allowed to write to a bucket and not to look at it.
            return

    def upload(self, file: Path, *, overwrite: bool) -> None:
        """Make a file the object, whole or not at all.

        Raises:
            StoreError: If the store fails, or an object has appeared that may not be replaced.
        """
        part = max(_PART_BYTES, file.stat().st_size // _MAX_PARTS)
        # Parts of Google's uploads come in multiples of this.
        part += -part % (1 << 18)
        mode = "overwrite" if overwrite else "create"
        with self._errors():
            try:
                self._files.put_file(str(file), self._path, chunksize=part, mode=mode)
            except FileExistsError:
                self.refuse_existing()

    def refuse_existing(self) -> None:
        """Say that the output is there."""
        raise StoreError(
            "exists already. Choose another output, or add --overwrite.", path=self._name
        )

    def find(self) -> list[Url]:
        """All objects in a folder and below, sorted; the object itself if it is none.

        Raises:
            StoreError: If the store cannot list, or fails.
        """
        return self._urls("find")

    def match(self) -> list[Url]:
        """All objects that a pattern stands for, sorted.

        Raises:
            StoreError: If the store cannot list, or fails.
        """
        return self._urls("glob")

    def children(self) -> list[Url]:
        """What is in a folder itself, sorted; nothing if it is not there.

        Raises:
            StoreError: If the store cannot list, or fails.
        """
        return self._urls("ls", detail=False)

    def _urls(self, method: str, **options: Any) -> list[Url]:
        if self._url.scheme in _WEB:
            raise StoreError("cannot be listed. Name its logs one by one.", path=self._name)
        try:
            names = self._try(lambda: getattr(self._files, method)(self._path, **options))
        except MissingError:
            return []
        return [Url(f"{self._url.scheme}://{name}") for name in sorted(names)]

    async def _web_facts(self) -> Facts:
        """Ask for one byte: that tells whether parts are sent, and signatures allow it."""
        session = await self._files.set_session()
        address = self._files.encode_url(self._url.address)
        headers = {"Range": "bytes=0-0", "Accept-Encoding": "identity"}
        async with session.get(address, headers=headers) as reply:
            if reply.status == 416:
                return Facts(0, "", has_ranges=True)
            reply.raise_for_status()
            version = reply.headers.get("ETag") or reply.headers.get("Last-Modified") or ""
            whole = reply.headers.get("Content-Range", "").rpartition("/")[2]
            return Facts(
                int(whole) if whole.isdigit() else None,
                f"etag:{version}" if version else "",
                has_ranges=reply.status == 206 and whole.isdigit(),
            )

    def _try(self, ask: Callable[[], Answer]) -> Answer:
        """An answer; asked again where another attempt may help."""
        for attempt in range(_ATTEMPTS - 1):
            try:
                return ask()
            except Exception as error:  # noqa: PERF203 (seldom)
                if _is_final(error):
                    break
                time.sleep(_PAUSE_S * 4**attempt)
        with self._errors():
            return ask()

    @contextlib.contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except (ImportError, LogError, UsageError):
            raise
        except Exception as error:
            raise self._as_store_error(error) from None

    def _as_store_error(self, error: Exception) -> StoreError:
        status = getattr(error, "status", None)
        if isinstance(error, FileNotFoundError) or status in (404, 410):
            return MissingError("is not there. Check bucket and name.", path=self._name)
        if isinstance(error, PermissionError) or status in (401, 403):
            return StoreError(f"access is denied. {self._advice()}", path=self._name)
        if type(error).__name__ in _NO_CREDENTIALS:
            return StoreError(f"there are no credentials. {self._advice()}", path=self._name)
        if isinstance(error, OSError) and error.errno == 28:
            return StoreError(
                "there is no room on the disk; TMPDIR says where temporary files go.",
                path=self._name,
            )
        reason = f"status {status}" if status is not None else _words(type(error).__name__)
        return StoreError(
            f"cannot be reached: {reason}. Check address and network.", path=self._name
        )

    def _advice(self) -> str:
        known = _CREDENTIALS.get(self._url.scheme)
        return f"Set {known}." if known else "Check the address and its signature."


class MissingError(StoreError):
    """Nothing is there."""


def size_of(place: Place) -> int | None:
    """Bytes in a file or object; None if there is none, or its store does not say.

    Raises:
        StoreError: If the store fails.
    """
    if isinstance(place, Url):
        try:
            return Store(place).facts().size
        except MissingError:
            return None
    with contextlib.suppress(OSError):
        return place.stat().st_size
    return None


def content_of(place: Place) -> bytes:
    """All bytes of a small file or object.

    Raises:
        StoreError: If the store fails, or nothing is there.
        OSError: If the file cannot be read.
    """
    return Store(place).read_whole() if isinstance(place, Url) else place.read_bytes()


def _is_final(error: Exception) -> bool:
    """Whether the same question will get the same answer."""
    status = getattr(error, "status", None)
    return (
        isinstance(error, (FileNotFoundError, PermissionError, ImportError, StoreError))
        or type(error).__name__ in _NO_CREDENTIALS
        or (status is not None and status < 500)
    )


def _words(name: str) -> str:
    """``connection timeout`` of ``ConnectionTimeoutError``."""
    spaced = "".join(f" {sign.lower()}" if sign.isupper() else sign for sign in name)
    return spaced.strip().removesuffix(" error")
