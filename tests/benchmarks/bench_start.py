"""How long until something happens."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path

from .process import fastest
from .tables import Row

SAMPLE = Path(__file__).parents[2] / "sample_logs" / "paper_toy.mcap"
EMPTY = "import click\n@click.command()\ndef main(): 'Nothing.'\nmain()\n"
IMPORTS = "import numpy, scipy.sparse, mcap.records, mcap.reader"


def measure(folder: Path, runs: int) -> tuple[str, list[Row]]:
    program = Path(sys.executable).with_name("mclass")
    # Modules are compiled in the first run and kept, as where mclass is installed.
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    os.environ["PYTHONPYCACHEPREFIX"] = str(folder / "compiled")
    empty, log = folder / "empty.py", folder / "toy.mcap"
    empty.write_text(EMPTY)
    shutil.copy(SAMPLE, log)
    names = ("help", "empty", "completion", "estimate", "imports", "inspect")
    commands: tuple[list[str | Path], ...] = (
        [program, "--help"],
        [sys.executable, empty, "--help"],
        ["env", "_MCLASS_COMPLETE=bash_complete", "COMP_WORDS=mclass", "COMP_CWORD=1", program],
        [program, "estimate", log, "--overwrite"],
        [sys.executable, "-c", IMPORTS],
        [program, "inspect", "log", log],
    )
    best = dict(zip(names, fastest(10 * runs, *commands), strict=True))
    ms = {name: 1000.0 * found.seconds for name, found in best.items()}
    return "### Start-up", [
        Row("an empty click program, --help", f"{ms['empty']:.0f} ms"),
        Row(
            "mclass --help",
            f"{ms['help']:.0f} ms, {ms['help'] / ms['empty']:.2f} times",
            "at most 2 times",
        ),
        Row(
            "shell completion",
            f"{ms['completion']:.0f} ms, {ms['completion'] / ms['empty']:.2f} times",
            "at most 2 times",
        ),
        Row("importing numpy, scipy.sparse and mcap", f"{ms['imports']:.0f} ms"),
        Row("mclass inspect log, a small log: imports and reading", f"{ms['inspect']:.0f} ms"),
        Row(
            "mclass estimate, a small log",
            f"{ms['estimate']:.0f} ms, {ms['estimate'] / ms['imports']:.2f} times the imports",
            "1.5 times, and reading",
        ),
    ]
