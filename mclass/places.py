"""Where a log is: a file, or a URL that is handled like a path and never shows what is secret."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import TypeAlias
from urllib.parse import unquote

_URL = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+)://(.*)", re.DOTALL)
_WEB = ("http", "https")


@dataclass(frozen=True)
class Url:
    """A log, an output or a folder of them in a store.

    As text it has neither user nor password nor query: those of signed web addresses let
    whoever reads them in.

    Attributes:
        address: All of it, for those who open it.
    """

    address: str = field(repr=False)

    @property
    def scheme(self) -> str:
        """``s3``, ``gs``, ``https``, ..."""
        return self.address.partition("://")[0].lower()

    @property
    def name(self) -> str:
        """The last part of its path."""
        name = self._split()[1].rstrip("/").rpartition("/")[2]
        return unquote(name) if self.scheme in _WEB else name

    @property
    def stem(self) -> str:
        """The name without its suffix."""
        return PurePosixPath(self.name).stem

    def with_name(self, name: str) -> Url:
        """Another one in the same folder."""
        server, path, _ = self._split()
        folder = path.rstrip("/").rpartition("/")[0]
        return Url(f"{self.scheme}://{server}{folder}/{name}")

    def __truediv__(self, name: str) -> Url:
        """One in this folder."""
        server, path, _ = self._split()
        return Url(f"{self.scheme}://{server}{path.rstrip('/')}/{name}")

    def __str__(self) -> str:
        server, path, query = self._split()
        shown = server.rpartition("@")[2]
        return f"{self.scheme}://{shown}{path}" + ("?..." if query else "")

    def _split(self) -> tuple[str, str, str]:
        """Server or bucket, path, and what stands behind it in a web address."""
        rest, query = self.address.partition("://")[2], ""
        # In other stores these signs are part of names.
        if self.scheme in _WEB and (end := re.search(r"[?#]", rest)) is not None:
            rest, query = rest[: end.start()], rest[end.start() :]
        server, slash, path = rest.partition("/")
        return server, slash + path, query


Place: TypeAlias = "Path | Url"
"""A file or a URL; both have a name, a stem and neighbours."""

PlaceLike: TypeAlias = "str | os.PathLike[str] | Url"
"""What becomes a place by `place_of`."""


def place_of(value: PlaceLike) -> Place:
    """A URL if it looks like one (``scheme://...``), else a path."""
    if isinstance(value, Url):
        return value
    text = os.fspath(value)
    if isinstance(value, str) and _URL.fullmatch(text):
        return Url(text)
    return Path(text)
