"""Peak memory of `mclass estimate` against the beliefs of all touched cells."""

from __future__ import annotations

from pathlib import Path

from mclass.outputs.readback import OutputLog

from . import generated
from .process import mclass
from .tables import Row

CASES = (
    ("paper", False, 1_000, 1, 0, 0.1, 72),
    ("paper", False, 30_000, 1, 0, 0.1, 72),
    ("paper", False, 100_000, 3, 0, 0.1, 72),
    ("paper", False, 1_000, 1, 300, 0.1, 72),
    ("paper", False, 1_000, 1, 0, 0.03, 72),
    ("paper", False, 1_000, 1, 0, 0.1, 360),
    ("robust", True, 200, 1, 0, 0.1, 72),
    ("robust", True, 2_000, 1, 0, 0.1, 72),
    ("robust", False, 200, 1, 0, 0.1, 72),
)
"""Preset, ids, messages, boxes in each, images, cell size [m], orientation bins."""


def measure(folder: Path, runs: int) -> tuple[str, list[Row]]:
    rows = []
    for preset, ids, pairs, boxes, images, cell_size, bins in CASES:
        log, output, model = folder / "log.mcap", folder / "out.mcap", folder / "model.yaml"
        log.unlink(missing_ok=True)
        generated.write_ros(log, pairs, boxes=boxes, ids=ids, images=images, size=2**20)
        text = generated.MODEL.replace("cell_size: 0.1", f"cell_size: {cell_size}")
        text = text.replace("preset: paper", f"preset: {preset}")
        model.write_text(text.replace("orientation_bins: 72", f"orientation_bins: {bins}"))
        peak = mclass("estimate", log, "-c", model, "-o", output, "--overwrite").peak
        with OutputLog.open(output) as results:
            touched = len(results.maps().cells)
            classes = len(results.class_names)
        limit = 1.5 * touched * classes * bins * 4 + 200e6
        rows.append(
            Row(
                f"{preset}, {pairs * boxes:,} detections{' with ids' if ids else ''}, "
                f"{log.stat().st_size / 2**20:,.0f} MB, {touched:,} touched "
                f"cells of {cell_size} m, {classes} classes, {bins} bins",
                f"{peak / 1e6:.0f} MB",
                f"1.5 × beliefs + 200 MB = {limit / 1e6:.0f} MB",
            )
        )
    return "### Peak memory", rows
