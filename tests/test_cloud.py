"""Logs by URL: a real S3 server and web servers on this machine, which count what they send."""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result
from stores import S3, SECRET, Web, s3_server, web_server

import mclass
from mclass.batch.plan import find_logs, plan
from mclass.batch.record import read_results
from mclass.commands.cli import main
from mclass.logs import remote, stores
from mclass.logs.reader import LogReader
from mclass.logs.remote import RemoteSource
from mclass.logs.stores import Store
from mclass.logs.writer import LogWriter
from mclass.places import Url, place_of

ROOT = Path(__file__).parent.parent
LAB = ROOT / "sample_logs" / "cas_lab.mcap"
TOY = ROOT / "sample_logs" / "paper_toy.mcap"

IMAGES, IMAGE_BYTES = 24, 1_200_000
HEAD, TAIL, BLOCK = 1 << 12, 1 << 17, 1 << 12
"""What opening a log costs, and a small read beside."""


def with_images(path: Path) -> Path:
    """The sample log, and between its messages images that fill a chunk each."""
    rng = np.random.default_rng(5)
    with LogReader.open(LAB) as reader, LogWriter(path, profile="ros2") as writer:
        ids = {
            channel.id: writer.add_channel(
                channel.topic,
                channel.message_encoding,
                channel.schema_name,
                channel.schema_encoding,
                channel.schema_data,
            )
            for channel in reader.channels
        }
        camera = writer.add_channel("/image", "cdr", "sensor_msgs/msg/Image", "ros2msg", b"")
        messages = [
            (int(time), batch.channel.id, bytes(batch.buffer[start : start + length]))
            for batch in reader.batches(ids)
            for time, start, length in zip(
                batch.log_times_ns, batch.offsets, batch.lengths, strict=True
            )
        ]
        messages.sort(key=lambda message: message[0])
        for place, (time, channel, data) in enumerate(messages):
            writer.write(ids[channel], time, data)
            if place % (len(messages) // IMAGES) == 0:
                writer.write(camera, time, rng.bytes(IMAGE_BYTES))
        model = reader.attachment("mclass.yaml")
        assert model is not None
        writer.attach("mclass.yaml", "text/yaml", model, messages[-1][0])
    return path


def needed_bytes(path: Path) -> int:
    """Of the chunks that hold anything but images, with their message indexes."""
    with LogReader.open(path) as reader:
        (image,) = (c.id for c in reader.channels if c.topic == "/image")
        chunks = [e for e in reader.index.chunks if (e.counts or {}).keys() - {image}]
        assert len(reader.index.chunks) - len(chunks) >= IMAGES
        return sum(entry.length + entry.index_length for entry in chunks)


@pytest.fixture(scope="module")
def s3() -> Iterator[S3]:
    with s3_server() as server:
        server.client().create_bucket(Bucket="fleet")
        yield server


@pytest.fixture(autouse=True)
def _no_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stores, "_PAUSE_S", 0.0)
    monkeypatch.setattr("s3fs.S3FileSystem.retries", 1)


@pytest.fixture
def web() -> Iterator[Web]:
    with web_server() as server:
        yield server


@pytest.fixture(scope="module")
def big(tmp_path_factory: pytest.TempPathFactory, s3: S3) -> Path:
    path = with_images(tmp_path_factory.mktemp("big") / "big.mcap")
    s3.put("fleet", "big.mcap", path.read_bytes())
    return path


def command(*arguments: object) -> Result:
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


def objects_of(result: Result) -> list[dict[str, Any]]:
    assert result.exit_code == 0, result.output
    objects: list[dict[str, Any]] = json.loads(result.stdout)["objects"]
    return objects


# What is fetched.


def test_only_summary_and_needed_chunks_are_fetched(s3: S3, big: Path, tmp_path: Path) -> None:
    needed = needed_bytes(big)
    size = big.stat().st_size
    assert size > IMAGES * IMAGE_BYTES
    s3.ledger.clear()
    out = tmp_path / "new.mcap"
    arguments = ("--only-new", "--format", "json")
    result = command("estimate", "s3://fleet/big.mcap", "-o", out, *arguments)
    # Head and end of the log, a block for each place that nobody announced, and the chunks.
    bound = HEAD + TAIL + 4 * BLOCK + needed
    assert bound < size / 50
    assert needed < s3.ledger.sent() <= bound
    local = command("estimate", big, "-o", tmp_path / "local.mcap", *arguments)
    assert objects_of(result) == objects_of(local)
    with mclass.OutputLog.open(out) as log:
        assert log.metadata["input_hash"].startswith("etag:")
        assert json.loads(log.metadata["settings"])["input"] == "big.mcap"


