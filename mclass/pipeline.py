"""The main job: a log or measurements in, beliefs out, in memory and as channels of a log."""

from __future__ import annotations

import contextlib
import itertools
import os
from collections.abc import Collection, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from mclass.config.find import MODEL_FILE_NAME, find_model
from mclass.config.model_file import load_model, parse_model
from mclass.errors import LogError, UsageError
from mclass.findings import Estimate
from mclass.footprint import touching
from mclass.inference import (
    UNEXPLAINED,
    Cut,
    GridEstimate,
    Problem,
    cuts_every,
    estimate_objects,
    prepare,
)
from mclass.logs.measurements import read_measurements
from mclass.logs.reader import LogReader
from mclass.logs.times import find_window
from mclass.logs.writer import LogWriter
from mclass.memory import require_memory
from mclass.model import Model
from mclass.outputs.channels import Encoding, OutputChannels
from mclass.places import Place, PlaceLike, Url, place_of
from mclass.progress import Progress, in_bytes, unheard
from mclass.records import LabelMeasurements, Tally
from mclass.results import BeliefBlock, ObjectEstimate
from mclass.summary import Readout

ModelSource: TypeAlias = "Model | str | os.PathLike[str]"
"""A model, the path of a model file, or the text of one (recognised by its line breaks)."""

NOWHERE = "no direction, and no known position of the object"
MISSED = "points at no cell (larger grid.size, smaller grid.cell_size, or grid.footprint: ray)"


def default_output(log: Place) -> Place:
    """``LOG-stem.mclass.mcap`` beside the log; of a URL, in the working directory."""
    name = f"{log.stem}.mclass.mcap"
    return Path(name) if isinstance(log, Url) else log.with_name(name)


def model_of(source: ModelSource) -> Model:
    """The model itself, or the one in a file or text.

    Raises:
        ConfigError: If the file or text is wrong.
    """
    if isinstance(source, Model):
        return source
    if isinstance(source, str) and "\n" in source:
        return parse_model(source, "model")
    return load_model(Path(source))


def estimate(
    log: PlaceLike,
    model: ModelSource | None = None,
    *,
    output: PlaceLike | None = None,
    start: str | None = None,
    end: str | None = None,
    every_s: float | None = None,
    prefix: str = "/mclass",
    overwrite: bool = False,
    only_new: bool = False,
    in_place: bool = False,
    threads: int = 1,
    progress: Progress = unheard,
) -> Estimate:
    """Estimate every object and every cell of a log.

    Args:
        log: MCAP file or its URL; never touched unless ``in_place``.
        model: A model, the path of a model file or its text. Without it: ``mclass.yaml`` beside
            the log, in the working directory, or attached to the log.
        output: Where to write the log together with the results; None writes nothing.
        start: Messages logged before are ignored: nanoseconds, RFC 3339 or ``+10s``.
        end: Messages logged after are ignored.
        every_s: Maps and full beliefs are also written every so many seconds.
        prefix: Of the new topics.
        overwrite: Replace an existing output.
        only_new: Write the results alone, without the log.
        in_place: Append the results to the log itself; ``output`` must be None. A run that is
            killed leaves a journal beside the log, by which it is restored when next opened.
        threads: Of the grid; the results are the same for any number.
        progress: Told how far the work is.

    Raises:
        ConfigError: The model is wrong or missing.
        ModelError: It would not fit into memory.
        UsageError: ``in_place`` together with ``output`` or ``only_new``, or for a URL.
        LogError: The log cannot be used, or the output cannot be written.
    """
    if in_place and (output is not None or only_new):
        raise UsageError("in place, results go into the log: no output, nor only what is new")
    if in_place and isinstance(place_of(log), Url):
        raise UsageError(f"{place_of(log)}: in place, the log must be a file")
    with LogReader.open(log) as reader:
        reader.on_read = in_bytes(progress, "reading")
        if model is None:
            attached = reader.attachment(MODEL_FILE_NAME)
            model = find_model(reader.path, attached, reader.damage.losses)
        else:
            model = model_of(model)
        window = find_window(reader, start, end)
        contents = read_measurements(reader, model, *window)
        problem = prepare(model, contents.measurements)
        # Not to be held in two orders.
        contents = replace(contents, measurements=problem.measurements)
        require_memory(problem, len(_cuts(problem, every_s)), threads)
        skipped = _skipped(problem, contents.tally.counts)
        losses = (*reader.damage.losses, *contents.losses)
        windowed = window != (None, None)
        _refuse_nothing(len(problem.used), skipped, losses, reader.path, windowed=windowed)
        input_hash = ""
        if in_place:
            _refuse_second_results(reader, prefix)
            output = reader.path
        if output is None:
            found = _solve(problem, contents.frame, None, every_s, threads, progress)
        else:
            with ThreadPoolExecutor(max_workers=1) as pool, contextlib.ExitStack() as stack:
                digest = pool.submit(reader.source.hash)
                if in_place:
                    # What is to be hashed is about to change.
                    digest.result()
                writer = stack.enter_context(
                    LogWriter(
                        place_of(output),
                        source=reader,
                        profile=reader.profile,
                        overwrite=overwrite,
                        carry_over=not only_new,
                        in_place=in_place,
                        progress=in_bytes(progress, "copying"),
                    )
                )
                channels = OutputChannels(
                    writer, contents.encoding, contents.frame, model, prefix=prefix
                )
                found = _solve(problem, contents.frame, channels, every_s, threads, progress)
                skipped = {**contents.tally.counts, **found.skipped}
                _refuse_nothing(found.used, skipped, losses, reader.path, windowed=windowed)
                settings = {
                    "preset": model.inference.preset,
                    "start": start,
                    "end": end,
                    "every_s": every_s,
                    "input": reader.path.name,
                }
                log_time_ns = reader.end_ns or 0
                input_hash = digest.result()
                account = {
                    "used": found.used,
                    "skipped": skipped,
                    "notes": (*contents.notes, *reader.damage.remarks),
                    "damage": losses,
                }
                channels.write_header(
                    log_time_ns, input_hash=input_hash, settings=settings, account=account
                )
                channels.write_layout(log_time_ns)
        return replace(
            found,
            skipped={**contents.tally.counts, **found.skipped},
            track=contents.track,
            notes=(*contents.notes, *reader.damage.remarks),
            damage=(*reader.damage.losses, *contents.losses),
            input=reader.path,
            input_hash=input_hash,
            output=None if output is None else place_of(output),
        )


