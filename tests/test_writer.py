"""Writing logs: new ones, and others carried over; judged by the reference reader."""

from __future__ import annotations

import errno
import io
import os
import resource
import signal
import struct
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
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
    reference_messages,
    summary_of,
    written,
)
from mcap.reader import NonSeekingReader, make_reader
from mcap.records import Channel, Schema
from mcap.writer import Writer

from mclass.errors import LogError
from mclass.logs import pending
from mclass.logs.reader import LogReader
from mclass.logs.writer import LogWriter

NEW = Message("/mclass/objects", 1500, b'{"id": 1}')
CHUNKED = sorted(KINDS.keys() - {"unchunked"})


def extend(source: Path, output: Path, *, overwrite: bool = False) -> bytes:
    """Carry a log over and add one of everything; the output's bytes."""
    with (
        LogReader.open(source) as reader,
        LogWriter(output, source=reader, overwrite=overwrite) as writer,
    ):
        channel = writer.add_channel(NEW.topic, "json", "Objects", "jsonschema", b"{}", {"k": "v"})
        writer.write(channel, NEW.log_time, NEW.data)
        writer.attach("mclass.yaml", "text/yaml", b"classes: {}", 1500)
        writer.add_metadata("mclass", {"version": "1"})
    return output.read_bytes()


def create(output: Path, messages: list[Message]) -> bytes:
    """A new log of some messages; its bytes."""
    with LogWriter(output, profile="ros2") as writer:
        ids: dict[str, int] = {}
        for message in messages:
            if message.topic not in ids:
                ids[message.topic] = writer.add_channel(
                    message.topic, "cdr", "pkg/msg/A", "ros2msg", b"float64 x"
                )
            writer.write(ids[message.topic], message.log_time, message.data)
    return output.read_bytes()


@pytest.fixture
def source(tmp_path: Path) -> Path:
    return written(tmp_path / "log.mcap", log_bytes("zstd"))