def test_inspecting_fetches_no_image(s3: S3, big: Path) -> None:
    s3.ledger.clear()
    shown = command("inspect", "log", "s3://fleet/big.mcap")
    assert shown.exit_code == 0, shown.output
    assert s3.ledger.sent() <= HEAD + TAIL + 4 * BLOCK + needed_bytes(big)
    local = command("inspect", "log", big)
    assert shown.stdout.replace("s3://fleet/big.mcap", str(big)).split() == local.stdout.split()


def test_a_copy_reads_every_byte_once_more(s3: S3, big: Path, tmp_path: Path) -> None:
    s3.ledger.clear()
    output = "s3://fleet/copies/out.mcap"
    result = command("estimate", "s3://fleet/big.mcap", "-o", output, "--format", "json")
    assert json.loads(result.stdout)["output"] == output
    # What was just fetched is still there; only of large logs chunks come twice.
    assert s3.ledger.sent() <= big.stat().st_size + HEAD + TAIL + 4 * BLOCK + needed_bytes(big)
    here = tmp_path / "here.mcap"
    here.write_bytes(s3.get("fleet", "copies/out.mcap"))
    with LogReader.open(here) as copy, LogReader.open(big) as log:
        assert copy.verify() == ()
        end = log.index.data_end
        assert copy.source.read(0, end) == log.source.read(0, end)
        assert {channel.topic for channel in log.channels} < {c.topic for c in copy.channels}
    found = command("inspect", "objects", output, "--format", "json")
    assert objects_of(found) == objects_of(command("inspect", "objects", here, "--format", "json"))


def test_pieces_join_neighbours_and_cut_what_is_long() -> None:
    piece, gap = remote._PIECE, remote._GAP
    far = 10 * piece
    assert remote._pieces([(0, 10), (10 + gap, 20 + gap)], far) == [(0, 20 + gap)]
    assert remote._pieces([(0, 10), (11 + gap, 20 + gap)], far) == [(0, 10), (11 + gap, 20 + gap)]
    long = [(5, piece), (piece, 2 * piece + 7)]
    assert remote._pieces(long, far) == [(5, piece), (piece, 2 * piece), (2 * piece, 2 * piece + 7)]
    assert remote._pieces([(-5, 3), (2, 9), (90, 200)], 100) == [(0, 100)]
    assert remote._pieces([(3, 3), (150, 200)], 100) == []


class Recorder:
    """A store that holds numbers, and writes down what was asked for."""

    def __init__(self, size: int) -> None:
        self.data = np.random.default_rng(1).bytes(size)
        self.asked: list[tuple[int, int]] = []

    def read(self, start: int, stop: int) -> bytes:
        self.asked.append((start, stop))
        return self.data[start:stop]


def source_of(store: Recorder) -> RemoteSource:
    return RemoteSource(store, "log", len(store.data), "v")  # type: ignore[arg-type]


def test_any_read_gives_the_bytes_that_are_there(rng: np.random.Generator) -> None:
    store = Recorder(40_000_000)
    source = source_of(store)
    try:
        starts = np.sort(rng.integers(0, 40_000_000, 30))
        source.expect([(int(s), int(s) + 900_000) for s in starts])
        for _ in range(300):
            start = int(rng.integers(0, 40_100_000))
            length = int(rng.choice([1, 37, 5_000, 1_000_000, 9_000_000]))
            take = source.peek if length < 100 else source.read
            assert take(start, length)[:length] == store.data[start : start + length]
        assert max(stop - start for start, stop in store.asked) <= remote._PIECE
        kept = [future.result() for future in source._fetched.values()]
        assert sum(map(len, kept)) <= remote._KEPT
    finally:
        source.close()


def test_small_reads_straight_on_take_larger_and_larger_blocks() -> None:
    store = Recorder(30_000_000)
    source = source_of(store)
    try:
        for offset in range(1_000_000, 21_000_000, 1_000):
            assert source.read(offset, 9) == store.data[offset : offset + 9]
    finally:
        source.close()
    # 4 KiB, 8 KiB, ... 8 MiB and on: 12 doublings, and the rest in a few steps.
    assert len(store.asked) < 16
    assert sum(stop - start for start, stop in store.asked) < 30_000_000


# Outputs.


