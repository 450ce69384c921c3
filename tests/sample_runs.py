"""Commands run in-process, and the sample logs estimated, for tests of the whole program."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from click.testing import CliRunner

from mclass.commands.cli import main

ROOT = Path(__file__).resolve().parent.parent
SAMPLES = ROOT / "sample_logs"
CONFIGS = ROOT / "configs"
SAMPLE_NAMES = ("paper_toy", "cas_lab", "cas_lab_protobuf", "cas_lab_json")

_PROGRAM = "from mclass.commands.cli import main; main(prog_name='mclass')"


@dataclass(frozen=True)
class Done:
    """A command that has run."""

    code: int
    stdout: str
    stderr: str

    @property
    def document(self) -> Any:
        """What it printed, as JSON."""
        return json.loads(self.stdout)


def mclass(*arguments: str | Path, code: int = 0) -> Done:
    """Run a command in this process and demand its exit code.

    Whatever it ends with, there must be no traceback, and failures must say so on stderr alone.
    """
    result = CliRunner().invoke(main, [str(argument) for argument in arguments])
    done = Done(result.exit_code, result.stdout, result.stderr)
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    assert done.code == code, (done.code, done.stdout, done.stderr)
    assert "Traceback" not in done.stderr
    assert "This is a bug" not in done.stderr
    if code in (1, 2):
        assert done.stdout == ""
        assert "Error: " in done.stderr
    return done


def mclass_process(
    *arguments: str | Path, environment: Mapping[str, str] | None = None, cwd: Path | None = None
) -> subprocess.CompletedProcess[bytes]:
    """Run a command in a process of its own."""
    return subprocess.run(
        [sys.executable, "-c", _PROGRAM, *(str(argument) for argument in arguments)],
        capture_output=True,
        check=False,
        cwd=cwd,
        env={**os.environ, **(environment or {})},
    )


def sample(name: str, folder: Path) -> Path:
    """A copy of a sample log in a folder."""
    return Path(shutil.copy(SAMPLES / f"{name}.mcap", folder))


def estimated(name: str, folder: Path, *options: str | Path) -> Path:
    """The output of a sample log."""
    output = folder / f"{name}.mclass.mcap"
    mclass("estimate", SAMPLES / f"{name}.mcap", "-o", output, *options)
    return output


def objects_of(output: Path, *options: str) -> dict[str, dict[str, Any]]:
    """The objects in an output by id, as `inspect objects` gives them."""
    document = mclass("inspect", "objects", output, "--format", "json", *options).document
    return {entry["id"]: entry for entry in document["objects"]}
