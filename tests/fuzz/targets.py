"""What is fuzzed: each target takes any bytes, and fails only when `mclass` is wrong.

Errors of ours are right answers. Everything else is a fault: another exception, a result that
contradicts itself, a message that decodes differently in company than alone, a number in the
output that is none.
"""

from __future__ import annotations

import contextlib
import json
import tempfile
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np

from mclass.cells import stored_report
from mclass.checks import find_violations
from mclass.config.model_file import parse_model
from mclass.errors import ConfigError, LogError, UsageError
from mclass.logs.channels import ChannelInfo, MessageBatch
from mclass.logs.decode import ChannelDecoder, Column, Columns, decoder_for
from mclass.logs.decode import json as _json
from mclass.logs.decode import protobuf as _protobuf
from mclass.logs.decode import ros as _ros
from mclass.logs.reader import LogReader
from mclass.logs.writer import LogWriter
from mclass.messages.definitions import parse_definitions
from mclass.outputs.readback import OutputLog
from mclass.text.documents import cell_json, objects_json
from mclass.text.objects import objects_text
from mclass.text.terminal import Terminal

DECODERS = (_json, _protobuf, _ros)
"""Loaded here, so that they are instrumented with everything else."""
SAMPLES = Path(__file__).parents[2] / "sample_logs"
OWN_SCHEMA = 0xFF
"""First byte of an input of a decoder that brings its own schema."""

EVERY_MESSAGE_ALONE = True
"""False to decode one message of an input alone, not each: twice as many inputs in a time."""

_MOST_MESSAGES = 3
_MEMORY = Path("/dev/shm")
_FOLDER = tempfile.TemporaryDirectory(
    prefix="mclass-fuzz-", dir=_MEMORY if _MEMORY.is_dir() else None
)
_ROS_SCHEMA = """bool flag
int8[3] small
string name
time[] times
pkg/Item[] items
float64[] numbers
uint16 last
================================================================================
MSG: pkg/Item
string<=9 text
pkg/Empty[] nothing
pkg/Inner[2] pair
================================================================================
MSG: pkg/Inner
byte[] data
int64 number
================================================================================
MSG: pkg/Empty
"""
_JSON_SCHEMA = b"""{"type": "object", "properties": {
"stamp": {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {}}},
"date": {"type": "string", "format": "date-time"}, "valid": {"type": "boolean"},
"image": {"type": "string", "contentEncoding": "base64"}, "count": {"type": "integer"},
"matrix": {"type": "array", "items": {"type": "array", "items": {"type": "number"}}},
"boxes": {"type": "array", "items": {"$ref": "#/$defs/box"}}},
"$defs": {"box": {"properties": {"x": {"type": "number"}, "label": {"type": "string"}}}}}"""


def fuzz_reader(data: bytes) -> None:
    """Any file as a log: read all, verify all."""
    with contextlib.suppress(LogError), LogReader.open(_file("log.mcap", data)) as reader:
        _messages(reader)
        if len(data) % 4 == 0:
            reader.verify()
        assert reader.message_count is None or reader.message_count >= 0
        for name in reader.metadata_names:
            with contextlib.suppress(LogError):
                reader.metadata(name)
        for attachment in reader.attachments:
            with contextlib.suppress(LogError):
                reader.attachment(attachment.name)


def fuzz_carry_over(data: bytes) -> None:
    """Any log carried over into an output: the output is whole and holds the same."""
    target = Path(_FOLDER.name) / "out.mcap"
    with contextlib.suppress(LogError), LogReader.open(_file("in.mcap", data)) as reader:
        expected = _messages(reader)
        with LogWriter(target, source=reader, overwrite=True) as writer:
            channel = writer.add_channel("/new", "json", "", "", b"")
            writer.write(channel, 5, b"{}")
        with LogReader.open(target) as output:
            found = _messages(output)
            assert reader.damage.any or not output.damage.any, output.damage.sentences
        added = found.get("/new", [])
        added.remove((5, b"{}"))
        if not added:
            del found["/new"]
        assert found == expected


