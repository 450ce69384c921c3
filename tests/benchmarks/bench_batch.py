"""Many logs at once: what two processes gain, what a batch costs beside its work, how it grows.

Other programs on the machine slow down two processes more than one; user time tells then how
much was done, and both are in the table.
"""

from __future__ import annotations

import os
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

from . import generated
from .process import Run, mclass, run
from .tables import Row

SAMPLE = Path(__file__).parents[2] / "sample_logs" / "paper_toy.mcap"
TINY_MODEL = Path(__file__).parents[2] / "configs" / "paper_toy.yaml"
LOGS, PAIRS = 20, 100
FEW, MANY = 5, 40
TINY = 10_000
LOOP = """
import sys
from pathlib import Path
import mclass
for log in sorted(Path(sys.argv[1]).glob("*.mcap")):
    found = mclass.estimate(log, output=Path(sys.argv[2], log.name))
"""
"""The work alone: what a batch does for each log, in one process."""


@dataclass(frozen=True)
class Best:
    """Least wall time and least user time of several runs [s], and most memory [bytes]."""

    seconds: float
    user: float
    peak: int


def measure(folder: Path, runs: int) -> tuple[str, list[Row]]:
    logs, out = folder / "logs", folder / "out"
    _copies(logs, LOGS)
    alone: list[str | Path] = [sys.executable, "-c", LOOP, logs, out]
    taken: dict[str, list[Run]] = {"loop": [], "one": [], "two": []}
    for _ in range(runs):
        out.mkdir()
        taken["loop"].append(run(alone))
        for name, jobs in (("one", "1"), ("two", "2")):
            shutil.rmtree(out)
            taken[name].append(mclass("batch", logs, "-o", out, "-j", jobs))
        shutil.rmtree(out)
    best = {name: _best(found) for name, found in taken.items()}
    loop, one, two = best["loop"], best["one"], best["two"]
    rows = [
        Row(
            f"{LOGS} equal logs on two cores: share of both that is used",
            f"{one.seconds:.1f} s by one process, {two.seconds:.1f} s by two: "
            f"{one.seconds / two.seconds / 2:.2f}; user time {one.user:.1f} s and "
            f"{two.user:.1f} s: {one.user / two.user:.2f}",
            "at least 0.9",
        ),
        Row(
            "what a batch costs beside its work, one process",
            f"{one.seconds:.1f} s, a loop {loop.seconds:.1f} s: "
            f"{_percent(one.seconds, loop.seconds)}; user time {one.user:.1f} s and "
            f"{loop.user:.1f} s: {_percent(one.user, loop.user)}",
            "at most 5 %",
        ),
    ]
    shutil.rmtree(logs)
    peaks = []
    for count in (FEW, MANY):
        _copies(logs, count)
        peaks.append(mclass("batch", logs, "-o", out, "-j", "2").peak)
        shutil.rmtree(logs)
        shutil.rmtree(out)
    rows.append(
        Row(
            "most memory of any process",
            ", ".join(
                f"{count} logs: {peak / 2**20:.0f} MB"
                for count, peak in zip((FEW, MANY), peaks, strict=True)
            ),
            "flat",
        )
    )
    return "### Batch", [*rows, *_tiny(folder)]


def _copies(folder: Path, count: int) -> None:
    folder.mkdir()
    first = folder / "0.mcap"
    generated.write_ros(first, PAIRS)
    for number in range(1, count):
        shutil.copy(first, folder / f"{number}.mcap")


def _best(found: list[Run]) -> Best:
    return Best(
        min(one.seconds for one in found),
        min(one.user for one in found),
        max(one.peak for one in found),
    )


def _percent(whole: float, work: float) -> str:
    return f"{100.0 * (whole / work - 1.0):+.1f} %"


def _tiny(folder: Path) -> list[Row]:
    """Thousands of logs of a few messages, and the same again when all is done."""
    logs, out, model = folder / "tiny", folder / "out", folder / "model.yaml"
    logs.mkdir()
    text = TINY_MODEL.read_text()
    coarse = text.replace(
        "{cell_size: 1, orientation_bins: 360,", "{cell_size: 10, orientation_bins: 8,"
    )
    assert coarse != text
    model.write_text(coarse)
    for number in range(TINY):
        # Links are logs of their own to a batch, and take no room.
        os.link(_sample(folder), logs / f"{number}.mcap")
    arguments = ("batch", logs, "-c", model, "-o", out)
    first, second = mclass(*arguments), mclass(*arguments)
    record = (out / "results.json").stat().st_size
    return [
        Row(
            f"{TINY:,} tiny logs, two processes",
            f"{first.seconds:.0f} s, user time {first.user:.0f} s; at most "
            f"{first.peak / 2**20:.0f} MB in a process; results.json {record / 2**20:.1f} MB",
            "without trouble",
        ),
        Row(
            "the same again, all being done",
            f"{second.seconds:.0f} s, user time {second.user:.0f} s",
        ),
    ]


def _sample(folder: Path) -> Path:
    path = folder / "toy.mcap"
    if not path.exists():
        shutil.copy(SAMPLE, path)
    return path