def test_an_output_is_not_replaced_and_not_left_half(
    s3: S3, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    there = s3.put("fleet", "there.mcap", b"mine")
    refused = command("estimate", LAB, "-o", there)
    assert refused.exit_code == 1
    assert f"{there}: exists already" in refused.stderr
    itself = command("estimate", s3.put("fleet", "in.mcap", LAB.read_bytes()), "--overwrite",
                     "-o", "s3://fleet/in.mcap")  # fmt: skip
    assert itself.exit_code == 1
    assert "is the input itself" in itself.stderr
    assert s3.get("fleet", "there.mcap") == b"mine"
    assert command("estimate", LAB, "-o", there, "--overwrite").exit_code == 0
    assert s3.get("fleet", "there.mcap")[:5] == b"\x89MCAP"

    # The store fails when the output is whole: nothing is there, nor any temporary file.
    monkeypatch.setattr(s3, "failing", lambda method, path: method in ("PUT", "POST"))
    failed = command("estimate", LAB, "-o", "s3://fleet/half.mcap")
    assert failed.exit_code == 1
    assert "s3://fleet/half.mcap: cannot be reached" in failed.stderr
    monkeypatch.setattr(s3, "failing", lambda method, path: False)
    assert "half.mcap" not in s3.keys("fleet")
    assert list(tmp_path.iterdir()) == []


def test_results_that_appear_meanwhile_are_kept(s3: S3) -> None:
    def raced() -> None:
        with LogWriter("s3://fleet/raced.mcap") as writer:
            writer.attach("name", "text/plain", b"data", 5)
            s3.put("fleet", "raced.mcap", b"theirs")

    with pytest.raises(mclass.LogError, match="exists already"):
        raced()
    assert s3.get("fleet", "raced.mcap") == b"theirs"


def test_fuse_and_evaluate_by_url(s3: S3, tmp_path: Path) -> None:
    url = "s3://fleet/results/lab.mclass.mcap"
    assert command("estimate", LAB, "-o", url).exit_code == 0
    scores = command("evaluate", url, "--format", "json")
    assert scores.exit_code == 0, scores.output
    fused = command("fuse", url, "-o", "s3://fleet/map.mcap", "--format", "json")
    objects = objects_of(fused)
    assert objects == objects_of(
        command("inspect", "objects", "s3://fleet/map.mcap", "--format", "json")
    )
    page = command("report", url, "-o", tmp_path / "page.html")
    assert page.exit_code == 0, page.output
    itself = command("fuse", url, "-o", url, "--overwrite")
    assert itself.exit_code == 2
    assert "never changed" in itself.stderr


# Many logs.


@pytest.mark.slow
def test_batch_from_bucket_to_bucket(s3: S3, tmp_path: Path) -> None:
    for name in ("a/lab.mcap", "b/lab.mcap", "old.mclass.mcap", "notes.txt"):
        s3.put("fleet", f"logs/{name}", LAB.read_bytes())
    folder = "s3://fleet/logs/out"
    arguments = ("batch", "s3://fleet/logs", "-o", folder, "-j", "1", "--format", "json")
    first = command(*arguments)
    assert first.exit_code == 0, first.output
    done = json.loads(first.stdout)["results"]
    assert [entry["input"] for entry in done] == [
        "s3://fleet/logs/a/lab.mcap",
        "s3://fleet/logs/b/lab.mcap",
    ]
    assert [entry["output"] for entry in done] == ["lab.mclass.mcap", "lab-2.mclass.mcap"]
    outputs = sorted(key for key in s3.keys("fleet") if key.startswith("logs/out/"))
    assert outputs == [
        "logs/out/lab-2.mclass.mcap",
        "logs/out/lab.mclass.mcap",
        "logs/out/results.json",
    ]
    assert len(read_results(place_of(f"{folder}/results.json"))) == 2

    # Only what changed is done again.
    s3.put("fleet", "logs/b/lab.mcap", TOY.read_bytes())
    again = json.loads(command(*arguments, "--baseline", f"{folder}/results.json").stdout)
    assert [entry["reused"] for entry in again["results"]] == [True, False]
    jobs = plan(find_logs(["s3://fleet/logs/?/l*.mcap"], tmp_path), tmp_path, (), overwrite=False)
    assert [str(job.log) for job in jobs] == [entry["input"] for entry in done]
    assert len(plan([LAB], place_of("s3://fleet/logs"), (), overwrite=False)) == 1
    nothing = command("batch", "s3://fleet/nothing/", "-o", tmp_path / "none")
    assert nothing.exit_code == 2
    assert "holds no .mcap logs" in nothing.stderr
    s3.put("fleet", "mine/cas_lab.mclass.mcap", b"mine")
    in_the_way = command("batch", LAB, "-o", "s3://fleet/mine")
    assert in_the_way.exit_code == 2
    assert "not from this batch" in in_the_way.stderr


# The web.


def test_a_web_server_sends_only_what_is_needed(web: Web, big: Path, tmp_path: Path) -> None:
    web.files["big.mcap"] = big.read_bytes()
    result = command("estimate", f"{web.address}/big.mcap", "-o", tmp_path / "out.mcap",
                     "--only-new", "--format", "json")  # fmt: skip
    assert web.ledger.sent() <= 1 + HEAD + TAIL + 4 * BLOCK + needed_bytes(big)
    found = mclass.estimate(big)
    assert [entry["id"] for entry in objects_of(result)] == list(found.object_ids)


def test_a_server_without_ranges_is_copied_first(web: Web, tmp_path: Path) -> None:
    web.ranges = False
    web.files["lab.mcap"] = LAB.read_bytes()
    shown = command("inspect", "log", f"{web.address}/lab.mcap", "--format", "json")
    assert json.loads(shown.stdout)["size"] == LAB.stat().st_size
    with LogReader.open(f"{web.address}/lab.mcap") as reader:
        assert reader.source.hash().startswith("sha256:")


def test_broken_answers_are_asked_for_again(web: Web) -> None:
    web.files["lab.mcap"] = LAB.read_bytes()
    web.failures = 2
    found = mclass.estimate(f"{web.address}/lab.mcap")
    np.testing.assert_array_equal(found.positions, mclass.estimate(LAB).positions)
    web.failures = 100
    with pytest.raises(mclass.LogError, match="cannot be reached: client payload"):
        mclass.estimate(f"{web.address}/lab.mcap")


def test_a_log_that_changes_is_refused(web: Web, big: Path) -> None:
    web.files["log.mcap"] = big.read_bytes()
    with LogReader.open(f"{web.address}/log.mcap") as reader:
        web.files["log.mcap"] = big.read_bytes()[:400_000]
        with pytest.raises(mclass.LogError, match=r"log\.mcap: .*(changed|cannot be reached)"):
            for _ in reader.batches(channel.id for channel in reader.channels):
                pass
        assert not reader.damage.any


def test_a_store_without_versions_leaves_no_hash(web: Web, tmp_path: Path) -> None:
    web.tagged = False
    web.files["lab.mcap"] = LAB.read_bytes()
    out = tmp_path / "out"
    for _ in range(2):
        done = command("batch", f"{web.address}/lab.mcap", "-o", out, "-j", "1", "--format", "json")
        assert done.exit_code == 0, done.output
        (entry,) = json.loads(done.stdout)["results"]
        assert entry["input_hash"] == ""
        assert entry["reused"] is False


@pytest.mark.slow
def test_over_tls(tmp_path: Path) -> None:
    pem, key = tmp_path / "server.pem", tmp_path / "key.pem"
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-keyout", key,
         "-out", pem, "-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost"],
        check=True,
        capture_output=True,
    )  # fmt: skip
    trusted = tmp_path / "trusted.pem"
    trusted.write_bytes(pem.read_bytes())
    pem.write_bytes(pem.read_bytes() + key.read_bytes())
    program = "from mclass.commands.cli import main; main()"
    with web_server(pem) as web:
        assert web.address.startswith("https://")
        web.files["lab.mcap"] = LAB.read_bytes()
        arguments = [sys.executable, "-c", program, "inspect", "log", f"{web.address}/lab.mcap"]
        environment = {**os.environ, "SSL_CERT_FILE": str(trusted)}
        done = subprocess.run(
            arguments, env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        assert f"{LAB.stat().st_size:,} bytes" in done.stdout
        # An unknown certificate is not waved through.
        done = subprocess.run(arguments, capture_output=True, text=True, check=False)
        assert done.returncode == 1
        assert "certificate" in done.stderr


# What goes wrong, and what is never shown.


@pytest.mark.parametrize(
    ("url", "code", "message"),
    [
        ("s3://fleet/none.mcap", 1, "s3://fleet/none.mcap: is not there. Check bucket and name."),
        ("s3://nowhere/none.mcap", 1, "is not there"),
        ("s3://fleet", 1, "is a folder"),
        ("ftp://host/log.mcap", 1, "ftp:// is no known kind of URL; known: s3://, gs://"),
        ("https://127.0.0.1:9/log.mcap", 1, "cannot be reached: client connector"),
    ],
)
def test_faults_of_inputs(s3: S3, url: str, code: int, message: str) -> None:
    for arguments in (["inspect", "log", url], ["estimate", url]):
        result = command(*arguments)
        assert result.exit_code == code
        assert message in result.stderr
        assert "Traceback" not in result.output
        assert len(result.stderr.splitlines()) == 1


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("s3://nowhere/out.mcap", "there is no bucket nowhere. Create it first."),
        ("s3://fleet/", "names no object"),
        ("http://localhost/out.mcap", "can only be read"),
        ("nosuch://bucket/out.mcap", "is no known kind of URL"),
    ],
)
def test_faults_of_outputs(s3: S3, url: str, message: str) -> None:
    result = command("estimate", LAB, "-o", url)
    assert result.exit_code == 1
    assert message in result.stderr


