"""Inputs that fuzzing starts from: small and valid, one for each kind of thing a target reads."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from fuzz import targets
from log_bytes import KINDS
from mcap.writer import Writer

from mclass.logs.reader import LogReader

_ROOT = Path(__file__).parents[2]
_LONGEST = 4096


def seeds(target: str) -> Iterable[bytes]:
    """Inputs for a target."""
    return _SEEDS[target]()


def _logs() -> Iterator[bytes]:
    for options in KINDS.values():
        yield _small_log(options)


def _small_log(options: Mapping[str, Any]) -> bytes:
    """A few chunks, two channels, an attachment and a metadata record in about a kilobyte."""
    stream = io.BytesIO()
    writer = Writer(stream, chunk_size=60, **options)
    writer.start("ros2", "test")
    schema = writer.register_schema("pkg/msg/A", "ros2msg", b"float64 x")
    channels = [
        writer.register_channel("/a", "cdr", schema, {"qos": "reliable"}),
        writer.register_channel("/b", "json", 0),
    ]
    for number in range(4):
        time = 100 + number
        writer.add_message(channels[number % 2], time, b"payload %d" % number, time)
    writer.add_attachment(1, 2, "a.txt", "text/plain", b"attached")
    writer.add_metadata("m", {"key": "value"})
    writer.finish()  # type: ignore[no-untyped-call]
    return stream.getvalue()


def _models() -> Iterator[bytes]:
    for path in sorted((_ROOT / "configs").glob("*.yaml")):
        yield path.read_bytes()


def _definitions() -> Iterator[bytes]:
    for encoding in ("cdr", "ros1"):
        for channel in targets.channels_of_samples(encoding):
            yield channel.schema_data


def _messages(encoding: str) -> Callable[[], Iterator[bytes]]:
    def pieces() -> Iterator[bytes]:
        channels = targets.channels_of_samples(encoding)
        payloads = _sample_payloads(encoding)
        for number, channel in enumerate(channels):
            found = payloads.get(channel.schema_name, [bytes(40), b"{}"])
            yield targets.pack_pieces(number, found)
            yield targets.pack_pieces(targets.OWN_SCHEMA, [channel.schema_data, *found])

    return pieces


def _sample_payloads(encoding: str) -> dict[str, list[bytes]]:
    """The first two messages of every schema in the sample logs."""
    found: dict[str, list[bytes]] = {}
    for path in sorted(targets.SAMPLES.glob("*.mcap")):
        with LogReader.open(path) as reader:
            wanted = [c.id for c in reader.channels if c.message_encoding == encoding]
            for batch in reader.batches(wanted):
                payloads = found.setdefault(batch.channel.schema_name, [])
                for row in range(min(len(batch), 2 - len(payloads))):
                    start = int(batch.offsets[row])
                    stop = start + int(batch.lengths[row])
                    payloads.append(bytes(memoryview(batch.buffer)[start:stop]))
    return found


_SEEDS: Mapping[str, Callable[[], Iterator[bytes]]] = {
    "reader": _logs,
    "carry_over": _logs,
    "model": _models,
    "definitions": _definitions,
    "cdr": _messages("cdr"),
    "ros1": _messages("ros1"),
    "protobuf": _messages("protobuf"),
    "json": _messages("json"),
    "readback": targets.readback_seeds,
}
