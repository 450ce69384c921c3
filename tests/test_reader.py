"""Reading logs: whole ones of every kind, and broken ones built byte by byte."""

from __future__ import annotations

import contextlib
import io
import os
import struct
import threading
import tracemalloc
import zlib
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from log_bytes import (
    ALL_MESSAGES,
    KINDS,
    MAGIC,
    Message,
    chunks_of,
    data_end,
    log_bytes,
    messages_of,
    record_bytes,
    with_summary,
    written,
)
from mcap.records import Channel as ChannelRecord
from mcap.records import DataEnd, Schema
from mcap.summary import Summary
from mcap.writer import CompressionType, Writer

from mclass.errors import LogError
from mclass.logs import chunks
from mclass.logs.damage import Damage
from mclass.logs.reader import LogReader
from mclass.logs.source import open_source

RECORD = struct.Struct("<BQ")


def record(opcode: int, content: bytes) -> bytes:
    return RECORD.pack(opcode, len(content)) + content


def text(value: str) -> bytes:
    return struct.pack("<I", len(value)) + value.encode()


def chunk(data: bytes, *, compression: str = "", size: int, crc: int = 0) -> bytes:
    content = struct.pack("<QQQI", 0, 9, size, crc) + text(compression)
    return record(6, content + struct.pack("<Q", len(data)) + data)


def message(channel: int, time: int, data: bytes) -> bytes:
    return record(5, struct.pack("<HIQQ", channel, 0, time, time) + data)


def definitions(channel: int = 1, topic: str = "/a") -> bytes:
    schema = record_bytes(Schema(id=1, name="A", encoding="ros2msg", data=b"x"))
    return schema + record_bytes(ChannelRecord(channel, topic, "cdr", {}, 1))


HEADER = record(1, text("p") + text("l"))
END = record_bytes(DataEnd(0))


def opened(tmp_path: Path, data: bytes) -> LogReader:
    return LogReader.open(written(tmp_path / "log.mcap", data))


