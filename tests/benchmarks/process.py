"""Programs of their own: their time and the most memory they held."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path


@dataclass(frozen=True)
class Run:
    """Wall time and user time [s], most memory [bytes]."""

    seconds: float
    user: float
    peak: int


def run(command: Sequence[str | Path]) -> Run:
    """Run a command from a small process: a program's peak begins with that of who starts it."""
    starter = [sys.executable, "-S", __file__, *command]
    printed = subprocess.run(starter, stdout=subprocess.PIPE, check=True).stdout
    return Run(**json.loads(printed))


def _started(command: Sequence[str]) -> Run:
    start = time.perf_counter()
    child = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(child.pid, 0)
    seconds = time.perf_counter() - start
    child.returncode = os.waitstatus_to_exitcode(status)
    assert child.returncode == 0, command
    return Run(seconds, usage.ru_utime, usage.ru_maxrss * 1024)


def mclass(*arguments: str | Path) -> Run:
    return run([Path(sys.executable).with_name("mclass"), *arguments])


def fastest(runs: int, *commands: Sequence[str | Path]) -> list[Run]:
    """Of each command, in turn."""
    best: list[Run | None] = [None] * len(commands)
    for _ in range(runs):
        for index, command in enumerate(commands):
            found, known = run(command), best[index]
            if known is None or found.seconds < known.seconds:
                best[index] = found
    return [found for found in best if found is not None]


if __name__ == "__main__":
    print(json.dumps(asdict(_started(sys.argv[1:]))))
