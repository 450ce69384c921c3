"""Ids that a log defines twice and differently, and chunks that lie about their times."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TypeAlias

import pytest
from log_bytes import MAGIC, messages_of, record_bytes, written
from mcap.records import Channel, Chunk, DataEnd, Footer, Header, McapRecord, Schema
from mcap.records import Message as MessageRecord

from mclass.logs.reader import LogReader


def channel(number: int, topic: str, encoding: str, schema: int, about: dict[str, str]) -> Channel:
    return Channel(
        id=number, topic=topic, message_encoding=encoding, schema_id=schema, metadata=about
    )


SCHEMA = Schema(id=1, data=b"float64 x", encoding="ros2msg", name="pkg/msg/A")
OTHER_SCHEMA = Schema(id=1, data=b"float32 x", encoding="ros2msg", name="pkg/msg/A")
CHANNEL = channel(1, "/a", "cdr", 1, {})
OTHER_CHANNEL = channel(1, "/b", "cdr", 1, {})
AGAIN = channel(1, "/a", "cdr", 1, {"qos": "reliable"})
NEIGHBOUR = channel(2, "/n", "json", 0, {})


def said(number: int, channel: int = 1) -> MessageRecord:
    time = 100 + number
    return MessageRecord(
        channel_id=channel, data=b"%d" % number, log_time=time, publish_time=time, sequence=number
    )


Part: TypeAlias = McapRecord | list[McapRecord]


def log_of(parts: Iterable[Part], summary: Iterable[McapRecord] = ()) -> bytes:
    """Records; a list of them as a chunk."""
    data = MAGIC + record_bytes(Header(profile="", library="test"))
    for part in parts:
        data += record_bytes(chunk_of(part) if isinstance(part, list) else part)
    data += record_bytes(DataEnd(data_section_crc=0))
    closing = b"".join(map(record_bytes, summary))
    start = len(data) if closing else 0
    footer = Footer(summary_start=start, summary_offset_start=0, summary_crc=0)
    return data + closing + record_bytes(footer) + MAGIC


def chunk_of(records: list[McapRecord], earlier_ns: int = 0) -> Chunk:
    """A chunk; it can state that all was so much earlier."""
    times = [record.log_time for record in records if isinstance(record, MessageRecord)]
    data = b"".join(map(record_bytes, records))
    start, end = min(times) - earlier_ns, max(times) - earlier_ns
    return Chunk(
        compression="",
        data=data,
        message_start_time=start,
        message_end_time=end,
        uncompressed_crc=0,
        uncompressed_size=len(data),
    )


def numbers(reader: LogReader, topic: str = "/a", **bounds: int) -> list[int]:
    return [int(message.data) for message in messages_of(reader, topic, **bounds)]


REDEFINED: dict[str, list[Part]] = {
    "channel in another chunk": [
        [SCHEMA, CHANNEL, NEIGHBOUR, said(0), said(1, 2)],
        [OTHER_CHANNEL, said(2), said(3, 2)],
        [said(4), said(5, 2)],
    ],
    "schema in another chunk": [
        [SCHEMA, CHANNEL, NEIGHBOUR, said(0), said(1, 2)],
        [OTHER_SCHEMA, said(2), said(3, 2)],
        [said(4), said(5, 2)],
    ],
    "channel within a chunk": [
        [SCHEMA, CHANNEL, NEIGHBOUR, said(0), said(1, 2), OTHER_CHANNEL, said(2), said(3, 2)],
        [said(4), said(5, 2)],
    ],
    "channel between chunks": [
        [SCHEMA, CHANNEL, NEIGHBOUR, said(0), said(1, 2)],
        OTHER_CHANNEL,
        [said(2), said(3, 2), said(4), said(5, 2)],
    ],
    "no chunks": [
        *(SCHEMA, CHANNEL, NEIGHBOUR, said(0), said(1, 2)),
        *(OTHER_CHANNEL, said(2), said(3, 2), said(4), said(5, 2)),
    ],
}


@pytest.mark.parametrize("name", REDEFINED)
def test_messages_behind_another_definition_are_left_out(name: str, tmp_path: Path) -> None:
    path = written(tmp_path / "log.mcap", log_of(REDEFINED[name]))
    with LogReader.open(path) as reader:
        assert numbers(reader, "/n") == [1, 3, 5]
        assert not reader.damage.any
        # Which definition comes first depends on whether chunks have to be opened for them.
        topic = reader.channels[0].topic
        expected = [2, 4] if topic == "/b" else [0]
        assert numbers(reader, topic) == expected
        (loss,) = reader.damage.losses
        assert reader.damage.messages == 3 - len(expected)
        assert loss.endswith(f"the channel of {topic} is defined a second time, as another one")
    with LogReader.open(path) as reader:
        assert loss in reader.verify()


def test_a_definition_can_come_back(tmp_path: Path) -> None:
    parts: list[Part] = [
        [SCHEMA, CHANNEL, said(0), OTHER_CHANNEL, said(1), CHANNEL, said(2)],
        [OTHER_SCHEMA, said(3)],
        [SCHEMA, said(4)],
        OTHER_CHANNEL,
        [said(5)],
        CHANNEL,
        [said(6)],
    ]
    with LogReader.open(written(tmp_path / "log.mcap", log_of(parts))) as reader:
        topic = reader.channels[0].topic
        assert numbers(reader, topic) == {"/a": [0, 2, 4, 6], "/b": [1, 5]}[topic]
        assert reader.damage.messages == {"/a": 3, "/b": 5}[topic]


@pytest.mark.parametrize(("used", "expected"), [(CHANNEL, [0]), (OTHER_CHANNEL, [2, 4])])
def test_the_definition_in_the_summary_is_the_one_in_use(
    used: Channel, expected: list[int], tmp_path: Path
) -> None:
    data = log_of(REDEFINED["channel in another chunk"], [SCHEMA, used, NEIGHBOUR])
    with LogReader.open(written(tmp_path / "log.mcap", data)) as reader:
        assert reader.indexed
        assert numbers(reader, used.topic) == expected
        assert reader.damage.messages == 3 - len(expected)


def test_definitions_that_say_the_same_are_no_matter(tmp_path: Path) -> None:
    parts: list[Part] = [
        [SCHEMA, CHANNEL, said(0)],
        [SCHEMA, AGAIN, said(1)],
        AGAIN,
        [said(2)],
    ]
    with LogReader.open(written(tmp_path / "log.mcap", log_of(parts))) as reader:
        assert numbers(reader) == [0, 1, 2]
        assert reader.verify() == ()


@pytest.fixture
def lying(tmp_path: Path) -> Path:
    """The second chunk claims to be a second earlier."""
    first: list[McapRecord] = [SCHEMA, CHANNEL, said(0), said(1)]
    parts = [chunk_of(first), chunk_of([said(2), said(3)], 50), chunk_of([said(4)])]
    return written(tmp_path / "log.mcap", log_of(parts))


class TestTimes:
    def test_everything_is_there_when_nothing_is_chosen_by_time(self, lying: Path) -> None:
        with LogReader.open(lying) as reader:
            assert numbers(reader) == [0, 1, 2, 3, 4]
            assert not reader.damage.any
            (remark,) = reader.damage.remarks
            assert remark.startswith("a chunk holds messages outside of the times that it states")

    def test_what_may_be_missing_is_said(self, lying: Path) -> None:
        """The chunk is met when the time before it is asked for."""
        with LogReader.open(lying) as reader:
            assert numbers(reader, end_ns=103) == [0, 1, 2]
            (loss,) = reader.damage.losses
            assert loss.startswith("lost an unknown number of messages at byte ")
            assert "times they state" in loss

    def test_times_are_believed_where_nothing_contradicts(self, tmp_path: Path) -> None:
        parts: list[Part] = [[SCHEMA, CHANNEL, said(0), said(1)], [said(2), said(3)], [said(4)]]
        with LogReader.open(written(tmp_path / "log.mcap", log_of(parts))) as reader:
            assert numbers(reader, start_ns=102, end_ns=104) == [2, 3]
            assert reader.verify() == ()

    def test_a_chunk_whose_times_are_the_wrong_way_round_is_read(self, tmp_path: Path) -> None:
        wrong = chunk_of([said(2), said(3)])
        wrong.message_start_time, wrong.message_end_time = 103, 102
        parts: list[Part] = [[SCHEMA, CHANNEL, said(0)], wrong]
        with LogReader.open(written(tmp_path / "log.mcap", log_of(parts))) as reader:
            assert numbers(reader, start_ns=103, end_ns=104) == [3]
            assert reader.damage.any
