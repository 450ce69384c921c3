"""All messages of a channel as one table, and how nested lists in it belong together.

The rows of a table are messages; a path with ``[]`` has many values a message. A *level* is
the part of a path up to its last ``[]`` (``detections[].results[]``), the empty string for
the message itself: values of one level correspond one to one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from mclass.errors import LogError
from mclass.logs.channels import ChannelInfo, MessageBatch
from mclass.logs.decode import ChannelDecoder, Column, decoder_for
from mclass.logs.reader import LogReader
from mclass.logs.together import together
from mclass.records import FloatArray, IntArray

_Found = TypeVar("_Found")

_LEARNED_AT_ONCE = 50
_JOINED_AT_ONCE = 8


@dataclass(frozen=True)
class Table:
    """Columns of a channel's messages, in file order.

    Attributes:
        channel: Where they came from.
        log_times_ns: Log time of each message, (m,).
        columns: By path.
        kinds: What the values of a path are, by path.
        failures: Messages that could not be decoded, by reason.
    """

    channel: ChannelInfo
    log_times_ns: IntArray
    columns: Mapping[str, Column]
    kinds: Mapping[str, str]
    failures: Mapping[str, int]

    def __len__(self) -> int:
        return len(self.log_times_ns)

    def is_time(self, path: str) -> bool:
        """Whether a path holds stamps [ns], and not plain numbers."""
        return self.kinds[path] == "time"

    def values(self, path: str) -> npt.NDArray[Any]:
        """Values of a path, at its own level."""
        return self.columns[path].values

    def floats(self, path: str) -> FloatArray:
        """Values of a numeric path as float64."""
        return np.asarray(self.columns[path].values, dtype=np.float64)

    def count(self, level: str) -> int:
        """Number of elements at a level."""
        return len(self) if not level else int(self.spans("", level)[-1])

    def spans(self, outer: str, inner: str) -> IntArray:
        """Elements of ``inner`` that belong to each element of ``outer``, an ancestor of it.

        Returns:
            Boundaries, (number of outer elements + 1,).

        Raises:
            LogError: If no column that was read reaches the inner level.
        """
        depth_outer, depth_inner = outer.count("[]"), inner.count("[]")
        for path, column in self.columns.items():
            if path.startswith(inner) and len(column.offsets) >= depth_inner:
                if depth_outer == depth_inner:
                    return np.arange(self.count(outer) + 1)
                bounds = column.offsets[depth_outer]
                for depth in range(depth_outer + 1, depth_inner):
                    bounds = column.offsets[depth][bounds]
                return bounds
        raise LogError(f"no field below {inner!r} was read", topic=self.channel.topic)

    def parents(self, outer: str, inner: str) -> IntArray:
        """For each element of ``inner`` the index of the ``outer`` element that it is in."""
        sizes = np.diff(self.spans(outer, inner))
        return np.repeat(np.arange(len(sizes)), sizes)

    def at_level(self, path: str, level: str) -> npt.NDArray[Any]:
        """Values of a path brought to a level: repeated from above, or taken alongside.

        Lists beside each other (``labels[]``, ``scores[]``) are taken to run in parallel.

        Raises:
            LogError: If they do not have the same lengths, or the path is deeper.
        """
        own = level_of(path)
        if own == level:
            return self.values(path)
        if level.startswith(own):
            return self.values(path)[self.parents(own, level)]
        offsets = self.columns[path].offsets
        if len(offsets) == level.count("[]") and np.array_equal(offsets[-1], self._bounds(level)):
            return self.values(path)
        raise LogError(
            f"the lists of {path!r} and {level!r} differ in length, so their elements cannot be "
            "told to belong together. Name other fields under log.",
            topic=self.channel.topic,
        )

    def _bounds(self, level: str) -> IntArray:
        """Innermost offsets of a level."""
        for path, column in self.columns.items():
            if path.startswith(level) and len(column.offsets) >= level.count("[]"):
                return column.offsets[level.count("[]") - 1]
        return np.zeros(1, np.int64)


def level_of(path: str) -> str:
    """The path up to its last ``[]``; empty if it has none."""
    end = path.rfind("[]")
    return path[: end + 2] if end >= 0 else ""


class Decoders:
    """The decoders of a log's channels, made when first asked for."""

    def __init__(self, reader: LogReader) -> None:
        self._reader = reader
        self._known: dict[int, ChannelDecoder] = {}
        self._schemaless: set[int] = set()
        self._unread: dict[int, Iterator[MessageBatch]] = {}

    def of(self, channel: ChannelInfo) -> ChannelDecoder:
        """Decoder of a channel; where messages name their own fields, it has seen the first.

        Raises:
            LogError: If the channel's encoding or schema cannot be used.
        """
        if channel.id not in self._known:
            self._known[channel.id] = decoder_for(channel)
            if not self._known[channel.id].paths:
                self._schemaless.add(channel.id)
                self._learn_more(channel)
        return self._known[channel.id]

    def paths(self, channel: ChannelInfo) -> Mapping[str, str]:
        """Kinds of the channel's fields; empty if it cannot be decoded."""
        try:
            return self.of(channel).paths
        except LogError:
            return {}

    def first_match(
        self, channel: ChannelInfo, find: Callable[[Mapping[str, str]], _Found | None]
    ) -> _Found | None:
        """What is found in the channel's fields, after as few messages as it takes."""
        found = find(self.paths(channel))
        while found is None and channel.id in self._known and self._learn_more(channel):
            found = find(self.paths(channel))
        return found

    def full_match(
        self, channel: ChannelInfo, find: Callable[[Mapping[str, str]], _Found | None]
    ) -> _Found | None:
        """What is found in all fields that any message has, optional ones included."""
        self.of(channel)
        found = None if channel.id in self._schemaless else find(self.paths(channel))
        if found is None:
            while self._learn_more(channel):
                pass
            found = find(self.paths(channel))
        return found

    def _learn_more(self, channel: ChannelInfo) -> bool:
        """Let the decoder see some more messages; False if there are none that help."""
        if channel.message_encoding != "json":
            return False
        if channel.id not in self._unread:
            self._unread[channel.id] = self._pieces(channel)
        piece = next(self._unread[channel.id], None)
        if piece is not None:
            self._known[channel.id].learn(piece)
        return piece is not None

    def _pieces(self, channel: ChannelInfo) -> Iterator[MessageBatch]:
        """Small batches, as most channels show their fields in their first messages."""
        for batch in self._reader.batches([channel.id]):
            for start in range(0, len(batch.offsets), _LEARNED_AT_ONCE):
                some = slice(start, start + _LEARNED_AT_ONCE)
                yield replace(
                    batch,
                    offsets=batch.offsets[some],
                    lengths=batch.lengths[some],
                    log_times_ns=batch.log_times_ns[some],
                    first_index=batch.first_index + start,
                )


