"""A batch from its first log to its last, and a record that is true at every moment."""

from __future__ import annotations

import contextlib
import os
import re
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import mclass
from mclass.batch.judgement import Change, Tolerances, compare, judged, with_regressions
from mclass.batch.plan import Job, find_logs, plan
from mclass.batch.record import (
    RESULTS_NAME,
    Entries,
    LogResult,
    entry_line,
    read_results,
    results_text,
    worst_exit_code,
    write_whole,
)
from mclass.batch.work import Estimation
from mclass.batch.workers import DiedError, each
from mclass.errors import LogError, UsageError
from mclass.logs.stores import Store, size_of
from mclass.places import Place, Url
from mclass.rules import Rule

_LEAST_PAUSE_S, _MOST_PAUSE_S = 0.5, 15.0
_WRITING_SHARE = 0.02
_LEFTOVER = re.compile(r"\..+\.part-\d+(-\d+)?")

Executor: TypeAlias = Callable[
    [Estimation, Iterable[Job]], Generator[tuple[Job, "LogResult | DiedError"], None, None]
]
"""Does jobs somewhere and yields each once, when it is finished."""


@dataclass(frozen=True)
class BatchReport:
    """What a batch did.

    Attributes:
        results: One a log of this batch, in the order of the logs; decoded when looked at.
        changes: Since the baseline; empty without one.
        seconds: Time from start to end.
    """

    results: Sequence[LogResult]
    changes: tuple[Change, ...]
    seconds: float

    @property
    def exit_code(self) -> int:
        """The worst of all logs'."""
        return worst_exit_code(self.results)


@dataclass(frozen=True)
class Criteria:
    """What results are judged by.

    Attributes:
        rules: Conditions on which a log's result fails.
        baseline: Results to compare with; None for no comparison.
        tolerances: How much may change.
    """

    rules: Sequence[Rule] = ()
    baseline: Sequence[LogResult] | None = None
    tolerances: Tolerances = field(default_factory=Tolerances)


def run_batch(
    sources: Sequence[str],
    folder: Place,
    work: Estimation,
    *,
    processes: int | None = None,
    executor: Executor | None = None,
    criteria: Criteria | None = None,
    overwrite: bool = False,
    progress: Callable[[int, int, LogResult | None], None] | None = None,
) -> BatchReport:
    """Estimate every log; one that fails does not stop the others.

    The record ``results.json`` in the folder is replaced as logs finish. When the batch is
    interrupted it is true all the same, and the next run goes on where this one stopped.

    Args:
        sources: Logs, URLs, folders and patterns, as for `mclass.batch.plan.find_logs`.
        folder: Where outputs and record go, a path or URL; made if it is not there.
        work: What to do with each log.
        processes: How many logs at once; one a core when None.
        executor: Who does it; processes of this machine when None.
        criteria: What results are judged by.
        overwrite: Whether files may be replaced that are not from this batch.
        progress: Called with logs done, logs in all, and the last result.

    Raises:
        UsageError: If there are no logs, or the folder cannot be used.
        LogError: If the record cannot be written, or a store fails.
    """
    began = time.monotonic()
    criteria = criteria or Criteria()
    count = max(1, processes or available_cores())
    execute = executor or (lambda work, jobs: each(work, jobs, count))
    with _folder(folder):
        path = folder / RESULTS_NAME
        known = () if size_of(path) is None else read_results(path)
        jobs = plan(find_logs(sources, folder), folder, known, overwrite=overwrite)
        record = _Record(path, (*known, *(job.entry for job in jobs)))
        del known
        names = [job.entry.name for job in jobs]
        todo = (replace(job, entry=record.entry(job.entry.name)) for job in jobs)
        if progress is not None:
            progress(0, len(jobs), None)
        try:
            record.write()
            with contextlib.closing(execute(work, todo)) as finished:
                for done, (job, outcome) in enumerate(finished, start=1):
                    if isinstance(outcome, DiedError):
                        result = _failed(job, work, outcome)
                    else:
                        result = judged(outcome, criteria.rules)
                    record.put(result)
                    if progress is not None:
                        progress(done, len(jobs), result)
            _remove_leftovers(folder)
        finally:
            record.write()
        results = record.entries(names)
        changes: list[Change] = []
        if criteria.baseline is not None:
            changes = compare(results, criteria.baseline, criteria.tolerances)
            record.put(*with_regressions(results, changes))
            record.write()
            results = record.entries(names)
    return BatchReport(results, tuple(changes), time.monotonic() - began)


def available_cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _failed(job: Job, work: Estimation, cause: DiedError) -> LogResult:
    return replace(
        LogResult(job.entry.name, job.entry.input, job.entry.output),
        status="failed",
        exit_code=1,
        message=f"{job.log}: {cause}",
        version=mclass.__version__,
        settings=work.settings,
    )


class _Record:
    """The record in memory and on disk.

    Written soon after every result, but seldom enough that writing takes a small share of the
    time however many logs there are.
    """

    def __init__(self, path: Place, entries: Iterable[LogResult]) -> None:
        self._lines: dict[str, str] = {}
        for entry in entries:
            self._lines.setdefault(entry.name, entry_line(entry))
        self._path = path
        self._lock = threading.RLock()
        self._timer: threading.Timer | None = None
        self._due = 0.0

    def entry(self, name: str) -> LogResult:
        """One entry."""
        return self.entries([name])[0]

    def entries(self, names: Iterable[str]) -> Entries:
        """Some of the entries, as they are now."""
        return Entries([self._lines[name] for name in names])

    def put(self, *results: LogResult) -> None:
        """Take in results; they are written at once or a little later."""
        with self._lock:
            self._lines.update((result.name, entry_line(result)) for result in results)
            if self._timer is None:
                self._timer = threading.Timer(self._due - time.monotonic(), self._write_later)
                self._timer.daemon = True
                self._timer.start()

    def write(self) -> None:
        """Write now."""
        with self._lock:
            began = time.monotonic()
            if self._timer is not None:
                self._timer.cancel()
                self._timer = None
            write_whole(self._path, results_text(self._lines.values()))
            ended = time.monotonic()
            pause = (ended - began) / _WRITING_SHARE
            self._due = ended + min(max(pause, _LEAST_PAUSE_S), _MOST_PAUSE_S)

    def _write_later(self) -> None:
        with self._lock:
            if self._timer is not threading.current_thread():
                return  # all was written while this waited
            # What cannot be written now is tried again at the end, where failure is told.
            with contextlib.suppress(LogError):
                self.write()


@contextlib.contextmanager
def _folder(folder: Place) -> Iterator[None]:
    """The folder, made if need be, and nobody else's while it is used; but for URLs."""
    if isinstance(folder, Url):
        Store(folder / RESULTS_NAME).check_writable()
        yield
        return
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{folder}: cannot be made: {error.strerror}") from error
    try:
        import fcntl  # noqa: PLC0415 (not on every system)
    except ImportError:
        yield
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise LogError("another batch is at work in this folder", path=str(folder)) from None
        except OSError:
            pass  # a file system without locks
        else:
            _remove_leftovers(folder)
        yield
    finally:
        os.close(descriptor)


def _remove_leftovers(folder: Place) -> None:
    """Delete what processes that were killed had begun to write."""
    if isinstance(folder, Url):
        return
    for path in folder.iterdir():
        if _LEFTOVER.fullmatch(path.name):
            with contextlib.suppress(OSError):
                path.unlink()