class TestWholeLogs:
    @pytest.mark.parametrize("kind", KINDS)
    def test_everything_is_read(self, kind: str, tmp_path: Path) -> None:
        with opened(tmp_path, log_bytes(kind)) as reader:
            assert messages_of(reader) == ALL_MESSAGES
            assert (reader.profile, reader.library) == ("ros2", "test")
            assert [(c.topic, c.message_encoding, c.schema_name) for c in reader.channels] == [
                ("/a", "cdr", "pkg/msg/A"),
                ("/b", "json", ""),
                ("/c", "cdr", "pkg/msg/A"),
            ]
            assert reader.channels[0].metadata == {"qos": "reliable"}
            assert reader.channels[0].schema_data == b"float64 x"
            assert [a.name for a in reader.attachments] == ["first.txt", "second.txt"]
            assert reader.attachment("second.txt") == b"second attachment"
            assert reader.attachment("third.txt") is None
            assert reader.metadata("settings") == {"speed": "fast"}
            assert reader.metadata("other") is None
            assert (reader.start_ns, reader.end_ns) == (1000, 2023)
            assert [c.message_count for c in reader.channels] == [24, 24, 24]
            assert not reader.damage.any
            assert reader.verify() == ()

    @pytest.mark.parametrize("kind", KINDS)
    def test_one_topic_and_time_range(self, kind: str, tmp_path: Path) -> None:
        with opened(tmp_path, log_bytes(kind)) as reader:
            assert messages_of(reader, "/b") == [m for m in ALL_MESSAGES if m.topic == "/b"]
            found = messages_of(reader, "/a", "/c", start_ns=1100, end_ns=2003)
            assert found == [
                m for m in ALL_MESSAGES if m.topic != "/b" and 1100 <= m.log_time < 2003
            ]

    def test_summary_is_used_where_there_is_one(self, tmp_path: Path) -> None:
        used = {}
        for kind in KINDS:
            with opened(tmp_path, log_bytes(kind)) as reader:
                used[kind] = reader.indexed
        without = {kind for kind, is_used in used.items() if not is_used}
        assert without == {"no_summary"}

    def test_batches_number_the_messages_of_a_channel(self, tmp_path: Path) -> None:
        with opened(tmp_path, log_bytes("zstd")) as reader:
            batches = list(reader.batches([1]))
            counted = np.concatenate([b.first_index + np.arange(len(b)) for b in batches])
            late = list(reader.batches([1], start_ns=1105))
        assert counted.tolist() == list(range(24))
        assert late[0].first_index == 11
        assert late[0].log_times_ns[0] == 1110

    @pytest.mark.parametrize("kind", ["no_message_index", "unchunked", "no_summary"])
    def test_numbers_do_not_depend_on_indexes(self, kind: str, tmp_path: Path) -> None:
        with opened(tmp_path, log_bytes(kind)) as reader:
            first = next(reader.batches([3], start_ns=2005))
        assert (first.first_index, first.log_times_ns[0]) == (5, 2005)

    def test_times_that_go_back_split_a_batch(self, tmp_path: Path) -> None:
        times = [5, 1, 6, 7, 2]
        body = definitions() + b"".join(message(1, time, b"%d" % time) for time in times)
        data = MAGIC + HEADER + chunk(body, size=len(body)) + END
        with opened(tmp_path, data) as reader:
            batches = list(reader.batches([1], start_ns=5))
        assert [b.first_index for b in batches] == [0, 2]
        assert [b.log_times_ns.tolist() for b in batches] == [[5], [6, 7]]

    def test_times_beyond_int64_are_the_latest(self, tmp_path: Path) -> None:
        body = definitions() + message(1, (1 << 64) - 1, b"late") + message(1, 3, b"early")
        with opened(tmp_path, MAGIC + HEADER + chunk(body, size=len(body)) + END) as reader:
            (batch,) = reader.batches([1])
        assert batch.log_times_ns.tolist() == [(1 << 63) - 1, 3]

    def test_only_needed_chunks_are_decompressed(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        opened_sizes: list[int] = []
        plain = chunks.decompress

        def counting(compression: str, data: memoryview, size: int) -> bytes:
            opened_sizes.append(size)
            return plain(compression, data, size)

        monkeypatch.setattr(chunks, "decompress", counting)
        data = log_bytes("zstd")
        with opened(tmp_path, data) as reader:
            assert opened_sizes == []
            with_c = [c for c in chunks_of(data) if 3 in c.message_index_offsets]
            messages_of(reader, "/c")
            assert opened_sizes == [c.uncompressed_size for c in with_c]
            assert 0 < len(with_c) < len(chunks_of(data))
            opened_sizes.clear()
            early = [c for c in chunks_of(data) if c.message_start_time < 1050]
            messages_of(reader, "/a", end_ns=1050)
            assert opened_sizes == [c.uncompressed_size for c in early]

    def test_log_without_messages(self, tmp_path: Path) -> None:
        with opened(tmp_path, MAGIC + HEADER + END) as reader:
            assert reader.channels == ()
            assert (reader.start_ns, reader.end_ns, reader.message_count) == (None, None, 0)
            assert list(reader.batches([1])) == []
            assert not reader.damage.any

    def test_chunk_statistics(self, tmp_path: Path) -> None:
        data = log_bytes("lz4")
        with opened(tmp_path, data) as reader:
            use = reader.compressions["lz4"]
        assert use.chunks == len(chunks_of(data))
        assert use.compressed_size == sum(c.compressed_size for c in chunks_of(data))

    def test_messages_inside_and_outside_of_chunks(self, tmp_path: Path) -> None:
        body = message(1, 2, b"inside")
        loose = message(1, 1, b"before"), message(1, 3, b"after")
        parts = [MAGIC, HEADER, definitions(), loose[0], chunk(body, size=len(body)), loose[1], END]
        with opened(tmp_path, b"".join(parts)) as reader:
            assert [m.data for m in messages_of(reader)] == [b"before", b"inside", b"after"]
            assert not reader.damage.any


class TestTruncation:
    @pytest.mark.parametrize("kind", KINDS)
    def test_cut_anywhere(self, kind: str, tmp_path: Path) -> None:
        data = log_bytes(kind)
        before = 0
        for length in range(8, len(data), 41):
            with opened(tmp_path, data[:length]) as reader:
                found = messages_of(reader)
                assert not Counter(found) - Counter(ALL_MESSAGES)
                assert len(found) >= before
                before = len(found)
                # Only the summary is gone: said, but nothing is lost.
                assert reader.damage.any == (length < data_end(data) + 13)
                assert reader.damage.sentences
        assert before == len(ALL_MESSAGES)

    def test_uncompressed_chunk_gives_its_whole_messages(self, tmp_path: Path) -> None:
        data = log_bytes("uncompressed")
        target = chunks_of(data)[1]
        before = sum(m.log_time < target.message_start_time for m in ALL_MESSAGES)
        end = target.chunk_start_offset + target.chunk_length
        with opened(tmp_path, data[: end - 1]) as reader:
            n_missing_last = len(messages_of(reader))
            assert reader.damage.chunks == 1
            assert "ends within this chunk" in reader.damage.sentences[0]
        with opened(tmp_path, data[:end]) as reader:
            n_whole = len(messages_of(reader))
        assert n_whole == n_missing_last + 1
        assert n_missing_last > before

    @pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4])
    def test_compressed_chunk_gives_what_decompresses(
        self, compression: CompressionType, tmp_path: Path, rng: np.random.Generator
    ) -> None:
        stream = io.BytesIO()
        writer = Writer(stream, chunk_size=10_000_000, compression=compression)
        writer.start()
        channel = writer.register_channel("/a", "cdr", 0)
        payloads = [rng.bytes(5000) for _ in range(200)]
        for number, payload in enumerate(payloads):
            writer.add_message(channel, number, payload, number)
        writer.finish()  # type: ignore[no-untyped-call]
        with opened(tmp_path, stream.getvalue()[:800_000]) as reader:
            found = messages_of(reader)
        assert 100 < len(found) < 160
        assert [m.data for m in found] == payloads[: len(found)]

    def test_cut_between_records_is_said(self, tmp_path: Path) -> None:
        data = log_bytes("zstd")
        first = chunks_of(data)[0]
        end = first.chunk_start_offset + first.chunk_length + first.message_index_length
        with opened(tmp_path, data[:end]) as reader:
            assert len(messages_of(reader)) == 9
            assert reader.damage.messages_uncounted
            assert "without an end mark" in reader.damage.sentences[0]

    def test_zeros_at_the_end(self, tmp_path: Path) -> None:
        data = log_bytes("zstd")
        with opened(tmp_path, data[: data_end(data)] + bytes(5_000_000)) as reader:
            assert messages_of(reader) == ALL_MESSAGES
            assert "zeros" in reader.damage.sentences[0]
            assert reader.damage.bytes == 5_000_000


