"""What every encoding offers: columns of values out of a batch of messages."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from mclass.records import BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    from mclass.logs.channels import MessageBatch

MAX_LEAVES = 10_000

# Fewer cursors than this are faster moved by plain Python than by array operations.
NARROW = 24

# A NaN of its own: one that was written, or comes of calculating, has other bits.
_ABSENT_BITS = np.int64(0x7FF8_0000_6162_7365)
ABSENT = float(_ABSENT_BITS.view(np.float64))
"""A float that a message leaves out, where its encoding can tell that from zero."""


def is_absent(values: FloatArray) -> BoolArray:
    """Which numbers stand for fields that a message left out."""
    return np.asarray(np.asarray(values, dtype=np.float64).view(np.int64) == _ABSENT_BITS)


@dataclass(frozen=True)
class Column:
    """All values of one leaf in a batch.

    Attributes:
        values: One row for each message, or each innermost element when the path has
            ``[]``. By kind: ``float`` float64, ``int`` int64 (uint64 stays unsigned), ``bool``
            bool, ``time`` int64 [ns], ``string`` and ``bytes`` objects. Numbers directly in a
            sequence (``D[]``) and fixed arrays of numbers, (n, size), keep their own width.
        offsets: One array for every ``[]`` of the path, outermost first. Elements of message
            ``i`` at the first level are ``offsets[0][i]:offsets[0][i + 1]``, and so on inwards.
    """

    values: npt.NDArray[Any]
    offsets: tuple[IntArray, ...] = ()


@dataclass(frozen=True)
class Columns:
    """The wanted leaves of a batch.

    Attributes:
        rows: Indices, in the batch, of the messages that could be decoded, (n,), increasing.
        values: A column for each wanted path; its messages are those of ``rows``.
        failures: Number of messages left out, by reason.
    """

    rows: IntArray
    values: Mapping[str, Column]
    failures: Mapping[str, int] = field(default_factory=dict)


class DamagedError(Exception):
    """Some messages of a batch contradict their schema; never leaves this package.

    ``found`` holds reasons and the indices of the messages that they apply to.
    """

    def __init__(self, found: Sequence[tuple[str, IntArray]]) -> None:
        self.found = tuple(found)
        super().__init__(", ".join(reason for reason, _ in found))

    @property
    def messages(self) -> IntArray:
        """Indices of all messages found, repeated if found twice."""
        return np.concatenate([messages for _, messages in self.found])


class CutError(Exception):
    """The reason why one message cannot be read; never leaves this package."""


def demand(sound: BoolArray, messages: IntArray, reason: str) -> None:
    """Raise ``DamagedError`` for the messages of those cursors that are not sound."""
    if not sound.all():
        raise DamagedError([(reason, messages[~sound])])


class ChannelDecoder(ABC):
    """Turns batches of one channel's messages into columns."""

    @property
    @abstractmethod
    def paths(self) -> Mapping[str, str]:
        """Kind of every leaf by its path, in the order of the schema.

        Kinds are ``float``, ``int``, ``string``, ``bool``, ``bytes`` and ``time``. A path names
        fields joined by dots, with ``[]`` behind each sequence; a fixed array of numbers is one
        leaf, as is a stamp. Durations are ``int`` [ns], enumerations ``int``.
        """

    def learn(self, batch: MessageBatch) -> None:  # noqa: B027
        """Add the paths that the schema leaves out, where messages name their own fields.

        Only JSON does; every other encoding ignores this.
        """

    def columns(self, batch: MessageBatch, wanted: Sequence[str]) -> Columns:
        """Decode the wanted leaves of all messages of a batch.

        Messages that contradict their schema are left out and counted, never an error.

        Args:
            batch: Messages of this channel.
            wanted: Keys of ``paths``.

        Raises:
            KeyError: If a wanted path is not in the schema.
        """
        known = self.paths
        for path in wanted:
            if path not in known:
                raise KeyError(path)
        rows = np.arange(len(batch.offsets), dtype=np.int64)
        failures: dict[str, int] = {}
        while True:
            try:
                values = self._decode(batch, rows, tuple(dict.fromkeys(wanted)))
            except DamagedError as damage:  # noqa: PERF203
                # A round removes at least all that fail at one place of the schema: few are needed.
                good = np.ones(len(rows), dtype=np.bool_)
                for reason, messages in damage.found:
                    fresh = np.unique(messages[good[messages]])
                    good[fresh] = False
                    failures[reason] = failures.get(reason, 0) + len(fresh)
                assert not good.all(), "damage that no message has would be looked for forever"
                rows = rows[good]
            else:
                return Columns(rows, values, {key: n for key, n in failures.items() if n})

    @abstractmethod
    def _decode(
        self, batch: MessageBatch, rows: IntArray, wanted: tuple[str, ...]
    ) -> dict[str, Column]:
        """Columns of the given messages, all of which must be sound.

        Raises:
            DamagedError: With indices into ``rows``, if any message is not.
        """
