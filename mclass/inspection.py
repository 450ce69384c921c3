"""What the `inspect` commands ask: over a log, into a cell."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from mclass.cells import grid_history, object_history, stored_report, untouched_report
from mclass.config.find import MODEL_FILE_NAME, find_model_file
from mclass.config.model_file import load_model, parse_model
from mclass.errors import UsageError
from mclass.inference import prepare
from mclass.logs.damage import undecoded
from mclass.logs.reader import LogReader
from mclass.logs.survey import Survey, survey
from mclass.outputs.readback import OutputLog
from mclass.places import Place
from mclass.progress import Progress, in_bytes, unheard
from mclass.results import CellReport
from mclass.text.logs import LogFacts, Verification


def look_over(
    log: Place, model_path: Path | None, *, verify: bool, progress: Progress = unheard
) -> tuple[LogFacts, Survey]:
    """What is in a log, by the model that `estimate` would use if there is one."""
    with LogReader.open(log) as reader:
        reader.on_read = in_bytes(progress, "reading")
        model = None
        path = model_path or find_model_file(log)
        attached = reader.attachment(MODEL_FILE_NAME)
        if path is not None:
            model = load_model(path)
        elif attached is not None:
            model = parse_model(attached, f"{log.name}#{MODEL_FILE_NAME}")
        found = survey(reader, model)
        verification = _verified(reader, progress) if verify else None
        problems = verification.problems if verification else ()
        unreadable = undecoded(found.unreadable)
        facts = LogFacts(
            path=str(log),
            size=reader.size,
            profile=reader.profile,
            library=reader.library,
            start_ns=reader.start_ns,
            end_ns=reader.end_ns,
            damage=(
                *reader.damage.losses,
                *(text for text in problems if text not in reader.damage.sentences),
                *unreadable,
            ),
            remarks=reader.damage.remarks,
            verification=verification,
        )
    return facts, found


def _verified(reader: LogReader, progress: Progress) -> Verification:
    """Check every byte of a log."""
    problems = reader.verify(in_bytes(progress, "verifying"))
    return Verification(
        bytes=reader.size,
        chunks=len(reader.index.chunks),
        messages=reader.message_count or 0,
        attachments=len(reader.attachments),
        data_checksum=bool(reader.index.data_crc),
        problems=problems,
    )


@dataclass(frozen=True)
class CellView:
    """A cell of an output, and what names it.

    Attributes:
        report: Its belief as stored.
        prior: Its belief before any measurement.
        history: After each look at it; empty unless asked for.
        class_names: Without the background.
        frame: World frame.
        damage: What of the output was lost, in sentences.
    """

    report: CellReport
    prior: CellReport
    history: tuple[CellReport, ...]
    class_names: tuple[str, ...]
    frame: str
    damage: tuple[str, ...]


def look_into(out: Place, x: float, y: float, object_id: str | None, *, history: bool) -> CellView:
    """The cell of an output that holds a point [m].

    Args:
        out: Written by `estimate`.
        x: In the world frame.
        y: In the world frame.
        object_id: Whose belief; None for the grid's.
        history: Evaluate the belief after each look, from the measurements in the output.

    Raises:
        LogError: If the output holds no such belief.
        UsageError: If the point is not on the grid, or the object is not known.
    """
    with OutputLog.open(out) as output:
        known = [estimate.object_id for estimate in output.objects()]
        if object_id is not None and object_id not in known:
            raise UsageError(f"no object {object_id!r}; objects: {', '.join(known) or 'none'}")
        model = parse_model(output.model_text, output.model_name)
        block = output.belief_at(x, y, object_id or "")
        grid = block.grid
        cell = grid.cell_at(x, y)
        if cell is None:
            raise UsageError(f"({x:g}, {y:g}) is not on the grid")
        steps: list[CellReport] = []
        touched = len(block.cells) > 0
        if history:
            problem = prepare(model, output.measurements())
            if object_id is not None:
                steps = object_history(problem, grid, cell, object_id)
            elif touched:
                steps = grid_history(problem, cell)
        priors, bins = model.classes.log_priors, model.grid.orientation_bins
        prior = untouched_report(grid, cell, priors, bins)
        report = stored_report(block, cell) if touched else prior
        damage = output.reader.damage.losses
        return CellView(report, prior, tuple(steps), output.class_names, output.frame, damage)
