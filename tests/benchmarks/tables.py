"""Timing, and tables in Markdown."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy


@dataclass(frozen=True)
class Row:
    """One line of a table: what, how much, and what it is meant to be."""

    what: str
    measured: str
    wanted: str = ""


def table(rows: Sequence[Row]) -> str:
    lines = ["| what | measured | wanted |", "|---|---|---|"]
    lines += [f"| {row.what} | {row.measured} | {row.wanted} |" for row in rows]
    return "\n".join(lines)


def machine() -> str:
    """Processor, memory, versions, and how busy it was before the run."""
    model = platform.processor() or platform.machine()
    information = Path("/proc/cpuinfo")
    if information.exists():
        names = [line for line in information.read_text().splitlines() if "model name" in line]
        model = names[0].partition(":")[2].strip() if names else model
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    load = os.getloadavg()[0]
    return (
        f"{os.cpu_count()} cores of {model}, {memory:.0f} GB; Python {platform.python_version()}, "
        f"NumPy {np.__version__}, SciPy {scipy.__version__}; load before the run {load:.1f}"
    )


def fastest(
    runs: int, *functions: Callable[[], object], clock: Callable[[], float] = time.perf_counter
) -> list[float]:
    """Least time of each function [s]; they take turns, so that all meet the same load."""
    best = [float("inf")] * len(functions)
    for _ in range(runs):
        for index, function in enumerate(functions):
            start = clock()
            function()
            best[index] = min(best[index], clock() - start)
    return best