def infer(
    measurements: LabelMeasurements,
    model: ModelSource,
    *,
    output: PlaceLike | None = None,
    frame: str = "world",
    encoding: Encoding = "ros2",
    every_s: float | None = None,
    prefix: str = "/mclass",
    overwrite: bool = False,
    settings: Mapping[str, Any] | None = None,
    progress: Progress = unheard,
) -> Estimate:
    """Estimate every object and every cell from measurements.

    Args:
        measurements: From `mclass.arrays.measurements_from_arrays`, a log or an output.
        model: A model, the path of a model file or its text.
        output: Where to write a log that holds the results alone; None writes nothing.
        frame: Name of the world frame that the measurements are in.
        encoding: Of the output.
        every_s: Maps and full beliefs are also written every so many seconds.
        prefix: Of the topics.
        overwrite: Replace an existing output.
        settings: What else the output's metadata record shall say.
        progress: Told how far the work is.

    Raises:
        ConfigError: The model is wrong.
        ModelError: It would not fit into memory.
        UsageError: The measurements know other labels than the model.
        LogError: The output cannot be written.
    """
    model = model_of(model)
    if measurements.label_names != model.classes.label_names:
        raise UsageError(
            f"the measurements' labels {', '.join(measurements.label_names)} are not those of "
            f"{model.name}: {', '.join(model.classes.label_names)}"
        )
    problem = prepare(model, measurements)
    require_memory(problem, len(_cuts(problem, every_s)), threads=1)
    with contextlib.ExitStack() as stack:
        channels = None
        if output is not None:
            profile = "ros2" if encoding == "ros2" else ""
            writer = stack.enter_context(
                LogWriter(place_of(output), profile=profile, overwrite=overwrite)
            )
            channels = OutputChannels(writer, encoding, frame, model, prefix=prefix)
        found = _solve(problem, frame, channels, every_s, progress=progress)
        if channels is not None:
            log_time_ns = int(measurements.frames.log_times_ns.max(initial=0))
            channels.write_header(
                log_time_ns,
                settings={"preset": model.inference.preset, "every_s": every_s, **(settings or {})},
                account={"used": found.used, "skipped": found.skipped},
            )
            channels.write_layout(log_time_ns)
    return replace(found, output=None if output is None else place_of(output))


def _refuse_nothing(
    used: int, skipped: Mapping[str, int], losses: Collection[str], path: Place, *, windowed: bool
) -> None:
    """Refuse a log of whose detections none can be used.

    A whole log without any is no failure; a part of one was asked for because of what is in it.
    """
    if used == 0 and (skipped or losses or windowed):
        reasons = [*(f"{count} {reason}" for reason, count in skipped.items()), *losses]
        reasons = reasons or ["none lies between the given times"]
        raise LogError(f"no detection can be used: {'; '.join(reasons)}", path=str(path))


def _refuse_second_results(reader: LogReader, prefix: str) -> None:
    """Refuse to append results under the topics of others that are there."""
    taken = [c.topic for c in reader.channels if c.topic.startswith(prefix.rstrip("/") + "/")]
    if taken:
        raise LogError(
            f"has a topic {taken[0]} already. Choose another --prefix, or write a copy.",
            path=str(reader.path),
        )


