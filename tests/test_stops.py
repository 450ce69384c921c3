"""Processes that are stopped, disks that fail, and outputs in strange places."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from broken_runs import MODEL, WIDE, add_detections, carried_over, of_kind, read_whole, scene
from scene_logs import SceneLog, detection

from mclass.logs.reader import LogReader
from mclass.logs.writer import LogWriter

PROGRAM = "from mclass.commands.cli import main; main(prog_name='mclass')"
READY = 60.0


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A log whose estimate takes a moment."""

    def fill(log: SceneLog) -> None:
        add_detections(log)
        for number in range(40):
            found = [detection({"cup": 0.9}, WIDE, f"o{index}") for index in range(4)]
            log.detections(0.5 + number / 30, found)

    return of_kind(scene(tmp_path_factory.mktemp("sound") / "log.mcap", fill), "zstd")


@pytest.fixture
def folder(tmp_path: Path, sound: bytes) -> Path:
    """A folder with the log and its model file."""
    (tmp_path / "log.mcap").write_bytes(sound)
    (tmp_path / "mclass.yaml").write_text(MODEL)
    return tmp_path


def started(folder: Path, *words: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-c", PROGRAM, "estimate", "log.mcap", *words],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )


def finished(folder: Path, *words: str) -> tuple[int, str]:
    """Exit code and stderr of a whole run."""
    with started(folder, *words) as process:
        _, errors = process.communicate(timeout=READY)
    assert b"Traceback" not in errors
    return process.returncode, errors.decode()


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def wait_for_part(folder: Path, process: subprocess.Popen[bytes]) -> None:
    """Until the run has begun to write."""
    end = time.monotonic() + READY
    while process.poll() is None and time.monotonic() < end:
        if any(".part-" in name for name in names(folder)):
            return
        time.sleep(0.0005)


class TestStopped:
    """The files of a run that is stopped: none but the complete output, ever."""

    @pytest.mark.parametrize(
        "times", [2, pytest.param(200, marks=pytest.mark.slow)], ids=["few", "many"]
    )
    def test_killed_at_any_moment(
        self, times: int, folder: Path, sound: bytes, rng: np.random.Generator
    ) -> None:
        output = folder / "log.mclass.mcap"
        began = time.monotonic()
        assert finished(folder)[0] == 0
        duration = time.monotonic() - began
        expected = output.read_bytes()
        killed = 0
        for _ in range(times):
            output.unlink(missing_ok=True)
            with started(folder) as process:
                # Half of the kills hit where it is written, the others anywhere.
                if rng.uniform() < 0.5:
                    wait_for_part(folder, process)
                    time.sleep(rng.uniform(0.0, 0.2 * duration))
                else:
                    time.sleep(rng.uniform(0.0, 1.2 * duration))
                process.kill()
            killed += process.returncode == -signal.SIGKILL
            if output.exists():
                assert output.read_bytes() == expected
        assert (folder / "log.mcap").read_bytes() == sound
        assert killed > times // 4
        # The next run clears away what the killed ones left.
        assert finished(folder, "--overwrite")[0] == 0
        assert names(folder) == {"log.mcap", "mclass.yaml", "log.mclass.mcap"}

    @pytest.mark.parametrize(
        ("number", "code"),
        [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)],
    )
    def test_told_to_stop(
        self, number: signal.Signals, code: int, folder: Path, sound: bytes
    ) -> None:
        for _ in range(5):
            # A run that was done before the signal came has left it.
            (folder / "log.mclass.mcap").unlink(missing_ok=True)
            with started(folder) as process:
                wait_for_part(folder, process)
                process.send_signal(number)
                _, errors = process.communicate(timeout=READY)
            if process.returncode == code:
                break
        assert process.returncode == code
        assert errors.decode().startswith("Error: ")
        assert names(folder) == {"log.mcap", "mclass.yaml"}
        assert (folder / "log.mcap").read_bytes() == sound

    def test_what_is_ignored_stays_ignored(self, folder: Path) -> None:
        """As with nohup."""
        words = ["sh", "-c", 'trap "" HUP; exec "$@"', "sh", sys.executable, "-c", PROGRAM]
        with subprocess.Popen(
            [*words, "estimate", "log.mcap"], cwd=folder, stdout=subprocess.DEVNULL
        ) as process:
            wait_for_part(folder, process)
            process.send_signal(signal.SIGHUP)
            assert process.wait(READY) == 0
        assert (folder / "log.mclass.mcap").exists()