def fuzz_model(data: bytes) -> None:
    """Any bytes as a model file."""
    refused: ConfigError | None = None
    try:
        model = parse_model(data, "fuzz.yaml")
    except ConfigError as error:
        refused = error
    if refused is not None:
        assert refused.problems
        assert all(problem.line >= 0 and problem.message for problem in refused.problems)
        return
    classes = model.classes
    assert np.isclose(np.exp(classes.log_priors).sum(), 1.0, atol=1e-9)
    assert not np.isnan(classes.background_log_likelihood).any()
    views = np.array([[0.0, 0.0], [1.0, -2.0], [-1e5, 1e5]])
    for likelihood in classes.likelihoods.values():
        values = likelihood.log_likelihood(views)
        assert not np.isnan(values).any()
        assert (values < np.inf).all()
    if len(data) % 64 == 0:
        for violation in find_violations(classes, model.grid.min_range, model.grid.max_range):
            assert np.isfinite([violation.ratio, violation.share]).all()


def fuzz_definitions(data: bytes) -> None:
    """Any text as ROS message definitions, and a message of zeros by them."""
    text = data.decode("utf-8", "replace")
    for dialect, encoding in (("ros2msg", "cdr"), ("ros1msg", "ros1")):
        with contextlib.suppress(LogError):
            known = parse_definitions("pkg/Root", text, cast(Any, dialect))
            assert "pkg/Root" in known
            channel = _channel(encoding, "pkg/Root", data, dialect)
            _check_decoding(channel, [bytes(4), bytes([0, 1]) + bytes(62)])


def fuzz_cdr(data: bytes) -> None:
    """Messages in CDR by schemas of real logs, or by one of their own."""
    _fuzz_decoder(data, "cdr", "ros2msg")


def fuzz_ros1(data: bytes) -> None:
    """Messages in ROS 1's serialisation."""
    _fuzz_decoder(data, "ros1", "ros1msg")


def fuzz_protobuf(data: bytes) -> None:
    """Messages in protobuf."""
    _fuzz_decoder(data, "protobuf", "protobuf")


def fuzz_json(data: bytes) -> None:
    """Messages in JSON."""
    _fuzz_decoder(data, "json", "jsonschema")


def fuzz_readback(data: bytes) -> None:
    """Outputs of ours with one message replaced by other bytes."""
    outputs = _outputs()
    if len(data) < 2:
        return
    log, topic = outputs[data[0] % len(outputs)].replacing(data[1], data[2:])
    output = OutputLog(cast(LogReader, log))
    with contextlib.suppress(LogError, UsageError):
        _READ_BACK.get(topic.rpartition("/")[2], _read_objects)(output)


TARGETS: Mapping[str, Callable[[bytes], None]] = {
    name.removeprefix("fuzz_"): target
    for name, target in sorted(globals().items())
    if name.startswith("fuzz_")
}


def _file(name: str, data: bytes) -> Path:
    path = Path(_FOLDER.name) / name
    path.write_bytes(data)
    return path


def _messages(reader: LogReader) -> dict[str, list[tuple[int, bytes]]]:
    """Log times and payloads by topic, in no order of theirs."""
    found: dict[str, list[tuple[int, bytes]]] = {}
    for batch in reader.batches([channel.id for channel in reader.channels]):
        rows = found.setdefault(batch.channel.topic, [])
        buffer = memoryview(batch.buffer)
        for offset, length, time in zip(
            batch.offsets.tolist(), batch.lengths.tolist(), batch.log_times_ns.tolist(), strict=True
        ):
            assert 0 <= offset <= offset + length <= len(buffer)
            rows.append((time, bytes(buffer[offset : offset + length])))
    return {topic: sorted(rows) for topic, rows in found.items() if rows}


def _channel(encoding: str, name: str, schema: bytes, schema_encoding: str) -> ChannelInfo:
    return ChannelInfo(1, "/topic", encoding, name, schema_encoding, schema, None, {})


def _batch(channel: ChannelInfo, messages: Sequence[bytes]) -> MessageBatch:
    lengths = np.array([len(message) for message in messages], dtype=np.int64)
    offsets = np.cumsum(lengths) - lengths
    times = np.arange(len(messages), dtype=np.int64)
    return MessageBatch(channel, b"".join(messages), offsets, lengths, times, 0)


