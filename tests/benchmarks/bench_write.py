"""Writing a big log back with the results in it."""

from __future__ import annotations

import os
from pathlib import Path

from . import generated
from .process import Run, mclass, run
from .tables import Row

PAIRS = 500
IMAGES, SIZE = 1000, 2 * 2**20
# What a copy costs that is on the disk, too, when it ends.
DURABLE = 'cp "$0" "$1" && sync "$1"'


def measure(folder: Path, runs: int) -> tuple[str, list[Row]]:
    big, small = folder / "big.mcap", folder / "small.mcap"
    # Without ids: no objects are followed, and what differs is not lost in what does not.
    generated.write_ros(big, PAIRS, images=IMAGES, size=SIZE, ids=False)
    generated.write_ros(small, PAIRS, ids=False)
    best: dict[str, Run] = {}

    def take(name: str, found: Run) -> None:
        if name not in best or found.seconds < best[name].seconds:
            best[name] = found

    copy, output = folder / "copy.mcap", folder / "out.mcap"

    def clear() -> None:
        """Every copy is made in the memory that the one before has left, and with a quiet disk."""
        for path in (copy, output):
            path.unlink(missing_ok=True)
        os.sync()

    for _ in range(runs):
        clear()
        take("durable", run(["sh", "-c", DURABLE, big, copy]))
        clear()
        take("big", mclass("estimate", big, "-o", output))
        clear()
        take("new", mclass("estimate", big, "--only-new", "-o", output))
        clear()
        take("small", mclass("estimate", small, "-o", output))
        clear()
        take("cp", run(["cp", big, copy]))
        os.sync()
        take("place", mclass("estimate", copy, "--in-place"))
    gigabytes = big.stat().st_size / 1e9
    copies = [best[name].seconds for name in ("cp", "durable")]
    limits = [1.5 * seconds + best["small"].seconds for seconds in copies]
    return f"### Writing back: a log of {gigabytes:.1f} GB", [
        Row("cp, which leaves the copy in memory", f"{copies[0]:.2f} s"),
        Row("cp and sync of the copy", f"{copies[1]:.2f} s"),
        Row("estimate of the same log without its images", f"{best['small'].seconds:.2f} s"),
        Row(
            "estimate, hashed, and on the disk when it ends",
            f"{best['big'].seconds:.2f} s",
            f"1.5 × cp + own computing: {limits[0]:.2f} s; with sync {limits[1]:.2f} s",
        ),
        Row("estimate --only-new", f"{best['new'].seconds:.2f} s"),
        Row("estimate --in-place", f"{best['place'].seconds:.2f} s"),
        Row(
            "peak memory, against that of the small log",
            f"{best['big'].peak / 2**20:.0f} MB, {best['small'].peak / 2**20:.0f} MB",
            "equal",
        ),
    ]
