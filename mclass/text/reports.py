"""The summary of a run in the terminal."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from mclass.results import ObjectEstimate
from mclass.text.objects import objects_text
from mclass.text.terminal import Terminal, wrap
from mclass.text.values import count_text

if TYPE_CHECKING:
    from mclass.findings import Estimate

_LISTED_REASONS = 20


def estimate_text(
    *,
    input_path: str,
    output_path: str,
    model_name: str,
    used: int,
    skipped: Mapping[str, int],
    objects: Iterable[ObjectEstimate],
    class_names: Sequence[str],
    frame: str,
    damage: Sequence[str] = (),
    notes: Sequence[str] = (),
    terminal: Terminal,
) -> str:
    """Summary of a run; arguments as in `mclass.text.documents.estimate_json`."""
    lines = [
        f"input         {terminal.clean(input_path, 1000)}",
        f"output        {terminal.clean(output_path, 1000)}",
        f"model         {terminal.clean(model_name, 1000)}",
        f"measurements  {used} used, {sum(skipped.values())} skipped",
        *skipped_lines(skipped, terminal),
    ]
    for sentence in notes:
        lines += wrap(f"note          {terminal.clean(sentence, 1000)}", terminal, " " * 14)
    for sentence in damage:
        text = wrap(f"damaged       {terminal.clean(sentence, 1000)}", terminal, " " * 14)
        lines += [terminal.paint(line, "warning") for line in text]
    return "\n".join([*lines, "", objects_text(objects, class_names, frame, terminal)])


def run_facts(found: Estimate, input_path: str, output_path: object) -> dict[str, Any]:
    """What `estimate_text` and `mclass.text.documents.estimate_json` tell of a run."""
    return {
        "input_path": input_path,
        "output_path": str(output_path),
        "model_name": found.model.name,
        "used": found.used,
        "skipped": found.skipped,
        "objects": found.objects,
        "class_names": found.class_names,
        "frame": found.frame,
        "damage": found.damage,
    }


def choices_text(found: Estimate, threads: int) -> str:
    """What was chosen for a run, for those who ask for details."""
    settings, grid = found.model.grid, found.problem.grid
    looks = count_text(len(found.measurements.frames), "frame")
    cells = "no grid: no detection points anywhere"
    if grid is not None:
        cells = f"grid of {grid.rows} x {grid.columns} cells of {grid.cell_size:g} m"
    return (
        f"preset {found.model.inference.preset}, {looks}, {cells}, "
        f"{settings.orientation_bins} orientation bins, {count_text(threads, 'thread')}"
    )


def skipped_lines(skipped: Mapping[str, int], terminal: Terminal) -> list[str]:
    """Reasons with their counts, most frequent first."""
    reasons = sorted(skipped.items(), key=lambda item: (-item[1], item[0]))
    digits = max((len(str(count)) for _, count in reasons), default=0)
    lines = []
    for reason, count in reasons[:_LISTED_REASONS]:
        text = f"{'':14}{count:>{digits}}  {terminal.clean(reason, 1000)}"
        lines += wrap(text, terminal, " " * (16 + digits))
    rest = reasons[_LISTED_REASONS:]
    if rest:
        lines.append(f"{'':14}{sum(count for _, count in rest)}  for {len(rest)} other reasons")
    return lines