class TestLeftovers:
    def test_parts_of_killed_runs_are_cleared_away(self, folder: Path) -> None:
        (folder / ".log.mclass.mcap.part-1").write_bytes(b"left")
        (folder / ".log.mclass.mcap.part-999999999-3").write_bytes(b"left")
        (folder / ".other.mcap.part-1").write_bytes(b"of another output")
        assert finished(folder)[0] == 0
        assert names(folder) == {
            "log.mcap",
            "mclass.yaml",
            "log.mclass.mcap",
            ".other.mcap.part-1",
        }

    def test_parts_of_runs_at_work_are_left_alone(self, folder: Path) -> None:
        with LogReader.open(folder / "log.mcap") as reader:
            output = folder / "log.mclass.mcap"
            with LogWriter(output, source=reader, overwrite=True):
                assert finished(folder, "--overwrite")[0] == 0
            # Both were complete; the last one to end stays.
            with LogReader.open(output) as written:
                assert written.verify() == ()
                assert not any(c.topic.startswith("/mclass") for c in written.channels)
        assert names(folder) == {"log.mcap", "mclass.yaml", "log.mclass.mcap"}


@contextlib.contextmanager
def small_disk(place: Path, size: int) -> Iterator[Path]:
    """A file system of its own, if this user may make one."""
    place.mkdir()
    options = ["-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(place)]
    if subprocess.run(["mount", *options], capture_output=True, check=False).returncode:
        pytest.skip("may not mount a file system")
    try:
        yield place
    finally:
        subprocess.run(["umount", str(place)], check=True)


POWERLESS = ("setpriv", "--bounding-set", "-dac_override,-dac_read_search")
"""Runs a program as root who may write and read no more than files allow their owner."""


def without_power(folder: Path, *words: str) -> tuple[int, str]:
    """As `finished`, bound to what files and folders allow, as every user but root is."""
    before: tuple[str, ...] = ()
    if os.geteuid() == 0:
        before = POWERLESS
        locked = f"cd {folder / 'locked'}"
        if (
            not shutil.which("setpriv")
            or subprocess.run(
                [*before, "sh", "-c", f"! {locked}"], capture_output=True, check=False
            ).returncode
        ):
            pytest.skip("root cannot give up its power here")
    command = [*before, sys.executable, "-c", PROGRAM, "estimate", "log.mcap", *words]
    run = subprocess.run(command, cwd=folder, capture_output=True, check=False, timeout=READY)
    return run.returncode, run.stderr.decode()


class TestDisks:
    @pytest.mark.parametrize("share", [0.3, 1.02])
    def test_full(self, share: float, folder: Path, sound: bytes) -> None:
        """The disk is full while the log is copied, or when results are added."""
        with small_disk(folder / "disk", 4096 * round(share * len(sound) / 4096 + 1)) as disk:
            code, errors = finished(folder, "-o", "disk/out.mcap")
            assert code == 1
            assert "no space left on device" in errors
            assert "Make room" in errors
            assert names(disk) == set()
        assert (folder / "log.mcap").read_bytes() == sound

    def test_read_only(self, folder: Path) -> None:
        with small_disk(folder / "disk", 1 << 20) as disk:
            subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
            code, errors = finished(folder, "-o", "disk/out.mcap")
            assert code == 1
            assert "read-only" in errors
            assert names(disk) == set()

    @pytest.mark.parametrize(
        ("words", "said"),
        [
            ((), "Choose an output in a folder that you may write to"),
            (("-o", "closed/out.mcap"), "Choose an output in a folder that you may write to"),
            (("-o", "locked/out.mcap"), "Choose an output in a folder that you may write to"),
            (("--only-new",), "Choose an output in a folder that you may write to"),
            (("--in-place",), "Write a copy instead, without --in-place"),
        ],
    )
    def test_folder_of_others(
        self, words: tuple[str, ...], said: str, folder: Path, sound: bytes
    ) -> None:
        """The log's own folder, one that only others may write to, one that only they may see."""
        (folder / "closed").mkdir()
        (folder / "locked").mkdir(mode=0)
        (folder / "log.mcap").chmod(0o444)
        (folder / "closed").chmod(0o555)
        folder.chmod(0o555)
        try:
            code, errors = without_power(folder, *words)
        finally:
            folder.chmod(0o755)
            (folder / "locked").chmod(0o755)
        assert code == 1
        assert "permission denied" in errors
        assert said in errors
        assert "Traceback" not in errors
        assert names(folder) == {"log.mcap", "mclass.yaml", "closed", "locked"}
        assert names(folder / "closed") == names(folder / "locked") == set()
        assert (folder / "log.mcap").read_bytes() == sound

    def test_missing_folder(self, folder: Path) -> None:
        code, errors = finished(folder, "-o", "no/out.mcap")
        assert code == 1
        assert "there is no folder" in errors


class TestPlaces:
    @pytest.mark.parametrize("how", ["same", "symbolic", "hard"])
    def test_the_input_is_never_the_output(self, how: str, folder: Path, sound: bytes) -> None:
        output = folder / ("log.mcap" if how == "same" else "link.mcap")
        if how == "symbolic":
            output.symlink_to("log.mcap")
        elif how == "hard":
            output.hardlink_to(folder / "log.mcap")
        code, errors = finished(folder, "-o", output.name, "--overwrite")
        assert code == 1
        assert "the input itself" in errors
        assert (folder / "log.mcap").read_bytes() == sound

    def test_existing_output(self, folder: Path) -> None:
        output = folder / "log.mclass.mcap"
        output.write_bytes(b"precious")
        code, errors = finished(folder)
        assert (code, output.read_bytes()) == (1, b"precious")
        assert "--overwrite" in errors
        assert finished(folder, "--overwrite")[0] == 0
        assert len(output.read_bytes()) > 1000

    def test_links_are_followed(self, folder: Path) -> None:
        (folder / "elsewhere").mkdir()
        (folder / "link.mcap").symlink_to("elsewhere/real.mcap")
        (folder / "log-link.mcap").symlink_to("log.mcap")
        assert finished(folder, "-o", "link.mcap")[0] == 0
        assert (folder / "link.mcap").is_symlink()
        assert names(folder / "elsewhere") == {"real.mcap"}

    def test_a_pipe_as_input(self, folder: Path, sound: bytes) -> None:
        expected = folder / "expected.mcap"
        assert finished(folder, "-o", expected.name)[0] == 0
        (folder / "log.mcap").unlink()
        os.mkfifo(folder / "log.mcap")
        feeding = threading.Thread(target=(folder / "log.mcap").write_bytes, args=(sound,))
        feeding.start()
        assert finished(folder, "-o", "out.mcap")[0] == 0
        feeding.join()
        assert (folder / "out.mcap").read_bytes() == expected.read_bytes()
        assert carried_over(expected.read_bytes()) == read_whole(sound)

    def test_a_log_of_which_nothing_may_be_read(self, folder: Path) -> None:
        (folder / "log.mcap").unlink()
        (folder / "log.mcap").mkdir()
        code, errors = finished(folder)
        assert code == 1
        assert "is a folder" in errors


class TestDeterminism:
    """The same log, model and version give the same bytes."""

    @pytest.mark.parametrize("preset", ["paper", pytest.param("robust", marks=pytest.mark.slow)])
    def test_any_hash_seed_and_number_of_threads(self, preset: str, folder: Path) -> None:
        (folder / "mclass.yaml").write_text(MODEL.replace("preset: paper", f"preset: {preset}"))
        outputs = []
        # The last one sees a single processor.
        alone = "import os; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))}); "
        for seed, threads, before in (("0", "1", ""), ("1", "4", ""), ("4242", "2", alone)):
            environment = {**os.environ, "PYTHONHASHSEED": seed, "OPENBLAS_NUM_THREADS": threads}
            output = folder / f"out-{seed}.mcap"
            words = ["estimate", "log.mcap", "-o", output.name, "--every", "0.5"]
            subprocess.run(
                [sys.executable, "-c", before + PROGRAM, *words],
                cwd=folder,
                env=environment,
                check=True,
                capture_output=True,
            )
            outputs.append(output.read_bytes())
        assert len(outputs[0]) > 1000
        assert outputs[1] == outputs[0]
        assert outputs[2] == outputs[0]