def channels_of_samples(encoding: str) -> list[ChannelInfo]:
    """A channel for every schema that the sample logs hold in an encoding, and some harder ones."""
    found: dict[str, ChannelInfo] = {}
    # No sample is of ROS 1, but definitions of ROS 2 hold there as well.
    stored = "cdr" if encoding == "ros1" else encoding
    for path in sorted(SAMPLES.glob("*.mcap")):
        with LogReader.open(path) as reader:
            for channel in reader.channels:
                if channel.message_encoding == stored:
                    found.setdefault(channel.schema_name, channel)
    channels = [found[name] for name in sorted(found)]
    if encoding == "ros1":
        channels = [
            _channel("ros1", channel.schema_name, channel.schema_data, "ros1msg")
            for channel in channels
        ]
    if encoding in ("cdr", "ros1"):
        dialect = "ros2msg" if encoding == "cdr" else "ros1msg"
        text = _ROS_SCHEMA if encoding == "ros1" else _ROS_SCHEMA.replace("time[]", "int32[]")
        channels.append(_channel(encoding, "pkg/Root", text.encode(), dialect))
    if encoding == "json":
        channels.append(_channel("json", "Thing", _JSON_SCHEMA, "jsonschema"))
        channels.append(_channel("json", "", b"", ""))
    return channels


_known_channels: dict[str, list[ChannelInfo]] = {}
_known_decoders: dict[str, ChannelDecoder] = {}


def _fuzz_decoder(data: bytes, encoding: str, schema_encoding: str) -> None:
    """First byte: the schema; then pieces behind their lengths in two bytes."""
    if not data:
        return
    pieces = list(_pieces(data[1:]))[: _MOST_MESSAGES + 1]
    if data[0] == OWN_SCHEMA:
        schema = pieces.pop(0) if pieces else b""
        channel = _channel(encoding, "pkg/Root", schema, schema_encoding)
    else:
        if encoding not in _known_channels:
            _known_channels[encoding] = channels_of_samples(encoding)
        known = _known_channels[encoding]
        channel = known[data[0] % len(known)]
    if not pieces:
        return
    with contextlib.suppress(LogError):
        _check_decoding(channel, pieces[:_MOST_MESSAGES])


def pack_pieces(first: int, pieces: Sequence[bytes]) -> bytes:
    """An input of a decoder's target."""
    return bytes([first]) + b"".join(len(p).to_bytes(2, "little") + p for p in pieces)


def _pieces(data: bytes) -> Iterator[bytes]:
    position = 0
    while position < len(data):
        length = int.from_bytes(data[position : position + 2], "little")
        yield data[position + 2 : position + 2 + length]
        position += 2 + length


def _check_decoding(channel: ChannelInfo, messages: Sequence[bytes]) -> None:
    """Decode in company and alone; both must agree."""
    decoder = _decoder(channel)
    batch = _batch(channel, messages)
    decoder.learn(batch)
    paths = list(decoder.paths)
    together = decoder.columns(batch, paths)
    _check_columns(together, len(messages), paths)
    if len(messages) == 1:
        return
    chosen = None if EVERY_MESSAGE_ALONE else int(batch.lengths.sum()) % len(messages)
    for index, message in enumerate(messages):
        if chosen in (None, index):
            alone = decoder.columns(_batch(channel, [message]), paths)
            _check_company(alone, together, index)


def _check_company(alone: Columns, together: Columns, index: int) -> None:
    """What one message gave alone is what it gave as number ``index`` of several."""
    position = int(np.searchsorted(together.rows, index))
    decoded = position < len(together.rows) and together.rows[position] == index
    assert len(alone.rows) == decoded, "a message decodes otherwise in company"
    assert sum(alone.failures.values()) == 1 - decoded
    for path, inner in alone.values.items() if decoded else ():
        outer = together.values[path]
        start, stop = position, position + 1
        for mine, all_of_them in zip(inner.offsets, outer.offsets, strict=True):
            expected = all_of_them[start : stop + 1] - all_of_them[start]
            assert np.array_equal(mine, expected)
            start, stop = int(all_of_them[start]), int(all_of_them[stop])
        _assert_equal(inner.values, outer.values[start:stop])


def _decoder(channel: ChannelInfo) -> ChannelDecoder:
    """Decoder of a channel; where schemas say all, those of the samples are made once."""
    if channel.message_encoding == "json" or channel.schema_name == "pkg/Root":
        return decoder_for(channel)
    if channel.schema_name not in _known_decoders:
        _known_decoders[channel.schema_name] = decoder_for(channel)
    return _known_decoders[channel.schema_name]


def _check_columns(columns: Columns, messages: int, paths: Collection[str]) -> None:
    assert columns.values.keys() == set(paths)
    assert len(columns.rows) + sum(columns.failures.values()) == messages
    assert (columns.rows[1:] > columns.rows[:-1]).all()
    assert all(count > 0 for count in columns.failures.values())
    for column in columns.values.values():
        _check_column(column, len(columns.rows))


