"""Progress, warnings and details: on stderr, to those who want them."""

from __future__ import annotations

import os
import pty
import re
import subprocess
import sys
from pathlib import Path

import click
import pytest
from sample_runs import CONFIGS, SAMPLES, mclass

from mclass.commands import console as module
from mclass.commands.cli import main
from mclass.commands.console import Console

CAS_LAB = SAMPLES / "cas_lab.mcap"

# Every call draws: what is shown must not depend on how fast the machine is.
_IMPATIENT = """
import sys
from mclass.commands import console
console._PATIENCE_S = console._REFRESH_S = console._SETTLED_S = 0.0
from mclass.commands.cli import main
main(sys.argv[1:], prog_name="mclass")
"""


def on_terminal(*arguments: str | Path, term: str = "xterm", folder: Path) -> tuple[str, str]:
    """What a command prints to a pipe, and on a terminal that is its stderr."""
    ours, theirs = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-c", _IMPATIENT, *map(str, arguments)],
        cwd=folder,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=theirs,
        env={**os.environ, "TERM": term, "COLUMNS": "60"},
    )
    os.close(theirs)
    shown = b""
    try:
        while part := os.read(ours, 65536):
            shown += part
    except OSError:
        pass  # the other end is closed
    finally:
        os.close(ours)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 0, shown
    return output.decode(), shown.decode()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("console")
    mclass("estimate", CAS_LAB, "-o", place / "out.mcap")
    return place


SCENARIO = CONFIGS / "scenarios" / "cas_lab.yaml"
RUNS = {
    "estimate": ("estimate", CAS_LAB, "-o", "again.mcap", "--overwrite"),
    "verify": ("inspect", "log", CAS_LAB, "--verify"),
    "simulate": ("simulate", SCENARIO, "-o", "log.mcap", "--overwrite"),
    "fuse": ("fuse", "out.mcap", "-o", "map.mcap", "--overwrite"),
}
STAGES = {
    "estimate": ("reading", "following objects", "mapping"),
    "verify": ("reading", "verifying"),
    "simulate": ("encoding", "writing"),
    "fuse": ("reading", "following objects", "mapping"),
}


class TestOnTerminals:
    @pytest.mark.parametrize("name", RUNS)
    def test_progress_is_one_line_that_is_taken_away(self, name: str, folder: Path) -> None:
        output, shown = on_terminal(*RUNS[name], folder=folder)
        for stage in STAGES[name]:
            assert stage in shown
        assert "100 %" in shown
        assert re.search(r"\d .*/s  \d+ s left", shown)
        assert "\n" not in shown
        assert shown.endswith("\r\x1b[K")
        assert all(len(line) < 60 for line in shown.split("\r\x1b[K"))
        assert "\x1b" not in output

    @pytest.mark.parametrize(("options", "term"), [(("-q",), "xterm"), ((), "dumb")])
    def test_nothing_where_it_is_not_wanted(
        self, options: tuple[str, ...], term: str, folder: Path
    ) -> None:
        _, shown = on_terminal(*RUNS["estimate"], *options, term=term, folder=folder)
        assert shown == ""

    def test_details_do_not_run_into_progress(self, folder: Path) -> None:
        _, shown = on_terminal(*RUNS["estimate"], "-v", folder=folder)
        lines = [line.rpartition("\x1b[K")[2] for line in shown.split("\r\n")]
        assert [line.partition(":")[0] for line in lines[:4]] == [
            *("reading", "copying", "following objects", "mapping")
        ]
        assert lines[4].startswith("preset paper, ")
        assert re.search(r"\x1b\[Kmapping: \d+\.\d\d s, \d+ tiles", shown)


class TestVerbosity:
    def test_every_command_has_both(self) -> None:
        def commands(group: click.Group) -> list[click.Command]:
            context = click.Context(group)
            found = [group.get_command(context, name) for name in group.list_commands(context)]
            return [
                leaf
                for command in found
                if command is not None
                for leaf in (commands(command) if isinstance(command, click.Group) else [command])
            ]

        every = commands(main)
        assert len(every) > 8
        for command in every:
            forms = [form for parameter in command.params for form in parameter.opts]
            for form in ("-q", "--quiet", "-v", "--verbose"):
                assert forms.count(form) == 1, (command.name, form)

    def test_nothing_is_told_in_a_pipe(self, folder: Path) -> None:
        done = mclass("estimate", CAS_LAB, "-o", folder / "pipe.mcap")
        assert done.stderr == ""
        assert "note " in done.stdout

    def test_quiet_leaves_results_and_errors(self, folder: Path) -> None:
        out = folder / "quiet.mcap"
        done = mclass("estimate", CAS_LAB, "-o", out, "-q")
        assert "note " not in done.stdout
        assert "3 objects" in done.stdout
        assert "exists" in mclass("estimate", CAS_LAB, "-o", out, "-q", code=1).stderr
        assert "note " not in mclass("inspect", "log", CAS_LAB, "--quiet").stdout
        command = ("estimate", CAS_LAB, "-o", out, "--overwrite", "--format", "json")
        assert mclass(*command, "-q").document == mclass(*command).document

    def test_verbose_tells_stages_and_choices(self, folder: Path) -> None:
        done = mclass("estimate", CAS_LAB, "-o", folder / "v.mcap", "-v", "--threads", "1")
        told = done.stderr.splitlines()
        stages = [line.partition(":")[0] for line in told[:-1]]
        assert stages == ["reading", "copying", "following objects", "mapping"]
        assert re.fullmatch(r"following objects: \d+\.\d\d s, 5 measurements", told[2])
        assert told[-1].startswith("preset paper, 5 frames, grid of ")
        assert told[-1].endswith("orientation bins, 1 thread")

    def test_both_contradict(self) -> None:
        assert "choose one" in mclass("check", CONFIGS / "office.yaml", "-q", "-v", code=2).stderr


class TestConsole:
    def test_warnings(self, capsys: pytest.CaptureFixture[str]) -> None:
        console = Console()
        console.warn("odd")
        console.detail("fine")
        console.quiet = True
        console.warn("silent")
        assert capsys.readouterr().err == "Warning: odd\n"

    @pytest.mark.parametrize(
        ("arguments", "expected"),
        [
            (("reading", 250, 1000, 100.0, "bytes"), "25 %  100 B/s  8 s left"),
            (("reading", 0, 0, 0.0, "bytes"), "reading"),
            (("encoding", 1500, 0, 2.5, "messages"), "1,500 messages  2.5 messages/s"),
            (("mapping", 1, 2000, 0.25, "tiles"), "0 %  0.2 tiles/s  2 h 13 min left"),
            (("copying", 10**9, 10**10, 5e7, "bytes"), "10 %  50.0 MB/s  3 min 0 s left"),
            (("mapping", 12, 10, 1.0, "tiles"), "100 %  1 tiles/s  0 s left"),
        ],
    )
    def test_text(self, arguments: tuple[str, int, int, float, str], expected: str) -> None:
        assert module._progress_text(*arguments, bar=20).endswith(expected)