class TestDamage:
    def test_flipped_bit_costs_its_chunk_only(self, tmp_path: Path) -> None:
        data = bytearray(log_bytes("zstd"))
        target = chunks_of(bytes(data))[2]
        data[target.chunk_start_offset + target.chunk_length - 5] ^= 4
        with opened(tmp_path, bytes(data)) as reader:
            found = messages_of(reader)
            lost = Counter(ALL_MESSAGES) - Counter(found)
            assert not Counter(found) - Counter(ALL_MESSAGES)
            assert (reader.damage.chunks, reader.damage.messages) == (1, sum(lost.values()))
            assert all(
                target.message_start_time <= m.log_time <= target.message_end_time for m in lost
            )
            messages_of(reader)
            assert reader.damage.chunks == 1, "the same loss counted twice"

    def test_checksum_is_compared(self, tmp_path: Path) -> None:
        data = bytearray(log_bytes("uncompressed"))
        target = chunks_of(bytes(data))[2]
        data[target.chunk_start_offset + target.chunk_length - 1] ^= 1
        with opened(tmp_path, bytes(data)) as reader:
            assert len(messages_of(reader)) < len(ALL_MESSAGES)
            assert "its checksum does not match" in reader.damage.sentences[0]

    def test_numbering_counts_lost_messages(self, tmp_path: Path) -> None:
        data = bytearray(log_bytes("zstd"))
        first = chunks_of(bytes(data))[0]
        data[first.chunk_start_offset + first.chunk_length - 5] ^= 4
        with opened(tmp_path, bytes(data)) as reader:
            batch = next(reader.batches([1]))
        assert batch.first_index == (batch.log_times_ns[0] - 1000) // 10 > 0

    def test_unknown_compression_is_said(self, tmp_path: Path) -> None:
        data = log_bytes("zstd").replace(b"\x04\0\0\0zstd", b"\x04\0\0\0zsty")
        with opened(tmp_path, data) as reader:
            assert messages_of(reader) == []
            assert reader.damage.messages == len(ALL_MESSAGES)
            assert "'zsty' is not known" in reader.damage.sentences[0]

    def test_bytes_that_are_no_records_are_passed_over(self, tmp_path: Path) -> None:
        data = log_bytes("zstd")
        place = chunks_of(data)[3].chunk_start_offset
        broken = data[:place] + b"\xff" * 1000 + data[place:]
        with opened(tmp_path, broken) as reader:
            assert messages_of(reader) == ALL_MESSAGES
            assert reader.damage.bytes == 1000
            assert f"at byte {place}" in reader.damage.sentences[0]

    def test_missing_piece_of_the_file(self, tmp_path: Path) -> None:
        data = log_bytes("zstd")
        target = chunks_of(data)[3]
        cut = target.chunk_start_offset + 60
        with opened(tmp_path, data[:cut] + data[cut + 50 :]) as reader:
            found = messages_of(reader)
            assert not Counter(found) - Counter(ALL_MESSAGES)
            assert len(found) >= len(ALL_MESSAGES) - 22
            assert reader.damage.any

    def test_definitions_of_a_lost_chunk_come_from_the_summary(self, tmp_path: Path) -> None:
        data = bytearray(log_bytes("zstd"))
        first = chunks_of(bytes(data))[0]
        data[first.chunk_start_offset] ^= 0x40
        with opened(tmp_path, bytes(data)) as reader:
            assert len(messages_of(reader)) == len(ALL_MESSAGES) - 9
            assert reader.damage.messages == 9

    def test_channels_that_nothing_defines_are_counted(self, tmp_path: Path) -> None:
        body = definitions() + message(1, 1, b"ok") + message(7, 2, b"?") + message(7, 3, b"?")
        with opened(tmp_path, MAGIC + HEADER + chunk(body, size=len(body)) + END) as reader:
            assert [m.data for m in messages_of(reader)] == [b"ok"]
            assert reader.damage.messages == 2
            assert "nothing in the file defines" in reader.damage.sentences[0]

    def test_records_that_run_past_their_chunk(self, tmp_path: Path) -> None:
        body = definitions() + message(1, 1, b"ok") + message(1, 2, b"cut")[:-1]
        crc = zlib.crc32(body)
        with opened(
            tmp_path, MAGIC + HEADER + chunk(body, size=len(body), crc=crc) + END
        ) as reader:
            assert [m.data for m in messages_of(reader)] == [b"ok"]
            assert "records in this chunk are broken" in reader.damage.sentences[0]

    def test_start_of_the_magic_may_be_damaged(self, tmp_path: Path) -> None:
        data = log_bytes("zstd")
        with opened(tmp_path, b"\x09" + data[1:]) as reader:
            assert messages_of(reader) == ALL_MESSAGES

    def test_wrong_message_indexes_do_not_mislead(self, tmp_path: Path) -> None:
        data = bytearray(log_bytes("zstd"))
        first = chunks_of(bytes(data))[0]
        index = first.chunk_start_offset + first.chunk_length
        struct.pack_into("<Q", data, index + 9 + 6 + 8, 3)
        with opened(tmp_path, bytes(data)) as reader:
            assert messages_of(reader) == ALL_MESSAGES
            assert "message indexes of a chunk" in reader.damage.sentences[0]
            assert not reader.damage.any

    @pytest.mark.parametrize("claim", [1 << 29, 1 << 31, (1 << 64) - 1])
    @pytest.mark.parametrize("compression", ["zstd", "lz4"])
    def test_claimed_sizes_are_not_allocated(
        self, claim: int, compression: str, tmp_path: Path
    ) -> None:
        packed = zstandard.compress(b"small") if compression == "zstd" else b"\x04\x22\x4d\x18"
        body = chunk(packed, compression=compression, size=claim)
        tracemalloc.start()
        try:
            with opened(tmp_path, MAGIC + HEADER + body + END) as reader:
                assert reader.damage.chunks == 1
            _, peak = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
        assert peak < 1 << 27

    def test_bomb_stops_at_its_claim(self, tmp_path: Path) -> None:
        packed = zstandard.compress(bytes(1 << 28))
        body = chunk(packed, compression="zstd", size=1000)
        tracemalloc.start()
        try:
            with opened(tmp_path, MAGIC + HEADER + body + END) as reader:
                assert "another size" in reader.damage.sentences[0]
            _, peak = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
        assert peak < 1 << 24