def _check_column(column: Column, messages: int) -> None:
    count = messages
    for offsets in column.offsets:
        assert len(offsets) == count + 1
        assert offsets[0] == 0
        assert (offsets[1:] >= offsets[:-1]).all()
        count = int(offsets[-1])
    assert len(column.values) == count


def _assert_equal(first: np.ndarray[Any, Any], second: np.ndarray[Any, Any]) -> None:
    if np.dtype(object) in (first.dtype, second.dtype):
        assert first.tolist() == second.tolist()
    else:
        equal_nan = first.dtype.kind == "f" and second.dtype.kind == "f"
        assert np.array_equal(first, second, equal_nan=equal_nan)


class _MemoryLog:
    """What `OutputLog` needs of a reader, over messages in memory."""

    def __init__(self, reader: LogReader) -> None:
        self.path = reader.path
        self.channels = reader.channels
        self.start_ns, self.end_ns = reader.start_ns, reader.end_ns
        self._metadata = {name: reader.metadata(name) for name in reader.metadata_names}
        self._attachments = {a.name: reader.attachment(a.name) for a in reader.attachments}
        self._messages: list[tuple[ChannelInfo, int, bytes]] = []
        for batch in reader.batches([channel.id for channel in reader.channels]):
            for row in range(len(batch)):
                start, length = int(batch.offsets[row]), int(batch.lengths[row])
                payload = bytes(memoryview(batch.buffer)[start : start + length])
                self._messages.append((batch.channel, int(batch.log_times_ns[row]), payload))

    def replacing(self, index: int, payload: bytes) -> tuple[_MemoryLog, str]:
        """The same log with another payload in one message, and that message's topic."""
        other = object.__new__(_MemoryLog)
        other.__dict__ = dict(self.__dict__)
        other._messages = list(self._messages)
        index %= len(other._messages)
        channel, time, _ = self._messages[index]
        other._messages[index] = (channel, time, payload)
        return other, channel.topic

    def metadata(self, name: str) -> Mapping[str, str] | None:
        return self._metadata.get(name)

    def attachment(self, name: str) -> bytes | None:
        return self._attachments.get(name)

    def batches(self, ids: Sequence[int], start_ns: int | None = None) -> Iterator[MessageBatch]:
        for channel, time, payload in self._messages:
            if channel.id in ids and (start_ns is None or time >= start_ns):
                batch = _batch(channel, [payload])
                batch.log_times_ns[0] = time
                yield batch

    def payloads(self) -> list[bytes]:
        """Of all messages, in file order."""
        return [payload for _, _, payload in self._messages]


_made_outputs: list[_MemoryLog] = []


def _outputs() -> list[_MemoryLog]:
    """An output in each encoding."""
    if not _made_outputs:
        from written_output import ENCODINGS, write_everything  # noqa: PLC0415

        for encoding in ENCODINGS:
            path = Path(_FOLDER.name) / f"{encoding}.mcap"
            write_everything(path, encoding)
            with LogReader.open(path) as reader:
                _made_outputs.append(_MemoryLog(reader))
    return _made_outputs


def readback_seeds() -> Iterator[bytes]:
    """Every message of every output, in its own place."""
    for number, output in enumerate(_outputs()):
        for index, payload in enumerate(output.payloads()):
            yield bytes([number, index]) + payload


def _read_objects(output: OutputLog) -> None:
    objects = output.objects()
    document = objects_json(objects, output.class_names, output.frame, output.history())
    _check_document(document)
    objects_text(objects, output.class_names, output.frame, Terminal()).encode()


def _check_document(value: Any, key: str = "") -> None:
    """It is JSON, and only standard deviations are unknown."""
    if not key:
        json.dumps(value, allow_nan=False).encode()
    if isinstance(value, dict):
        for name, inner in value.items():
            _check_document(inner, str(name) or " ")
    elif isinstance(value, list):
        for inner in value:
            _check_document(inner, key)
    else:
        assert value is not None or "std" in key, key


def _read_belief(output: OutputLog) -> None:
    with contextlib.suppress(LogError):
        output.belief("o1")
    block = output.belief_at(0.25, 3.0)
    if len(block.cells):
        cell = block.grid.cell_at(0.25, 3.0)
        assert cell is not None
        _check_document(cell_json(stored_report(block, cell), output.class_names))


_READ_BACK: Mapping[str, Callable[[OutputLog], object]] = {
    "belief": _read_belief,
    "grid": OutputLog.maps,
    "measurements": OutputLog.measurements,
}
