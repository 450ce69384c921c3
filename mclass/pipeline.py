"""The main job: a log in, the same log with beliefs out."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from mclass.config.find import MODEL_FILE_NAME, find_model
from mclass.config.model_file import load_model
from mclass.errors import LogError
from mclass.inference import (
    UNEXPLAINED,
    GridEstimate,
    Problem,
    cuts_every,
    estimate_objects,
    prepare,
)
from mclass.logs.measurements import LogContents, read_measurements
from mclass.logs.reader import LogReader
from mclass.logs.times import find_time_bound
from mclass.logs.writer import LogWriter
from mclass.model import Model
from mclass.outputs.channels import OutputChannels
from mclass.results import ClassMaps, ObjectEstimate

_HASH_BLOCK = 1 << 20


@dataclass(frozen=True)
class EstimateReport:
    """What a run did.

    Attributes:
        input: The log.
        output: The log with the new channels.
        model: The model in force.
        contents: What was read and what was left out.
        used: Measurements that took part.
        skipped: Detections that did not, by reason.
        objects: Every object's last estimate, by id.
        maps: The class maps at the end; None if no measurement points anywhere.
        damage: Sentences on parts of the log that could not be used.
    """

    input: Path
    output: Path
    model: Model
    contents: LogContents
    used: int
    skipped: Mapping[str, int]
    objects: tuple[ObjectEstimate, ...]
    maps: ClassMaps | None
    damage: tuple[str, ...]


def default_output(log: Path) -> Path:
    """``LOG-stem.mclass.mcap`` beside the log."""
    return log.with_name(f"{log.stem}.mclass.mcap")


def model_for(reader: LogReader, model_path: Path | None) -> Model:
    """The model file that is named, or the one found for the log."""
    if model_path is not None:
        return load_model(model_path)
    return find_model(reader.path, reader.attachment(MODEL_FILE_NAME))


def run(
    log: Path,
    *,
    model_path: Path | None = None,
    output: Path | None = None,
    start: str | None = None,
    end: str | None = None,
    every_s: float | None = None,
    prefix: str = "/mclass",
    overwrite: bool = False,
) -> EstimateReport:
    """Estimate every object and every cell of a log and write the result beside it.

    Args:
        log: MCAP file.
        model_path: Model file; found beside the log, in the working directory or in the log
            when None.
        output: Where to write; `default_output` when None.
        start: Messages logged before are ignored: nanoseconds, RFC 3339 or ``+10s``.
        end: Messages logged after are ignored.
        every_s: Maps and full beliefs are also written every so many seconds.
        prefix: Of the new topics.
        overwrite: Replace an existing output.

    Raises:
        ConfigError: The model is wrong or missing.
        LogError: The log cannot be used, or the output cannot be written.
    """
    output = default_output(log) if output is None else output
    with LogReader.open(log) as reader:
        model = model_for(reader, model_path)
        first = reader.start_ns or 0
        contents = read_measurements(
            reader,
            model,
            None if start is None else find_time_bound(start, first),
            None if end is None else find_time_bound(end, first),
        )
        problem = prepare(model, contents.measurements)
        skipped = dict(contents.tally.counts)
        unexplained = len(contents.measurements) - len(problem.used)
        if unexplained:
            skipped[UNEXPLAINED] = unexplained
        if skipped and len(problem.used) == 0:
            reasons = "; ".join(f"{count} {reason}" for reason, count in skipped.items())
            raise LogError(f"no detection can be used: {reasons}", path=str(log))
        with (
            ThreadPoolExecutor(max_workers=1) as pool,
            LogWriter(output, source=reader, profile=reader.profile, overwrite=overwrite) as writer,
        ):
            digest = pool.submit(_sha256, reader)
            channels = OutputChannels(
                writer, contents.encoding, contents.frame, model, prefix=prefix
            )
            objects, maps = _write_results(problem, channels, every_s)
            settings = {
                "preset": model.inference.preset,
                "start": start,
                "end": end,
                "every_s": every_s,
                "input": log.name,
            }
            log_time_ns = reader.end_ns or 0
            input_hash = f"sha256:{digest.result()}"
            channels.write_header(log_time_ns, input_hash=input_hash, settings=settings)
            channels.write_layout(log_time_ns)
        return EstimateReport(
            input=log,
            output=output,
            model=model,
            contents=contents,
            used=len(problem.used),
            skipped=skipped,
            objects=objects,
            maps=maps,
            damage=reader.damage.sentences,
        )


def _write_results(
    problem: Problem, channels: OutputChannels, every_s: float | None
) -> tuple[tuple[ObjectEstimate, ...], ClassMaps | None]:
    """Estimate and write as results come; returns the last estimate of each object and map."""
    measurements = problem.measurements
    channels.write_measurements(measurements)
    latest: dict[str, ObjectEstimate] = {}
    updates, beliefs = estimate_objects(problem)
    for update in updates:
        latest[update.object_id] = update
        channels.write_objects(list(latest.values()), update.log_time_ns, update.stamp_ns)
    period_ns = None if every_s is None else max(1, round(every_s * 1e9))
    grid = GridEstimate(problem, cuts_every(measurements, period_ns))
    for block in grid.blocks():
        channels.write_belief(block)
    for belief in beliefs:
        channels.write_belief(belief)
    maps = grid.maps()
    for written in maps:
        channels.write_maps(written)
    ordered = tuple(latest[key] for key in sorted(latest))
    return ordered, maps[-1] if maps else None


def _sha256(reader: LogReader) -> str:
    digest = hashlib.sha256()
    for start in range(0, reader.size, _HASH_BLOCK):
        digest.update(reader.source.read(start, min(_HASH_BLOCK, reader.size - start)))
    return digest.hexdigest()