def _drop_chunk(summary: Summary) -> None:
    del summary.chunk_indexes[3]


def _shift_chunk(summary: Summary) -> None:
    summary.chunk_indexes[3].chunk_start_offset += 1


def _chunk_outside(summary: Summary) -> None:
    summary.chunk_indexes[3].chunk_start_offset = 1 << 62


def _endless_chunk(summary: Summary) -> None:
    summary.chunk_indexes[3].chunk_length = (1 << 64) - 1


def _forget_message_index(summary: Summary) -> None:
    del summary.chunk_indexes[3].message_index_offsets[1]


def _wrong_channel(summary: Summary) -> None:
    offsets = summary.chunk_indexes[3].message_index_offsets
    offsets[9] = offsets.pop(1)


def _wrong_compression(summary: Summary) -> None:
    summary.chunk_indexes[3].compression = "lz4"


def _wrong_size(summary: Summary) -> None:
    summary.chunk_indexes[3].uncompressed_size += 1


def _twice(summary: Summary) -> None:
    summary.chunk_indexes.append(summary.chunk_indexes[3])


def _no_channels(summary: Summary) -> None:
    summary.channels.clear()


def _no_schemas(summary: Summary) -> None:
    summary.schemas.clear()


def _statistics_of_chunks(summary: Summary) -> None:
    assert summary.statistics is not None
    summary.statistics.chunk_count = 1


