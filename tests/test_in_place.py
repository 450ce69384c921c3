"""Appending to a log itself: the same log as a copy would be, and the old one after any crash."""

from __future__ import annotations

import inspect
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import mclass
from mclass.errors import LogError, UsageError
from mclass.logs.in_place import journal_of, recover
from mclass.logs.reader import LogReader
from mclass.logs.writer import LogWriter

SAMPLE = Path(__file__).parents[1] / "sample_logs" / "paper_toy.mcap"


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """A small log that may be written to."""
    path = tmp_path / "drive.mcap"
    with LogWriter(path, profile="test") as writer:
        channel = writer.add_channel("/old", "json", "Old", "jsonschema", b"{}")
        for number in range(3):
            writer.write(channel, 10 + number, b'{"old": %d}' % number)
        writer.attach("notes", "text/plain", b"keep me", 5)
    return path


@pytest.fixture
def unflushed(monkeypatch: pytest.MonkeyPatch) -> None:
    """No waiting for the disk where thousands of files are only read again."""
    monkeypatch.setattr(os, "fsync", lambda _: None)


def append(path: Path, size: int = 40, *, fail: bool = False) -> None:
    with (
        LogReader.open(path) as reader,
        LogWriter(path, source=reader, in_place=True) as writer,
    ):
        channel = writer.add_channel("/new", "json", "New", "jsonschema", b"{}")
        for number in range(3):
            writer.write(channel, 20 + number, b"x" * size)
        if fail:
            raise RuntimeError("in the middle")


def messages(path: Path) -> dict[str, list[bytes]]:
    found: dict[str, list[bytes]] = {}
    with LogReader.open(path) as reader:
        assert not reader.damage.losses
        for batch in reader.batches([channel.id for channel in reader.channels]):
            found.setdefault(batch.channel.topic, []).extend(
                bytes(batch.buffer[offset : offset + length])
                for offset, length in zip(batch.offsets, batch.lengths, strict=True)
            )
    return found


def interrupted(path: Path) -> tuple[bytes, bytes, bytes, int]:
    """The old log, the new one, the journal, and where they part."""
    old = path.read_bytes()
    with LogReader.open(path) as reader:
        data_end = reader.index.data_end
    journals: list[bytes] = []

    def keep_and_delete(journal: Path) -> None:
        journals.append(journal.read_bytes())
        journal.unlink()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mclass.logs.in_place._delete", keep_and_delete)
        append(path)
    (journal,) = journals
    return old, path.read_bytes(), journal, data_end


