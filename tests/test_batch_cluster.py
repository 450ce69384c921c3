"""A batch on a Dask cluster on this machine, one of whose workers is killed in mid-run."""

from __future__ import annotations

import contextlib
import shutil
import signal
import socket
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from mclass.batch.cluster import on_cluster
from mclass.batch.record import LogResult, read_results
from mclass.batch.run import Executor, run_batch
from mclass.batch.work import Estimation
from mclass.commands.cli import main
from mclass.config.model_file import parse_model
from mclass.outputs.readback import OutputLog

distributed: Any = pytest.importorskip("distributed")

ROOT = Path(__file__).parent.parent
MODEL = (
    (ROOT / "configs" / "paper_toy.yaml")
    .read_text()
    .replace("{cell_size: 1, orientation_bins: 360,", "{cell_size: 10, orientation_bins: 8,")
)
LOGS = 16


@contextlib.contextmanager
def dask(*arguments: str, folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    process = subprocess.Popen(
        [sys.executable, "-m", "dask", *arguments],
        cwd=folder,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait()


@pytest.mark.slow
def test_a_killed_worker_loses_no_log_and_doubles_none(tmp_path: Path) -> None:
    logs, out = tmp_path / "logs", tmp_path / "out"
    logs.mkdir()
    for index in range(LOGS):
        shutil.copy(ROOT / "sample_logs" / "paper_toy.mcap", logs / f"{index}.mcap")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
    scheduler = ("scheduler", "--host", address, "--no-dashboard")
    worker = ("worker", address, "--nthreads", "1", "--no-nanny", "--no-dashboard")
    finished: list[str] = []
    with (
        dask(*scheduler, folder=tmp_path),
        dask(*worker, folder=tmp_path) as victim,
        dask(*worker, folder=tmp_path),
    ):
        executor = executor_of(address)

        def kill_one(done: int, total: int, result: LogResult | None) -> None:
            assert total == LOGS
            finished.extend([result.name] if result else [])
            if done == 4:
                victim.send_signal(signal.SIGKILL)

        work = Estimation(parse_model(MODEL, "toy.yaml"))
        report = run_batch([str(logs)], out, work, executor=executor, progress=kill_one)
        assert victim.wait(10) == -signal.SIGKILL
    assert report.exit_code == 0, report.results
    assert Counter(finished) == Counter(str(index) for index in range(LOGS))
    entries = read_results(out / "results.json")
    assert [entry.status for entry in entries] == ["done"] * LOGS
    assert {path.name for path in out.iterdir()} == {
        "results.json",
        *(entry.output for entry in entries),
    }
    for entry in entries:
        with OutputLog.open(out / entry.output) as output:
            assert output.metadata["input_hash"] == entry.input_hash


def executor_of(address: str) -> Executor:
    """The executor, once the cluster has two workers."""
    with distributed.Client(address, timeout="60s", set_as_default=False) as client:
        client.wait_for_workers(2, timeout=60)
    return on_cluster(address)


def test_a_cluster_that_is_not_there_is_wrong_usage(tmp_path: Path) -> None:
    log = ROOT / "sample_logs" / "paper_toy.mcap"
    arguments = ["batch", str(log), "-o", str(tmp_path / "out"), "--dask", "nonsense://x"]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 2
    assert "no Dask scheduler answers at nonsense://x" in result.stderr
    assert CliRunner().invoke(main, [*arguments, "-j", "2"]).exit_code == 2