def _statistics_of_messages(summary: Summary) -> None:
    assert summary.statistics is not None
    summary.statistics.message_count = 5


def _statistics_of_channels(summary: Summary) -> None:
    assert summary.statistics is not None
    summary.statistics.channel_message_counts = {1: 72}


class TestLyingSummary:
    @pytest.mark.parametrize(
        "edit",
        [
            _drop_chunk,
            _shift_chunk,
            _chunk_outside,
            _endless_chunk,
            _forget_message_index,
            _wrong_channel,
            _wrong_compression,
            _wrong_size,
            _twice,
            _no_channels,
            _no_schemas,
            _statistics_of_chunks,
            _statistics_of_messages,
            _statistics_of_channels,
        ],
    )
    def test_everything_is_found_all_the_same(
        self, edit: Callable[[Summary], None], tmp_path: Path
    ) -> None:
        with opened(tmp_path, with_summary(log_bytes("zstd"), edit)) as reader:
            assert messages_of(reader) == ALL_MESSAGES
            assert not reader.damage.any
            assert [c.schema_name for c in reader.channels] == ["pkg/msg/A", "", "pkg/msg/A"]

    @pytest.mark.parametrize("edit", [_shift_chunk, _endless_chunk, _wrong_compression])
    def test_lies_are_said(self, edit: Callable[[Summary], None], tmp_path: Path) -> None:
        with opened(tmp_path, with_summary(log_bytes("zstd"), edit)) as reader:
            messages_of(reader)
            assert not reader.indexed
            assert "the summary is wrong" in " ".join(reader.damage.sentences)

    def test_lie_met_while_reading_repeats_nothing(self, tmp_path: Path) -> None:
        with opened(tmp_path, with_summary(log_bytes("zstd"), _wrong_size)) as reader:
            assert reader.indexed
            numbers = [b.first_index + np.arange(len(b)) for b in reader.batches([2])]
        assert np.concatenate(numbers).tolist() == list(range(24))

    def test_promised_messages_that_are_missing_are_lost(self, tmp_path: Path) -> None:
        def promise(summary: Summary) -> None:
            assert summary.statistics is not None
            summary.statistics.message_count = 100

        with opened(tmp_path, with_summary(log_bytes("zstd"), promise)) as reader:
            assert messages_of(reader) == ALL_MESSAGES
            assert reader.damage.messages == 100 - len(ALL_MESSAGES)

    def test_checksum_of_the_summary_is_compared(self, tmp_path: Path) -> None:
        data = bytearray(log_bytes("zstd"))
        data[data_end(bytes(data)) + 13 + 20] ^= 1
        with opened(tmp_path, bytes(data)) as reader:
            assert messages_of(reader) == ALL_MESSAGES
            assert "checksum" in reader.damage.sentences[0]
            assert not reader.indexed

    @pytest.mark.parametrize("start", [1, 8, 9, 5000, 1 << 40, (1 << 64) - 1])
    def test_summary_in_a_wrong_place(self, start: int, tmp_path: Path) -> None:
        data = bytearray(log_bytes("zstd"))
        struct.pack_into("<Q", data, len(data) - 28, start)
        with opened(tmp_path, bytes(data)) as reader:
            assert messages_of(reader) == ALL_MESSAGES
            assert not reader.damage.any