def _skipped(problem: Problem, counts: Mapping[str, int]) -> dict[str, int]:
    """Detections left out while reading, and those that inference can make nothing of."""
    tally = Tally(dict(counts))
    tally.add(UNEXPLAINED, len(problem.measurements) - len(problem.used))
    return tally.counts


def _without_effect(problem: Problem, estimated: Collection[str]) -> dict[str, int]:
    """Measurements that say nothing about any cell or object, by reason.

    Args:
        problem: What was solved.
        estimated: Ids of the objects that have an estimate.
    """
    found, known = problem.measurements, problem.model.objects
    located = np.isfinite(found.directions[problem.used]).all(axis=1)
    # One more for the detections without id, whose index is -1.
    owners = found.object_index[problem.used]
    has_place = np.array([*(name in known for name in found.object_ids), False])[owners]
    has_estimate = np.array([*(name in estimated for name in found.object_ids), True])[owners]
    anonymous = np.flatnonzero(located & (owners < 0))
    if problem.grid is not None and len(anonymous):
        pointing = problem.looks.pointing.select(problem.used[anonymous])
        has_estimate[anonymous] = touching(problem.grid, pointing)
    tally = Tally()
    tally.add(NOWHERE, int((~located & ~has_place).sum()))
    tally.add(MISSED, int((located & ~has_estimate).sum()))
    return tally.counts


def _moments(updates: Iterable[ObjectEstimate]) -> Iterator[dict[str, ObjectEstimate]]:
    """Updates that one frame caused, by object; none twice.

    A frame of a thousand objects would otherwise be written a thousand times, with all of them.
    """
    together: dict[str, ObjectEstimate] = {}
    moment = None
    for update in updates:
        times = update.stamp_ns, update.log_time_ns
        if together and (times != moment or update.object_id in together):
            yield together
            together = {}
        together[update.object_id], moment = update, times
    if together:
        yield together


def _solve(
    problem: Problem,
    frame: str,
    channels: OutputChannels | None,
    every_s: float | None,
    threads: int = 1,
    progress: Progress = unheard,
) -> Estimate:
    """Estimate, writing results as they come if there is somewhere to write them."""
    measurements = problem.measurements
    updates, beliefs = _followed(problem, progress)
    grid = GridEstimate(problem, _cuts(problem, every_s), threads)
    blocks = itertools.chain(_counted(grid.blocks(), progress), beliefs)
    if channels is None:
        for _ in blocks:
            pass
        maps = grid.maps()
    else:
        channels.write_measurements(measurements)
        latest: dict[str, ObjectEstimate] = {}
        for together in _moments(updates):
            latest.update(together)
            any_of_them = next(iter(together.values()))
            channels.write_objects(
                list(latest.values()), any_of_them.log_time_ns, any_of_them.stamp_ns
            )
        for block in blocks:
            channels.write_belief(block)
        maps = grid.maps()
        for written in maps:
            channels.write_maps(written)
    history: dict[str, list[ObjectEstimate]] = {}
    for update in updates:
        history.setdefault(update.object_id, []).append(update)
    ids = sorted(history)
    idle = _without_effect(problem, history)
    return Estimate(
        model=problem.model,
        frame=frame,
        objects=tuple(history[key][-1] for key in ids),
        history={key: tuple(history[key]) for key in ids},
        object_beliefs={
            belief.object_id: belief for belief in sorted(beliefs, key=lambda b: b.object_id)
        },
        maps=maps[-1] if maps else None,
        skipped={**_skipped(problem, {}), **idle},
        idle=sum(idle.values()),
        problem=problem,
    )


def _followed(
    problem: Problem, progress: Progress
) -> tuple[list[ObjectEstimate], list[BeliefBlock]]:
    """Every object's estimates and belief, counting measurements."""
    named = int((problem.measurements.object_index[problem.used] >= 0).sum())
    # Without any id, objects are found among all of them.
    total, done = named or len(problem.used), itertools.count(1)
    progress("following objects", 0, total, "measurements")

    def watch(estimate: ObjectEstimate, readout: Readout) -> None:
        progress("following objects", next(done), total, "measurements")

    return estimate_objects(problem, watch=watch)


def _counted(blocks: Iterable[BeliefBlock], progress: Progress) -> Iterator[BeliefBlock]:
    """The grid's blocks as they come, counting tiles."""
    progress("mapping", 0, 0, "tiles")
    for block in blocks:
        progress("mapping", block.block + 1, block.blocks, "tiles")
        yield block


def _cuts(problem: Problem, every_s: float | None) -> list[Cut]:
    """When maps are written."""
    period_ns = None if every_s is None else max(1, round(every_s * 1e9))
    return cuts_every(problem.measurements, period_ns)