def test_a_url_is_not_appended_to() -> None:
    result = command("estimate", "s3://fleet/log.mcap", "--in-place")
    assert result.exit_code == 2
    assert "the log must be a file" in result.stderr


def test_the_web_is_not_listed(tmp_path: Path) -> None:
    result = command("batch", "http://127.0.0.1:9/logs/", "-o", tmp_path / "out", "-j", "1")
    assert result.exit_code == 1
    assert "cannot be reached" in result.stdout


def test_secrets_are_never_shown(web: Web, s3: S3, tmp_path: Path) -> None:
    web.files["private.mcap"] = LAB.read_bytes()
    signed = f"{web.address}/private.mcap?signature={SECRET}"
    shown = f"{web.address}/private.mcap?..."
    results = [
        command("inspect", "log", signed),
        command("estimate", signed, "-o", tmp_path / "out.mcap"),
        command("batch", signed, "-o", tmp_path / "batch", "-j", "1", "--format", "json"),
    ]
    for result in results:
        assert result.exit_code == 0, result.output
    assert shown in results[0].stdout
    wrong = signed + "x"
    with_user = signed.replace("//", f"//user:{SECRET}@").replace("private", "none")
    results += [
        command("inspect", "log", wrong),
        command("estimate", wrong),
        command("inspect", "log", with_user),
        command("batch", signed, wrong, "-o", tmp_path / "other"),
    ]
    assert "access is denied. Check the address and its signature." in results[-3].stderr
    assert "differ only behind the ?" in results[-1].stderr
    assert not any(SECRET in result.output for result in results)
    for path in tmp_path.rglob("*.*"):
        assert path.is_dir() or SECRET.encode() not in path.read_bytes(), path
    url = Url(signed)
    assert SECRET not in f"{url} {url!r} {Store(url)!r} {url.name}"


