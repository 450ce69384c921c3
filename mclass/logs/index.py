"""Where everything in a log is: from its summary when that proves right, else by looking.

A walk goes along the records of the data section. With a summary it jumps over the chunks
that this lists, so it touches a few bytes only, and yet everything between the magic and the
end of the data is accounted for: a chunk that the summary forgot is found in a gap, one that
it invents is met out of step. Whatever contradicts sends the walk through the whole file
without the summary.
"""

from __future__ import annotations

from mclass.logs.chunks import (
    ChunkContent,
    ChunkEntry,
    ChunkLostError,
    IndexLiesError,
    Kind,
    State,
    read_chunk,
)
from mclass.logs.damage import Damage
from mclass.logs.record_index import LogIndex
from mclass.logs.source import Source
from mclass.logs.summary import Summary, read_summary
from mclass.logs.walk import UntrustedSummaryError, Walk
from mclass.logs.wire import MalformedError


def load_index(source: Source) -> tuple[LogIndex, Damage]:
    """Index of a log, by its summary if that is there and right, and what is wrong with it."""
    damage = Damage()
    try:
        summary = read_summary(source)
    except MalformedError as error:
        damage.remark(f"the summary is unusable ({error}); the log was indexed by reading it")
        return scan_index(source, damage, None), damage
    if summary is None:
        return scan_index(source, damage, None), damage
    try:
        return _trusting(source, damage, summary), damage
    except (UntrustedSummaryError, IndexLiesError) as error:
        why = str(error) or "a chunk is not what it says"
        # What a wrong summary made look damaged need not be so.
        damage = Damage()
        damage.remark(f"the summary is wrong ({why}); the log was indexed by reading it")
        return scan_index(source, damage, summary), damage


def scan_index(source: Source, damage: Damage, summary: Summary | None) -> LogIndex:
    """Index of a log without trusting its summary, whose definitions only fill gaps."""
    index = Walk(source, damage, None).walk()
    if summary is not None:
        index.statistics = summary.statistics
    _complete(source, index, damage)
    if summary is not None:
        index.add_definitions(summary)
    _count_undefined(index, damage)
    _say_contradiction(index, damage)
    return index


def _trusting(source: Source, damage: Damage, summary: Summary) -> LogIndex:
    index = Walk(source, damage, summary).walk()
    _complete(source, index, damage)
    if contradiction := _contradiction(index):
        raise UntrustedSummaryError(contradiction)
    _count_undefined(index, damage)
    return index


def use_content(entry: ChunkEntry, content: ChunkContent, damage: Damage) -> None:
    """Learn from a chunk that was read what its index did not tell."""
    counts = content.counts()
    if entry.index_offsets and not (content.indexed and counts == entry.counts):
        damage.remark("the message indexes of a chunk are wrong", entry.offset)
    if not keeps_times(entry, content):
        damage.remark("a chunk holds messages outside of the times that it states", entry.offset)
    entry.counts = counts
    if entry.kind is Kind.CUT and len(content.heads):
        times = content.heads["log_time"]
        entry.start_time, entry.end_time = int(times.min()), int(times.max())
    elif content.unusable and entry.kind is not Kind.CUT:
        entry.state = State.RAGGED
        damage.lose("records in this chunk are broken", entry.offset, chunks=1)


def keeps_times(entry: ChunkEntry, content: ChunkContent) -> bool:
    """Whether the messages of a chunk lie within the times that it states."""
    if entry.kind is Kind.CUT or not len(content.heads):
        return True
    times = content.heads["log_time"]
    return bool(times.min() >= entry.start_time and times.max() <= entry.end_time)


def lose_chunk(entry: ChunkEntry, error: ChunkLostError, damage: Damage) -> None:
    """Count a whole chunk as lost."""
    entry.lost = True
    if error.broken:
        entry.state = State.BROKEN
    n_bytes, messages = entry.length, entry.messages
    damage.lose(str(error), entry.offset, chunks=1, n_bytes=n_bytes, messages=messages)


def _complete(source: Source, index: LogIndex, damage: Damage) -> None:
    """Open the chunks whose messages or channels are still unknown."""
    statistics = index.statistics
    all_defined = (
        index.summarised
        and statistics is not None
        and statistics.channel_count == len(index.channels)
        and statistics.schema_count == len(index.schemas)
    )
    unopened = []
    for entry in index.chunks:
        known = all_defined if entry.counts is None else all(map(index.defines, entry.counts))
        if known:
            unopened.append(entry)
        else:
            _define_from(source, index, entry, damage)
    # A definition may stand in an earlier chunk, which holds no message of its channel.
    missing = {key for entry in index.chunks for key in entry.counts or ()}
    while missing := {key for key in missing if not index.defines(key)}:
        if not unopened:
            break
        _define_from(source, index, unopened.pop(), damage)


def _define_from(source: Source, index: LogIndex, entry: ChunkEntry, damage: Damage) -> None:
    """Open a chunk and take over what it defines."""
    try:
        content = read_chunk(source, entry)
    except ChunkLostError as error:
        lose_chunk(entry, error, damage)
        return
    index.define(content)
    use_content(entry, content, damage)


def _count_undefined(index: LogIndex, damage: Damage) -> None:
    for entry in index.chunks:
        counts = entry.counts or {}
        undefined = sum(count for key, count in counts.items() if key not in index.channels)
        if undefined and not entry.lost:
            reason = "nothing in the file defines the channel of these messages"
            damage.lose(reason, entry.offset, messages=undefined)


def _contradiction(index: LogIndex) -> str:
    """How the statistics contradict the index; empty when they do not."""
    statistics = index.statistics
    if statistics is None:
        return ""
    n_chunks = sum(entry.kind is not Kind.LOOSE for entry in index.chunks)
    if statistics.chunk_count != n_chunks:
        return f"it counts {statistics.chunk_count:,} chunks, the log holds {n_chunks:,}"
    counts = index.message_counts()
    if counts is None:
        return ""
    total = sum(counts.values())
    if statistics.message_count != total:
        return f"it counts {statistics.message_count:,} messages, the log holds {total:,}"
    said = {key: count for key, count in statistics.channel_message_counts.items() if count}
    if said and said != counts:
        return "it counts other messages in the channels than the log holds"
    return ""


def _say_contradiction(index: LogIndex, damage: Damage) -> None:
    """A loss when messages are missing that no other loss explains, else a remark."""
    statistics, counts = index.statistics, index.message_counts()
    contradiction = _contradiction(index)
    if not contradiction or statistics is None or damage.any:
        return
    missing = statistics.message_count - sum((counts or {}).values())
    if counts is not None and missing > 0:
        reason = f"the statistics promise {statistics.message_count:,} messages"
        damage.lose(reason, index.data_end, messages=missing)
    else:
        damage.remark(f"the statistics are wrong: {contradiction}")