class TestVerify:
    def test_attachment(self, tmp_path: Path) -> None:
        data = log_bytes("zstd").replace(b"second attachment", b"second attachmenT")
        with opened(tmp_path, data) as reader:
            (problem,) = reader.verify()
            assert "second.txt" in problem
            with pytest.raises(LogError, match=r"second\.txt.*checksum"):
                reader.attachment("second.txt")

    def test_data_section(self, tmp_path: Path) -> None:
        data = bytearray(log_bytes("data_crc"))
        data[22] ^= 1
        with opened(tmp_path, bytes(data)) as reader:
            assert reader.verify() == ("the checksum of the data section does not match",)

    def test_chunk_times(self, tmp_path: Path) -> None:
        body = definitions() + message(1, 10, b"late")
        with opened(tmp_path, MAGIC + HEADER + chunk(body, size=len(body)) + END) as reader:
            problems = reader.verify()
        assert "messages outside of the times that it states (at byte" in problems[-2]
        assert "reading a part of the time can miss messages" in problems[-1]

    def test_damaged_chunk_and_progress(self, tmp_path: Path) -> None:
        data = bytearray(log_bytes("zstd"))
        target = chunks_of(bytes(data))[2]
        data[target.chunk_start_offset + target.chunk_length - 5] ^= 4
        calls: list[tuple[int, int]] = []
        with opened(tmp_path, bytes(data)) as reader:
            problems = reader.verify(lambda done, total: calls.append((done, total)))
            assert problems == reader.damage.sentences
        assert calls == sorted(calls)
        assert calls[-1] == (len(data), len(data))