def test_what_libraries_log_is_not_printed(
    s3: S3, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(logging.getLogger(), "handlers", [])
    Store(Url("s3://fleet/log.mcap"))
    for name in ("s3fs", "gcsfs.core", "botocore.credentials"):
        logging.getLogger(name).warning("no key %s", SECRET)
    logging.getLogger("another").warning("said")
    assert capsys.readouterr().err == "said\n"


def test_places() -> None:
    signed = Url("https://user:word@host:1/a/b%20c.mcap?x=1#y")
    assert str(signed) == "https://host:1/a/b%20c.mcap?..."
    assert (signed.name, signed.stem) == ("b c.mcap", "b c")
    assert signed.with_name("d").address == "https://user:word@host:1/a/d"
    odd = Url("s3://bucket/a?b/c#d.mcap")
    assert (str(odd), odd.name) == (odd.address, "c#d.mcap")
    assert (Url("s3://bucket/logs/") / "x").address == "s3://bucket/logs/x"
    assert (Url("s3://bucket") / "x").address == "s3://bucket/x"
    assert place_of("s3://b/k") == Url("s3://b/k")
    assert place_of("C:/a.mcap") == Path("C:/a.mcap")
    assert place_of(Path("a")) == Path("a")
    assert place_of(signed) is signed


def test_without_the_extra_it_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for scheme, missing in (
        ("s3", "s3fs"),
        ("gs", "gcsfs"),
        ("https", "aiohttp"),
        ("s3", "fsspec"),
    ):
        with monkeypatch.context() as patch:
            patch.setitem(sys.modules, missing, None)
            if missing == "aiohttp":
                patch.setitem(sys.modules, "fsspec.implementations.http", None)
            # Kinds of stores are loaded once and kept.
            patch.delitem(sys.modules["fsspec.registry"]._registry, scheme, raising=False)
            result = command("inspect", "log", f"{scheme}://bucket/log.mcap")
        assert result.exit_code == 2, result.output
        assert f"{scheme}://bucket/log.mcap: URLs need more: pip install 'mclass[cloud]'" in (
            result.stderr
        )