def test_holds_what_a_copy_would(log: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy.mcap"
    with LogReader.open(log) as reader, LogWriter(copy, source=reader) as writer:
        channel = writer.add_channel("/new", "json", "New", "jsonschema", b"{}")
        for number in range(3):
            writer.write(channel, 20 + number, b"x" * 40)
    append(log)
    assert log.read_bytes() == copy.read_bytes()
    assert not journal_of(log).exists()


def test_estimate_in_place_equals_a_copy(tmp_path: Path) -> None:
    log = tmp_path / "drive.mcap"
    log.write_bytes(SAMPLE.read_bytes())
    mclass.estimate(log, output=tmp_path / "copy.mcap")
    mclass.estimate(log, in_place=True)
    assert log.read_bytes() == (tmp_path / "copy.mcap").read_bytes()
    with pytest.raises(LogError, match="topic /mclass"):
        mclass.estimate(log, in_place=True)
    with pytest.raises(UsageError, match="no output"):
        mclass.estimate(log, in_place=True, output=tmp_path / "other.mcap")


def test_only_new_holds_the_new_channels_alone(tmp_path: Path) -> None:
    log = tmp_path / "drive.mcap"
    log.write_bytes(SAMPLE.read_bytes())
    mclass.estimate(log, output=tmp_path / "both.mcap")
    mclass.estimate(log, output=tmp_path / "new.mcap", only_new=True)
    both, new = messages(tmp_path / "both.mcap"), messages(tmp_path / "new.mcap")
    assert new == {topic: both[topic] for topic in both if topic.startswith("/mclass/")}
    assert len(new) < len(both)
    with pytest.raises(LogError, match="never changed"):
        mclass.estimate(log, output=log, only_new=True, overwrite=True)


def test_an_error_restores_the_log(log: Path) -> None:
    old = log.read_bytes()
    with pytest.raises(RuntimeError, match="in the middle"):
        append(log, 3 << 20, fail=True)
    assert log.read_bytes() == old
    assert not journal_of(log).exists()


def test_a_crash_at_any_byte_of_the_append(log: Path, unflushed: None) -> None:
    old, new, journal, data_end = interrupted(log)
    assert len(new) > len(old)
    for written in range(data_end, len(new) + 1):
        log.write_bytes(new[:written] + old[written:])
        journal_of(log).write_bytes(journal)
        assert recover(log)
        assert log.read_bytes() == old
        assert not journal_of(log).exists()


def test_a_crash_with_writes_out_of_order(log: Path) -> None:
    old, new, journal, data_end = interrupted(log)
    generator = random.Random(1)
    for _ in range(50):
        hole = generator.randrange(data_end, len(new))
        end = generator.randrange(hole, len(new) + 1)
        log.write_bytes(new[:hole] + bytes(end - hole) + new[end:])
        journal_of(log).write_bytes(journal)
        with LogReader.open(log) as reader:
            assert [channel.topic for channel in reader.channels] == ["/old"]
        assert log.read_bytes() == old


def test_a_crash_while_the_journal_is_written(log: Path, unflushed: None) -> None:
    old, _, journal, _ = interrupted(log)
    log.write_bytes(old)
    for written in range(len(journal)):
        journal_of(log).write_bytes(journal[:written])
        assert recover(log)
        assert log.read_bytes() == old
        assert not journal_of(log).exists()


def test_a_journal_of_another_log_is_refused(log: Path, tmp_path: Path) -> None:
    _, _, journal, _ = interrupted(log)
    other = tmp_path / "other.mcap"
    other.write_bytes(SAMPLE.read_bytes())
    journal_of(other).write_bytes(journal)
    with pytest.raises(LogError, match="other content"):
        LogReader.open(other)
    assert other.read_bytes() == SAMPLE.read_bytes()


def test_two_runs_at_once(log: Path) -> None:
    with LogReader.open(log) as reader, LogWriter(log, source=reader, in_place=True):
        with pytest.raises(LogError, match="another run"):
            LogReader.open(log)
        with pytest.raises(LogError, match="another run"):
            LogWriter(log, source=reader, in_place=True).__enter__()
    assert list(messages(log)) == ["/old"]


def test_a_damaged_log_is_left_alone(log: Path) -> None:
    with LogReader.open(log) as reader:
        cut = log.read_bytes()[: reader.index.data_end - 5]
    log.write_bytes(cut)
    with pytest.raises(LogError, match="damaged"):
        append(log)
    assert log.read_bytes() == cut


@pytest.mark.slow
def test_killed_at_random_moments(log: Path) -> None:
    old = log.read_bytes()
    program = (
        "from __future__ import annotations\nimport sys; from pathlib import Path\n"
        "from mclass.logs.reader import LogReader; from mclass.logs.writer import LogWriter\n"
        f"{inspect.getsource(append)}\n"
        "print('ready', flush=True); append(Path(sys.argv[1]), 300_000)"
    )
    generator = random.Random(2)
    ends = {"old": 0, "new": 0}
    for _ in range(200):
        log.write_bytes(old)
        command = [sys.executable, "-c", program, str(log)]
        with subprocess.Popen(command, stdout=subprocess.PIPE) as child:
            assert child.stdout is not None
            child.stdout.readline()
            time.sleep(generator.uniform(0.0, 0.03))
            os.kill(child.pid, signal.SIGKILL)
        found = messages(log)
        assert found["/old"] == [b'{"old": 0}', b'{"old": 1}', b'{"old": 2}']
        if "/new" in found:
            assert found["/new"] == [b"x" * 300_000] * 3
            ends["new"] += 1
        else:
            assert log.read_bytes() == old
            ends["old"] += 1
        assert not journal_of(log).exists()
    assert min(ends.values()) > 0