class TestAttachments:
    def test_last_of_a_name_counts(self, tmp_path: Path) -> None:
        stream = io.BytesIO()
        writer = Writer(stream)
        writer.start()
        for data in (b"old", b"new"):
            writer.add_attachment(0, 0, "model", "text/plain", data)
            writer.add_metadata("run", {"which": data.decode()})
        writer.finish()  # type: ignore[no-untyped-call]
        with opened(tmp_path, stream.getvalue()) as reader:
            assert reader.attachment("model") == b"new"
            assert reader.metadata("run") == {"which": "new"}
            assert reader.metadata_names == ("run", "run")

    def test_too_large_is_refused(self, tmp_path: Path) -> None:
        with (
            opened(tmp_path, log_bytes("zstd")) as reader,
            pytest.raises(LogError, match="16 bytes, more than the 5"),
        ):
            reader.attachment("first.txt", max_size=5)


class TestRefusals:
    @pytest.mark.parametrize(
        ("content", "sentence"),
        [
            (b"", "is empty"),
            (MAGIC[:5], "cut off within its first bytes"),
            (b"\x89MCAP0\n" + b"\x01" * 50, "mangled"),
            (b"\x89MCAP0\r\r\n" + b"\x01" * 50, "mangled"),
            (b"\xef\xbf\xbdMCAP0\r\n" + b"\x01" * 50, "mangled"),
            (b"#ROSBAG V2.0\n", "mcap convert"),
            (b"SQLite format 3\0", "mcap convert"),
            (b"\x1f\x8b" + bytes(50), "gunzip"),
            (b"version https://git-lfs.github.com/spec/v1", "git lfs pull"),
            (b"time,x,y\n1,2,3\n", "is not an MCAP file"),
            (bytes(100), "begins with zeros"),
        ],
    )
    def test_other_files(self, content: bytes, sentence: str, tmp_path: Path) -> None:
        with pytest.raises(LogError, match=sentence) as caught:
            opened(tmp_path, content)
        assert caught.value.path == str(tmp_path / "log.mcap")

    def test_missing(self, tmp_path: Path) -> None:
        with pytest.raises(LogError, match="no such file"):
            LogReader.open(tmp_path / "nothing.mcap")

    def test_folder_names_its_logs(self, tmp_path: Path) -> None:
        written(tmp_path / "run.mcap", b"")
        with pytest.raises(LogError, match=r"is a folder.*run\.mcap"):
            LogReader.open(tmp_path)

    def test_device(self) -> None:
        with pytest.raises(LogError, match="device"):
            LogReader.open("/dev/zero")

    def test_impossible_name(self) -> None:
        with pytest.raises(LogError, match="zero character"):
            LogReader.open("log\0.mcap")

    @pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
    def test_no_permission(self, tmp_path: Path) -> None:
        path = written(tmp_path / "log.mcap", log_bytes("zstd"))
        path.chmod(0)
        with pytest.raises(LogError, match="permission denied"):
            LogReader.open(path)


class TestPipes:
    @staticmethod
    def through_pipe(tmp_path: Path, data: bytes) -> LogReader:
        pipe = tmp_path / "pipe"
        os.mkfifo(pipe)
        feeder = threading.Thread(target=pipe.write_bytes, args=(data,))
        feeder.start()
        try:
            return LogReader.open(pipe)
        finally:
            feeder.join()

    def test_pipe_is_read(self, tmp_path: Path) -> None:
        with self.through_pipe(tmp_path, log_bytes("zstd")) as reader:
            assert messages_of(reader, "/c") == [m for m in ALL_MESSAGES if m.topic == "/c"]

    def test_pipe_of_other_content(self, tmp_path: Path) -> None:
        with pytest.raises(LogError, match="not an MCAP file"):
            self.through_pipe(tmp_path, b"hello, world")