def read_tables(
    reader: LogReader,
    decoders: Decoders,
    wanted: Mapping[int, Iterable[str]],
    start_ns: int | None = None,
    end_ns: int | None = None,
    *,
    condense: Mapping[str, Callable[[Column], Column]] | None = None,
) -> dict[int, Table]:
    """Read several channels in one pass over the file.

    Args:
        reader: The open log.
        decoders: Its decoders.
        wanted: Paths to read, by channel id.
        start_ns: First log time, inclusive; None for the beginning.
        end_ns: Last log time, exclusive; None for the end.
        condense: What to keep of each batch's column, by path, so that memory holds no more.

    Returns:
        One table for each wanted channel, empty ones included.
    """
    channels = {channel.id: channel for channel in reader.channels if channel.id in wanted}
    paths = {key: tuple(dict.fromkeys(wanted[key])) for key in channels}
    parts: dict[int, list[_Part]] = {key: [] for key in channels}
    failures: dict[int, dict[str, int]] = {key: {} for key in channels}
    if not channels:
        return {}
    for batch in together(reader.batches(list(channels), start_ns, end_ns)):
        key = batch.channel.id
        columns = decoders.of(batch.channel).columns(batch, paths[key])
        values = dict(columns.values)
        for path, keep in (condense or {}).items():
            if path in values:
                values[path] = keep(values[path])
        parts[key].append(_Part(batch.log_times_ns[columns.rows], values))
        parts[key] = _tidied(parts[key])
        for reason, count in columns.failures.items():
            failures[key][reason] = failures[key].get(reason, 0) + count
    tables = {}
    for key, channel in channels.items():
        whole = _joined(paths[key], parts.pop(key))
        tables[key] = Table(
            channel,
            whole.log_times_ns,
            whole.columns,
            {path: decoders.of(channel).paths[path] for path in paths[key]},
            failures[key],
        )
    return tables


@dataclass
class _Part:
    """Some messages of a channel, one behind the other."""

    log_times_ns: IntArray
    columns: dict[str, Column]
    batches: int = 1


def _tidied(parts: list[_Part]) -> list[_Part]:
    """Parts, the last ones joined as long as there are many of one size.

    Many small arrays would leave memory in pieces; so each is moved a few times, not once.
    """
    while True:
        last = parts[-_JOINED_AT_ONCE:]
        if len(last) < _JOINED_AT_ONCE or last[0].batches != last[-1].batches:
            return parts
        parts = [*parts[:-_JOINED_AT_ONCE], _joined(last[0].columns, last)]


def _joined(paths: Iterable[str], parts: list[_Part]) -> _Part:
    """All parts as one; they are emptied column by column, so that memory holds none twice."""
    times = [part.log_times_ns for part in parts]
    return _Part(
        np.concatenate([np.zeros(0, np.int64), *times]),
        {path: _join(path, [part.columns.pop(path) for part in parts]) for path in list(paths)},
        sum(part.batches for part in parts),
    )


def _join(path: str, columns: Sequence[Column]) -> Column:
    """Columns end to end."""
    if len(columns) == 1:
        return columns[0]
    if not columns:
        return Column(np.zeros(0), (np.zeros(1, np.int64),) * path.count("[]"))
    offsets = []
    for level in range(len(columns[0].offsets)):
        starts = np.cumsum([0] + [column.offsets[level][-1] for column in columns])
        offsets.append(
            np.concatenate(
                [[0]]
                + [
                    column.offsets[level][1:] + start
                    for column, start in zip(columns, starts[:-1], strict=True)
                ]
            ).astype(np.int64)
        )
    return Column(np.concatenate([column.values for column in columns]), tuple(offsets))
