"""Messages behind a second, different definition of their channel or its schema.

A log that was joined carelessly uses the ids of its parts twice. A reader keeps one definition
of each id, and would decode the messages of the other part by it: plausible nonsense. Messages
belong to the last definition before them in the file.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Sequence, Set

import numpy as np
from mcap.opcode import Opcode

from mclass.logs.chunks import ChunkContent, ChunkEntry
from mclass.logs.damage import Damage
from mclass.logs.record_index import LogIndex, Mark
from mclass.logs.wire import MalformedError
from mclass.records import BoolArray


class Redefinitions:
    """Follows the definitions through one pass over a log's chunks, in file order.

    Args:
        index: Of the log, with the definitions in use.
        damage: Where the messages are counted as lost.
        wanted: Channels of which that is a loss.
    """

    def __init__(self, index: LogIndex, damage: Damage, wanted: Set[int]) -> None:
        self._index = index
        self._damage = damage
        self._wanted = wanted
        self._ahead = list(reversed(index.marks))
        self._other: set[tuple[Opcode, int]] = set()

    def foreign(self, entry: ChunkEntry, content: ChunkContent) -> BoolArray | None:
        """Which messages of the next chunk are not of the channel that their id names.

        Args:
            entry: The chunk.
            content: What it holds.

        Returns:
            True for these, (n,); None if there is none.
        """
        while self._ahead and self._ahead[-1].place < entry.offset:
            self._follow(self._ahead.pop())
        marks = self._marks(content)
        if not self._other and all(mark.in_use for mark in marks):
            return None
        channels = content.heads["channel"]
        foreign = np.zeros(len(channels), dtype=np.bool_)
        begin = 0
        for mark in marks:
            end = int(np.searchsorted(content.starts, mark.place))
            foreign[begin:end] = np.isin(channels[begin:end], self._channels())
            self._follow(mark)
            begin = end
        foreign[begin:] = np.isin(channels[begin:], self._channels())
        self._lose(entry, channels[foreign].tolist())
        return foreign if foreign.any() else None

    def _lose(self, entry: ChunkEntry, channels: Sequence[int]) -> None:
        for channel_id, count in sorted(Counter(channels).items()):
            if channel_id in self._wanted:
                topic = self._index.channels[channel_id].topic
                reason = f"the channel of {topic} is defined a second time, as another one"
                self._damage.lose(reason, entry.offset, messages=count)

    def _marks(self, content: ChunkContent) -> Sequence[Mark]:
        """Of the definitions in a chunk; broken ones define nothing."""
        marks = []
        for start in content.definitions:
            with contextlib.suppress(MalformedError):
                marks.append(self._index.mark(start, content.record(start)))
        return marks

    def _follow(self, mark: Mark) -> None:
        if mark.in_use:
            self._other.discard((mark.opcode, mark.id))
        else:
            self._other.add((mark.opcode, mark.id))

    def _channels(self) -> list[int]:
        """Ids whose last definition is not the one in use."""
        return [
            channel.id
            for channel in self._index.channels.values()
            if (Opcode.CHANNEL, channel.id) in self._other
            or (Opcode.SCHEMA, channel.schema_id) in self._other
        ]