class TestDamageCounts:
    def test_same_loss_counts_once(self) -> None:
        damage = Damage()
        for _ in range(2):
            damage.lose("why", 5, chunks=1, n_bytes=7, messages=2)
        damage.lose("why", 3, chunks=1, n_bytes=1, messages=1)
        assert (damage.chunks, damage.bytes, damage.messages) == (2, 8, 3)
        assert damage.sentences == ("lost 2 chunks, 3 messages, 8 bytes from byte 3 on: why",)

    def test_unknown_counts_are_said(self) -> None:
        damage = Damage()
        damage.lose("cut", 5)
        assert damage.any
        assert damage.messages_uncounted
        assert damage.sentences == ("lost an unknown number of messages at byte 5: cut",)

    def test_remarks_are_no_damage(self) -> None:
        damage = Damage()
        damage.remark("odd")
        assert not damage.any
        assert damage.sentences == ("odd",)


WHOLE = {kind: log_bytes(kind) for kind in KINDS}


@st.composite
def mutated_logs(draw: st.DrawFn) -> bytes:
    """A log with a few bytes changed, cut out, doubled or put in."""
    data = bytearray(WHOLE[draw(st.sampled_from(sorted(WHOLE)))])
    for _ in range(draw(st.integers(1, 4))):
        place = draw(st.integers(8, max(8, len(data) - 1)))
        length = draw(st.sampled_from([1, 2, 8, 9, 60]))
        kind = draw(st.sampled_from(["change", "cut", "double", "insert", "number", "end"]))
        if kind == "change":
            data[place : place + 1] = draw(st.binary(min_size=1, max_size=1))
        elif kind == "cut":
            del data[place : place + length]
        elif kind == "double":
            data[place:place] = data[place : place + 5 * length]
        elif kind == "insert":
            data[place:place] = draw(st.binary(min_size=length, max_size=length))
        elif kind == "number":
            numbers = [0, 1, len(data), 1 << 31, 1 << 40, (1 << 63) - 1, (1 << 64) - 1]
            data[place : place + 8] = struct.pack("<Q", draw(st.sampled_from(numbers)))
        else:
            del data[place:]
    return bytes(data)


@pytest.mark.skipif(not hasattr(os, "pread"), reason="reads are locked there instead")
def test_reading_moves_no_position(tmp_path: Path) -> None:
    """A log is hashed while it is copied: a position that both share would mix them up."""
    source = open_source(written(tmp_path / "log.mcap", MAGIC + bytes(range(200))))
    assert source.descriptor is not None
    try:
        assert source.read(108, 3) == bytes([100, 101, 102])
        assert source.peek(9, 1) == b"\x01"
        assert os.lseek(source.descriptor, 0, os.SEEK_CUR) == 0
    finally:
        source.close()


class TestMutations:
    @settings(
        max_examples=150,
        deadline=2000,
        suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
    )
    @given(data=mutated_logs())
    def test_nothing_but_log_errors(self, data: bytes, tmp_path: Path) -> None:
        with opened(tmp_path, data) as reader:
            found: list[Message] = messages_of(reader)
            reader.verify()
            assert reader.message_count is None or reader.message_count >= 0
            for channel in reader.channels:
                assert isinstance(channel.topic, str)
            for name in reader.metadata_names:
                reader.metadata(name)
            for attachment in reader.attachments:
                with contextlib.suppress(LogError):
                    reader.attachment(attachment.name)
            missing = len(ALL_MESSAGES) - len(found)
            # Messages outside of chunks have no checksum, and private records may be anything.
            assert missing <= 0 or reader.damage.sentences
