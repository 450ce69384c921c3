"""Message values whose encoding is kept for the next message that holds them."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from typing import Any, TypeAlias

Value: TypeAlias = Mapping[str, Any]
"""A message as field name to value; fields left out are zero, empty or false."""


class Prepared:
    """A nested message that many messages repeat unchanged.

    Every update of one object publishes all objects again; with this each is encoded when it
    changes, not when another one does. Encoders accept it wherever they accept a `Value`.
    """

    def __init__(self, value: Value) -> None:
        self.value = value
        self._encoded: dict[Hashable, bytes] = {}

    def encoded(self, key: Hashable) -> bytes | None:
        """Bytes kept under ``key``, which names everything but the value that they depend on."""
        return self._encoded.get(key)

    def keep(self, key: Hashable, data: bytes) -> bytes:
        """Keep bytes under ``key``; returns them."""
        self._encoded[key] = data
        return data
