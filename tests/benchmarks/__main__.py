"""How fast, and how much memory: the tables of the README, measured in one run.

    python -m tests.benchmarks [filter] [read] [write] [start] [growth] [memory] [threads] [batch]

Each table compares times taken in turn on this machine; of several runs the fastest counts. Logs
are generated in a temporary folder (those for ``write`` take 7 GB there) and deleted.
"""

from __future__ import annotations

import os

os.environ["OPENBLAS_NUM_THREADS"] = "1"

import argparse
import tempfile
from importlib import import_module
from pathlib import Path

from . import tables

SECTIONS = ("filter", "read", "write", "start", "growth", "memory", "threads", "batch")


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tests.benchmarks", description="Print tables of times and memory."
    )
    parser.add_argument("sections", nargs="*", metavar="SECTION", help=", ".join(SECTIONS))
    parser.add_argument("--runs", type=int, default=3, help="of which the fastest counts")
    parser.add_argument("--folder", type=Path, help="for generated logs, instead of /tmp")
    chosen = parser.parse_args()
    unknown = set(chosen.sections) - set(SECTIONS)
    if unknown:
        parser.error(f"no section {', '.join(sorted(unknown))}; there are {', '.join(SECTIONS)}")
    print(tables.machine(), flush=True)
    for name in chosen.sections or SECTIONS:
        with tempfile.TemporaryDirectory(prefix="mclass-", dir=chosen.folder) as folder:
            section = import_module(f"{__package__}.bench_{name}")
            title, rows = section.measure(Path(folder), chosen.runs)
            print(f"\n{title}\n\n{tables.table(rows)}", flush=True)


if __name__ == "__main__":
    main()
