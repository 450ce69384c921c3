"""Finding records by their looks: which bytes can be one, and where the next one begins."""

from __future__ import annotations

import re
from collections.abc import Callable

from mcap.opcode import Opcode

from mclass.logs.source import Source
from mclass.logs.wire import (
    CHUNK_HEAD,
    MESSAGE_HEAD,
    RECORD_HEAD,
    MalformedError,
    parse_chunk_head,
)

PEEK = RECORD_HEAD + CHUNK_HEAD + 32
"""Enough bytes to judge a record by."""
PRIVATE_OPCODES = 0x80
"""From here on kinds of records belong to applications."""

_SEARCH_BLOCK = 1 << 20
_CANDIDATE = re.compile(rb"[\x03-\x0d\x0f][\x00-\xff]{5}\x00{3}")
_ZEROS = bytes(_SEARCH_BLOCK + RECORD_HEAD)
_CHAIN = 3
_MAX_TRIES = 200_000


class RecordFinder:
    """Tells records from other bytes before ``end``."""

    def __init__(self, source: Source, end: int) -> None:
        self._source = source
        self._end = end
        self._tries = _MAX_TRIES

    def span(self, position: int) -> tuple[int, int] | None:
        """Opcode of the record at ``position`` and where the next begins; None if it is none."""
        return self._span(position, self._source.peek)

    def resync(self, position: int) -> int | None:
        """The first place after ``position`` where records begin again.

        The search gives up after many false starts, so that its time stays bounded.
        """
        for base in range(position + 1, self._end, _SEARCH_BLOCK):
            block = self._source.read(base, _SEARCH_BLOCK + RECORD_HEAD - 1)
            # Files often end in zeros for gigabytes; comparing is much faster than searching.
            if block == _ZEROS[: len(block)]:
                continue
            at = 0
            while match := _CANDIDATE.search(block, at):
                if self._tries == 0:
                    return None
                self._tries -= 1
                if self._begins(base + match.start()):
                    return base + match.start()
                at = match.start() + 1
        return None

    def _begins(self, position: int) -> bool:
        """Whether so many records follow one another here that it cannot be chance."""
        for _ in range(_CHAIN):
            span = self._span(position, self._source.read)
            if span is None:
                return False
            opcode, position = span
            # The sizes in a chunk's head agreeing is proof enough, and so is the end mark.
            if opcode in (Opcode.CHUNK, Opcode.DATA_END):
                return True
        return True

    def _span(self, position: int, look: Callable[[int, int], bytes]) -> tuple[int, int] | None:
        start = look(position, PEEK)
        if len(start) < RECORD_HEAD:
            return None
        opcode = start[0]
        length = int.from_bytes(start[1:RECORD_HEAD], "little")
        following = position + RECORD_HEAD + length
        if following > self._end or not _possible(opcode, length, start):
            return None
        return opcode, following


def _possible(opcode: int, length: int, start: bytes) -> bool:  # noqa: PLR0911 (one a kind)
    """Whether a record can begin so."""
    if opcode == Opcode.MESSAGE:
        return length >= MESSAGE_HEAD - RECORD_HEAD
    if opcode == Opcode.MESSAGE_INDEX:
        entries = int.from_bytes(start[RECORD_HEAD + 2 : RECORD_HEAD + 6], "little")
        return length == 6 + entries and entries % 16 == 0
    if opcode == Opcode.CHUNK:
        try:
            parse_chunk_head(start)
        except MalformedError:
            return False
        return True
    if opcode == Opcode.DATA_END:
        return length >= 4
    if opcode == Opcode.FOOTER:
        return length >= 20
    return Opcode.HEADER <= opcode <= Opcode.DATA_END or opcode >= PRIVATE_OPCODES
