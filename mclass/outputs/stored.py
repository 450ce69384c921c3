"""The messages of an output by kind of result, whatever its encoding."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Protocol, TypeVar

from mclass.errors import LogError
from mclass.logs.channels import ChannelInfo
from mclass.logs.reader import LogReader
from mclass.messages.cdr import CdrCodec
from mclass.messages.definitions import normalise_name, parse_definitions
from mclass.outputs.encoder import NANOSECONDS

_KINDS: Mapping[str, Sequence[tuple[str, str]]] = {
    "objects": (("estimates", "mclass_msgs/msg/Estimates"), ("objects", "mclass.Objects")),
    "grid": (("grid", "foxglove_msgs/msg/Grid"), ("grid", "foxglove.Grid")),
    "belief": (("belief", "mclass_msgs/msg/Belief"), ("belief", "mclass.Belief")),
    "measurements": (
        ("measurements", "mclass_msgs/msg/Measurements"),
        ("measurements", "mclass.Measurements"),
    ),
}
_FIRST_WINDOW_NS = NANOSECONDS
_WINDOW_GROWTH = 10

Result = TypeVar("Result")


class _Decoder(Protocol):
    def decode(self, data: memoryview) -> dict[str, Any]: ...


class StoredMessages:
    """Messages of ours in an open log: ``objects``, ``grid``, ``belief`` and ``measurements``.

    Args:
        reader: The log.
        prefix: Of the topics.
    """

    def __init__(self, reader: LogReader, prefix: str) -> None:
        self._reader = reader
        self._path = str(reader.path)
        self._codecs: dict[int, _Decoder] = {}
        self._channels = {kind: _find(reader, prefix, kind) for kind in _KINDS}

    @property
    def present(self) -> bool:
        """Whether there is a channel of any kind."""
        return any(self._channels.values())

    def starts(self) -> Iterator[int | None]:
        """Earliest log times to try, each reaching further back, None for all of the log.

        What is latest stands near the end, so that most of the log need not be unpacked.
        """
        start_ns, end_ns = self._reader.start_ns, self._reader.end_ns
        if start_ns is not None and end_ns is not None:
            window = _FIRST_WINDOW_NS
            while end_ns - window > start_ns:
                yield end_ns - window
                window *= _WINDOW_GROWTH
        yield None

    def payloads(self, kind: str, start_ns: int | None = None) -> Iterator[tuple[int, memoryview]]:
        """Log time and bytes of every message of a kind, in file order."""
        channel = self._channels[kind]
        if channel is None:
            return
        for batch in self._reader.batches([channel.id], start_ns):
            buffer = memoryview(batch.buffer)
            for offset, length, log_time_ns in zip(
                batch.offsets.tolist(),
                batch.lengths.tolist(),
                batch.log_times_ns.tolist(),
                strict=True,
            ):
                yield log_time_ns, buffer[offset : offset + length]

    def decode(self, kind: str, payload: memoryview) -> dict[str, Any]:
        """A message of a kind as value, by the schema that its channel embeds.

        Raises:
            LogError: If it is not such a message.
        """
        channel = self._channels[kind]
        assert channel is not None
        try:
            if channel.id not in self._codecs:
                self._codecs[channel.id] = _codec(channel)
            return self._codecs[channel.id].decode(payload)
        except LogError as error:
            raise LogError(str(error), path=self._path, topic=channel.topic) from error

    def checked(self, build: Callable[..., Result], *arguments: Any) -> Result:
        """What ``build`` makes, its complaints naming the file.

        A message of another version can lack what this one needs.

        Raises:
            LogError: If ``build`` complains.
        """
        try:
            return build(*arguments)
        except LogError as error:
            raise LogError(str(error), path=self._path) from error
        except (KeyError, ValueError) as error:
            raise LogError(
                f"a message does not hold what it should ({error}); it may be of another version",
                path=self._path,
            ) from error


def _find(reader: LogReader, prefix: str, kind: str) -> ChannelInfo | None:
    """The channel of one kind of result; of several the one that was added last."""
    wanted = {(f"{prefix}/{name}", schema) for name, schema in _KINDS[kind]}
    found = [
        channel for channel in reader.channels if (channel.topic, channel.schema_name) in wanted
    ]
    return found[-1] if found else None


def _codec(channel: ChannelInfo) -> _Decoder:
    """Decoder of a channel of ours."""
    if channel.message_encoding == "cdr":
        text = channel.schema_data.decode("utf-8", "replace")
        definitions = parse_definitions(channel.schema_name, text, "ros2msg")
        return CdrCodec(definitions, normalise_name(channel.schema_name))
    # Loaded when met: a ROS log does not need protobuf, which takes long.
    if channel.message_encoding == "json":
        from mclass.messages import proto_json  # noqa: PLC0415

        return proto_json.codec(channel.schema_name)
    from mclass.messages import protobuf  # noqa: PLC0415

    return protobuf.codec(channel.schema_name)
