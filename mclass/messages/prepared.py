"""Message values whose encoding is kept for the next message that holds them."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
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

    def encoded(self, key: Hashable, encode: Callable[[Value], bytes]) -> bytes:
        """Bytes under ``key``, which names everything but the value that they depend on."""
        data = self._encoded.get(key)
        if data is None:
            data = self._encoded[key] = encode(self.value)
        return data
