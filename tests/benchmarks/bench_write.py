"""Writing a big log back with the results in it."""

from __future__ import annotations

import os
from pathlib import Path

from . import generated
from .process import Run, mclass, run
from .tables import Row

PAIRS = 500
IMAGES, SIZE = 1000, 2 * 2**20


def measure(folder: Path, runs: int) -> tuple[str, list[Row]]:
    big, small = folder / "big.mcap", folder / "small.mcap"
    generated.write_ros(big, PAIRS, images=IMAGES, size=SIZE)
    generated.write_ros(small, PAIRS)
    best: dict[str, Run] = {}

    def take(name: str, found: Run) -> None:
        if name not in best or found.seconds < best[name].seconds:
            best[name] = found

    copy, output = folder / "copy.mcap", folder / "out.mcap"
    for _ in range(runs):
        for path in (copy, output):
            path.unlink(missing_ok=True)
        os.sync()
        take("cp", run(["cp", big, copy]))
        os.sync()
        take("small", mclass("estimate", small, "-o", folder / "o.mcap", "--overwrite"))
        take("big", mclass("estimate", big, "-o", output, "--overwrite"))
        take("new", mclass("estimate", big, "--only-new", "-o", output, "--overwrite"))
        take("place", mclass("estimate", copy, "--in-place"))
    gigabytes = big.stat().st_size / 1e9
    limit = 1.5 * best["cp"].seconds + best["small"].seconds
    return f"### Writing back: a log of {gigabytes:.1f} GB", [
        Row("cp", f"{best['cp'].seconds:.2f} s"),
        Row("estimate of the same log without its images", f"{best['small'].seconds:.2f} s"),
        Row(
            "estimate, on the disk when it ends (cp need not be)",
            f"{best['big'].seconds:.2f} s",
            f"1.5 × cp + own computing: {limit:.2f} s",
        ),
        Row("estimate --only-new", f"{best['new'].seconds:.2f} s"),
        Row("estimate --in-place", f"{best['place'].seconds:.2f} s"),
        Row(
            "peak memory, against that of the small log",
            f"{best['big'].peak / 2**20:.0f} MB, {best['small'].peak / 2**20:.0f} MB",
            "equal",
        ),
    ]