class TestCarryingOver:
    @pytest.mark.parametrize("kind", KINDS)
    def test_everything_is_there(self, kind: str, tmp_path: Path) -> None:
        source = written(tmp_path / "log.mcap", log_bytes(kind))
        data = extend(source, tmp_path / "out.mcap")
        assert reference_messages(data) == sorted([*ALL_MESSAGES, NEW])
        reader = make_reader(io.BytesIO(data), validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        attachments = {a.name: (a.log_time, a.data) for a in reader.iter_attachments()}
        assert attachments == {
            "first.txt": (2, b"first attachment"),
            "second.txt": (4, b"second attachment"),
            "mclass.yaml": (1500, b"classes: {}"),
        }
        metadata = {m.name: m.metadata for m in reader.iter_metadata()}
        assert metadata == {"settings": {"speed": "fast"}, "mclass": {"version": "1"}}
        with LogReader.open(tmp_path / "out.mcap") as again:
            assert again.indexed
            assert again.verify() == ()

    @pytest.mark.parametrize("kind", CHUNKED)
    def test_data_section_is_verbatim(self, kind: str, tmp_path: Path) -> None:
        before = log_bytes(kind)
        data = extend(written(tmp_path / "log.mcap", before), tmp_path / "out.mcap")
        end = data_end(before)
        assert data[:end] == before[:end]

    def test_summary_counts_old_and_new(self, source: Path, tmp_path: Path) -> None:
        summary = summary_of(extend(source, tmp_path / "out.mcap"))
        old = summary_of(source.read_bytes())
        statistics = summary.statistics
        assert statistics is not None
        assert statistics.message_count == len(ALL_MESSAGES) + 1
        assert statistics.channel_message_counts == {1: 24, 2: 24, 3: 24, 4: 1}
        assert (statistics.attachment_count, statistics.metadata_count) == (3, 2)
        assert (statistics.message_start_time, statistics.message_end_time) == (1000, 2023)
        assert statistics.chunk_count == len(old.chunk_indexes) + 1
        assert summary.chunk_indexes[:-1] == old.chunk_indexes
        assert {key: summary.channels[key] for key in old.channels} == old.channels
        assert summary.channels[4].metadata == {"k": "v"}

    def test_unchunked_log_becomes_indexed(self, tmp_path: Path) -> None:
        source = written(tmp_path / "log.mcap", log_bytes("unchunked"))
        data = extend(source, tmp_path / "out.mcap")
        assert {c.compression for c in chunks_of(data)} == {"", "zstd"}
        assert sum(len(c.message_index_offsets) for c in chunks_of(data)) == 4

    def test_checksum_of_the_data_is_continued(self, tmp_path: Path) -> None:
        source = written(tmp_path / "log.mcap", log_bytes("data_crc"))
        data = extend(source, tmp_path / "out.mcap")
        (crc,) = struct.unpack_from("<I", data, data_end(data) + 9)
        assert crc
        reader = NonSeekingReader(io.BytesIO(data), validate_crcs=True)
        assert len(list(reader.iter_messages())) == len(ALL_MESSAGES) + 1

    def test_damage_shows_in_the_continued_checksum(self, tmp_path: Path) -> None:
        broken = bytearray(log_bytes("data_crc"))
        broken[22] ^= 1
        extend(written(tmp_path / "log.mcap", bytes(broken)), tmp_path / "out.mcap")
        with LogReader.open(tmp_path / "out.mcap") as reader:
            assert reader.verify() == ("the checksum of the data section does not match",)

    def test_outputs_can_be_extended_again(self, source: Path, tmp_path: Path) -> None:
        extend(source, tmp_path / "once.mcap")
        data = extend(tmp_path / "once.mcap", tmp_path / "twice.mcap")
        assert reference_messages(data) == sorted([*ALL_MESSAGES, NEW, NEW])
        assert len(summary_of(data).schemas) == 2, "the equal schema is used again"
        with LogReader.open(tmp_path / "twice.mcap") as reader:
            assert [a.name for a in reader.attachments].count("mclass.yaml") == 2
            assert reader.metadata("mclass") == {"version": "1"}
            assert reader.verify() == ()

    def test_ids_keep_clear_of_channels_not_seen(self, tmp_path: Path) -> None:
        stream = io.BytesIO()
        log = Writer(stream, chunk_size=10)
        log.start()
        used = log.register_channel("/used", "cdr", 0)
        log.add_message(used, 1, b"x", 1)
        # Stands in the second of three chunks, which need not be opened to index the log.
        silent = log.register_channel("/silent", "cdr", 0)
        log.add_message(used, 2, b"x" * 20, 2)
        log.add_message(used, 3, b"x", 3)
        log.finish()  # type: ignore[no-untyped-call]
        whole = stream.getvalue()
        source = written(tmp_path / "log.mcap", whole[: data_end(whole)])
        data = extend(source, tmp_path / "out.mcap")
        channels = summary_of(data).channels
        assert silent not in channels
        assert channels[max(channels)].topic == NEW.topic
        assert max(channels) >= 1 << 15

    def test_kernel_copy_is_not_needed(
        self, source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        by_kernel = extend(source, tmp_path / "a.mcap")

        def refuse(*_: object, **__: object) -> int:
            raise OSError(errno.EXDEV, "cross-device")

        monkeypatch.setattr(os, "copy_file_range", refuse)
        assert extend(source, tmp_path / "b.mcap") == by_kernel

    def test_progress(self, source: Path, tmp_path: Path) -> None:
        calls: list[tuple[int, int]] = []
        with (
            LogReader.open(source) as reader,
            LogWriter(
                tmp_path / "out.mcap",
                source=reader,
                progress=lambda done, total: calls.append((done, total)),
            ),
        ):
            pass
        end = data_end(source.read_bytes())
        assert calls[-1] == (end, end)


class TestDamagedSources:
    @pytest.mark.parametrize("kind", ["zstd", "uncompressed", "unchunked", "no_message_index"])
    def test_cut_anywhere(self, kind: str, tmp_path: Path) -> None:
        whole = log_bytes(kind)
        for length in range(8, len(whole), 173):
            source = written(tmp_path / "log.mcap", whole[:length])
            with LogReader.open(source) as reader:
                readable = messages_of(reader)
            data = extend(source, tmp_path / "out.mcap", overwrite=True)
            assert reference_messages(data) == sorted([*readable, NEW])
            with LogReader.open(tmp_path / "out.mcap") as again:
                assert again.indexed
                assert again.verify() == ()

    def test_bytes_that_are_no_records_are_left_out(self, tmp_path: Path) -> None:
        whole = log_bytes("zstd")
        place = chunks_of(whole)[3].chunk_start_offset
        source = written(tmp_path / "log.mcap", whole[:place] + b"\xff" * 999 + whole[place:])
        data = extend(source, tmp_path / "out.mcap")
        assert reference_messages(data) == sorted([*ALL_MESSAGES, NEW])
        attachments = make_reader(io.BytesIO(data)).iter_attachments()
        assert [a.name for a in attachments] == ["first.txt", "second.txt", "mclass.yaml"]
        with LogReader.open(tmp_path / "out.mcap") as reader:
            assert reader.indexed
            assert reader.verify() == ()

    def test_damaged_chunk_stays_as_it_is(self, tmp_path: Path) -> None:
        broken = bytearray(log_bytes("zstd"))
        target = chunks_of(bytes(broken))[2]
        broken[target.chunk_start_offset + target.chunk_length - 5] ^= 4
        data = extend(written(tmp_path / "log.mcap", bytes(broken)), tmp_path / "out.mcap")
        end = data_end(bytes(broken))
        assert data[:end] == broken[:end]
        with LogReader.open(tmp_path / "out.mcap") as reader:
            found = Counter(messages_of(reader))
            assert reader.damage.chunks == 1
        assert found[NEW] == 1
        assert sum(found.values()) == len(ALL_MESSAGES) + 1 - reader.damage.messages

    def test_log_without_header_gets_one(self, tmp_path: Path) -> None:
        body = log_bytes("zstd")
        (length,) = struct.unpack_from("<Q", body, 9)
        source = written(tmp_path / "log.mcap", MAGIC + body[8 + 9 + length :])
        data = extend(source, tmp_path / "out.mcap")
        assert make_reader(io.BytesIO(data)).get_header().library == "mclass"
        assert reference_messages(data) == sorted([*ALL_MESSAGES, NEW])

    def test_messages_of_undefined_channels_are_left_out(self, tmp_path: Path) -> None:
        def loose(channel: int) -> bytes:
            content = struct.pack("<HIQQ", channel, 0, 1, 1) + b"x"
            return struct.pack("<BQ", 5, len(content)) + content

        schema = record_bytes(Schema(id=1, name="A", encoding="ros2msg", data=b"x"))
        definitions = schema + record_bytes(Channel(1, "/a", "cdr", {}, 1))
        source = written(tmp_path / "log.mcap", MAGIC + definitions + loose(1) + loose(9))
        data = extend(source, tmp_path / "out.mcap")
        assert reference_messages(data) == sorted([Message("/a", 1, b"x"), NEW])


class TestNewLogs:
    @settings(
        max_examples=30,
        deadline=2000,
        suppress_health_check=[HealthCheck.function_scoped_fixture],
    )
    @given(
        messages=st.lists(
            st.builds(
                Message,
                st.sampled_from(["/a", "/ü", ""]),
                st.integers(0, (1 << 63) - 1),
                st.binary(max_size=50)
                | st.binary(min_size=1, max_size=1).map(lambda b: b * 600_000),
            ),
            max_size=12,
        )
    )
    def test_read_back(self, messages: list[Message], tmp_path: Path) -> None:
        path = tmp_path / "out.mcap"
        path.unlink(missing_ok=True)
        data = create(path, messages)
        assert reference_messages(data) == sorted(messages)
        with LogReader.open(path) as reader:
            assert messages_of(reader) == sorted(messages)
            assert reader.verify() == ()

    def test_empty_log(self, tmp_path: Path) -> None:
        data = create(tmp_path / "out.mcap", [])
        assert make_reader(io.BytesIO(data)).get_header().profile == "ros2"
        assert reference_messages(data) == []

    def test_channel_without_messages_is_kept(self, tmp_path: Path) -> None:
        with LogWriter(tmp_path / "out.mcap") as writer:
            writer.add_channel("/silent", "json", "", "", b"")
        summary = summary_of((tmp_path / "out.mcap").read_bytes())
        assert [c.topic for c in summary.channels.values()] == ["/silent"]
        assert summary.schemas == {}

    def test_chunks_of_about_a_mebibyte(self, tmp_path: Path) -> None:
        messages = [Message("/a", n, bytes(10_000)) for n in range(300)]
        messages.insert(150, Message("/a", 999, bytes(3_000_000)))
        sizes = [c.uncompressed_size for c in chunks_of(create(tmp_path / "out.mcap", messages))]
        assert [round(size / 1e6) for size in sizes] == [1, 0, 3, 1, 0]
        assert max(size for size in sizes if size < 2e6) <= 1 << 20

    def test_same_calls_same_bytes(self, source: Path, tmp_path: Path) -> None:
        messages = [Message(f"/{n % 3}", n, b"x" * n) for n in range(100)]
        assert create(tmp_path / "a", messages) == create(tmp_path / "b", messages)
        assert extend(source, tmp_path / "c") == extend(source, tmp_path / "d")

    def test_checksum_of_the_data(self, tmp_path: Path) -> None:
        data = create(tmp_path / "out.mcap", ALL_MESSAGES)
        assert struct.unpack_from("<I", data, data_end(data) + 9) != (0,)
        reader = NonSeekingReader(io.BytesIO(data), validate_crcs=True)
        assert len(list(reader.iter_messages())) == len(ALL_MESSAGES)

    def test_sequence_and_publish_time(self, tmp_path: Path) -> None:
        with LogWriter(tmp_path / "out.mcap") as writer:
            channel = writer.add_channel("/a", "json", "", "", b"")
            writer.write(channel, 5, b"x")
            writer.write(channel, 6, b"y", publish_time_ns=3)
        reader = make_reader(io.BytesIO((tmp_path / "out.mcap").read_bytes()))
        found = [(m.sequence, m.log_time, m.publish_time) for _, _, m in reader.iter_messages()]
        assert found == [(0, 5, 5), (1, 6, 3)]

    @pytest.mark.parametrize("log_time", [-1, 1 << 64])
    def test_impossible_times(self, log_time: int, tmp_path: Path) -> None:
        with (
            pytest.raises(LogError, match="MCAP times start at 1970"),
            LogWriter(tmp_path / "out.mcap") as writer,
        ):
            writer.write(writer.add_channel("/a", "json", "", "", b""), log_time, b"x")
        assert list(tmp_path.iterdir()) == []


class TestAllOrNothing:
    @pytest.mark.parametrize("kind", [ValueError, KeyboardInterrupt, SystemExit])
    def test_exception_leaves_nothing(
        self, kind: type[BaseException], source: Path, tmp_path: Path
    ) -> None:
        with (
            pytest.raises(kind),
            LogReader.open(source) as reader,
            LogWriter(tmp_path / "out.mcap", source=reader),
        ):
            raise kind
        assert list(tmp_path.iterdir()) == [source]

    def test_nothing_under_the_name_before_the_end(self, source: Path, tmp_path: Path) -> None:
        with LogReader.open(source) as reader, LogWriter(tmp_path / "out.mcap", source=reader):
            names = {path.name for path in tmp_path.iterdir()}
        assert names == {"log.mcap", f".out.mcap.part-{os.getpid()}"}
        assert {path.name for path in tmp_path.iterdir()} == {"log.mcap", "out.mcap"}

    def test_part_of_a_killed_run_is_no_obstacle(self, source: Path, tmp_path: Path) -> None:
        written(tmp_path / f".out.mcap.part-{os.getpid()}", b"left")
        extend(source, tmp_path / "out.mcap")

    def test_existing_output_is_kept(self, source: Path, tmp_path: Path) -> None:
        output = written(tmp_path / "out.mcap", b"precious")
        with pytest.raises(LogError, match="exists already"), LogReader.open(source) as reader:
            LogWriter(output, source=reader)
        assert output.read_bytes() == b"precious"

    @pytest.mark.parametrize("links", [True, False])
    def test_output_that_appears_meanwhile_is_kept(
        self, *, links: bool, source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def no_links(*_: object) -> None:
            raise OSError(errno.EPERM, "no hard links here")

        if not links:
            monkeypatch.setattr(os, "link", no_links)
        output = tmp_path / "out.mcap"
        with (
            pytest.raises(LogError, match="exists already"),
            LogReader.open(source) as reader,
            LogWriter(output, source=reader),
        ):
            output.write_bytes(b"precious")
        assert output.read_bytes() == b"precious"
        assert sorted(tmp_path.iterdir()) == [source, output]

    def test_file_systems_without_hard_links(
        self, source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def no_links(*_: object) -> None:
            raise OSError(errno.EPERM, "no hard links here")

        monkeypatch.setattr(os, "link", no_links)
        assert NEW in reference_messages(extend(source, tmp_path / "out.mcap"))

    def test_overwrite_replaces_at_the_end_only(self, source: Path, tmp_path: Path) -> None:
        output = written(tmp_path / "out.mcap", b"old")
        with (
            LogReader.open(source) as reader,
            LogWriter(output, source=reader, overwrite=True),
        ):
            assert output.read_bytes() == b"old"
        assert reference_messages(output.read_bytes()) == ALL_MESSAGES

    def test_overwriting_through_a_link_replaces_its_target(
        self, source: Path, tmp_path: Path
    ) -> None:
        target = written(tmp_path / "target.mcap", b"old")
        link = tmp_path / "out.mcap"
        link.symlink_to(target)
        extend(source, link, overwrite=True)
        assert link.is_symlink()
        assert NEW in reference_messages(target.read_bytes())

    @pytest.mark.parametrize("how", ["same", "symbolic", "hard"])
    def test_input_is_never_the_output(self, how: str, source: Path, tmp_path: Path) -> None:
        output = source
        if how == "symbolic":
            output = tmp_path / "link.mcap"
            output.symlink_to(source)
        elif how == "hard":
            output = tmp_path / "link.mcap"
            output.hardlink_to(source)
        before = source.read_bytes()
        with LogReader.open(source) as reader, pytest.raises(LogError, match="the input itself"):
            LogWriter(output, source=reader, overwrite=True)
        assert source.read_bytes() == before

    @pytest.mark.parametrize(
        ("output", "sentence"),
        [("missing/out.mcap", "there is no folder"), (".", "no file"), ("a\0b", "file name")],
    )
    def test_impossible_outputs(self, output: str, sentence: str, tmp_path: Path) -> None:
        with pytest.raises(LogError, match=sentence):
            LogWriter(tmp_path / output)

    def test_devices_are_not_replaced(self) -> None:
        with pytest.raises(LogError, match="no file"):
            LogWriter("/dev/null", overwrite=True)

    @pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
    def test_read_only_folder(self, tmp_path: Path) -> None:
        tmp_path.chmod(0o500)
        try:
            with (
                pytest.raises(LogError, match="permission denied"),
                LogWriter(tmp_path / "out.mcap"),
            ):
                pass
        finally:
            tmp_path.chmod(0o700)

    @pytest.mark.parametrize("in_kernel", [True, False])
    def test_file_too_large(
        self,
        *,
        in_kernel: bool,
        source: Path,
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        if not in_kernel:
            monkeypatch.delattr(os, "copy_file_range")
        limits = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (2000, limits[1]))
        try:
            with pytest.raises(LogError, match="file too large"):
                extend(source, tmp_path / "out.mcap")
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        assert list(tmp_path.iterdir()) == [source]

    def test_full_disk(self, source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        def full(_: int) -> None:
            raise OSError(errno.ENOSPC, "No space left on device")

        monkeypatch.setattr(os, "fsync", full)
        with pytest.raises(LogError, match=r"no space left.*Make room"):
            extend(source, tmp_path / "out.mcap")
        assert list(tmp_path.iterdir()) == [source]

    def test_disk_that_is_full_before_the_end(
        self, source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        flush = os.fsync
        told: list[int] = []

        def full_once(file: int) -> None:
            if not told:
                told.append(file)
                raise OSError(errno.ENOSPC, "No space left on device")
            flush(file)

        monkeypatch.setattr(os, "fsync", full_once)
        monkeypatch.setattr(pending, "_FLUSHED_EARLY", 1)
        with pytest.raises(LogError, match=r"no space left.*Make room"):
            extend(source, tmp_path / "out.mcap")
        assert list(tmp_path.iterdir()) == [source]

    def test_early_flush_changes_nothing(
        self, source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        extend(source, tmp_path / "late.mcap")
        monkeypatch.setattr(pending, "_FLUSHED_EARLY", 1)
        extend(source, tmp_path / "early.mcap")
        assert (tmp_path / "early.mcap").read_bytes() == (tmp_path / "late.mcap").read_bytes()

    def test_source_that_shrinks(
        self, source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.delattr(os, "copy_file_range")
        with LogReader.open(source) as reader:
            os.truncate(source, 1000)
            with (
                pytest.raises(LogError, match="became shorter"),
                LogWriter(tmp_path / "out.mcap", source=reader),
            ):
                pass
        assert list(tmp_path.iterdir()) == [source]


KILLED = """
import sys
from mclass.logs.reader import LogReader
from mclass.logs.writer import LogWriter
print("ready", flush=True)
while True:
    with LogReader.open(sys.argv[1]) as reader:
        with LogWriter(sys.argv[2], source=reader, overwrite=True) as writer:
            channel = writer.add_channel("/x", "json", "", "", b"")
            for time in range(2000):
                writer.write(channel, time, b"0123456789")
"""


class TestKill:
    @pytest.mark.parametrize(
        "times", [4, pytest.param(200, marks=pytest.mark.slow)], ids=["few", "many"]
    )
    def test_output_is_whole_or_not_there(
        self, times: int, source: Path, tmp_path: Path, rng: np.random.Generator
    ) -> None:
        before = source.read_bytes()
        output = tmp_path / "out.mcap"
        for _ in range(times):
            output.unlink(missing_ok=True)
            run = [sys.executable, "-c", KILLED, str(source), str(output)]
            with subprocess.Popen(run, stdout=subprocess.PIPE) as process:
                assert process.stdout is not None
                process.stdout.readline()
                time.sleep(rng.uniform(0, 0.05))
                process.send_signal(signal.SIGKILL)
            if output.exists():
                with LogReader.open(output) as reader:
                    assert reader.verify() == ()
                    assert reader.message_count == len(ALL_MESSAGES) + 2000
        assert source.read_bytes() == before
