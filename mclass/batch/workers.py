"""A pool of processes that outlives the death of any of them.

One process that is killed (as the system does when memory runs out) costs the job it was at,
nothing else. Processes are started afresh, not forked, so that it works the same everywhere;
a script that starts them needs the usual ``if __name__ == "__main__":``.
"""

from __future__ import annotations

import contextlib
import itertools
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Generator, Iterable, Iterator
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Generic, TypeVar

JobT = TypeVar("JobT")
ResultT = TypeVar("ResultT")

_PATIENCE_S = 10.0
_THREADS = "OPENBLAS_NUM_THREADS"
_spawn = multiprocessing.get_context("spawn")


class DiedError(Exception):
    """A process ended in the middle of a job; the text says how."""


class _Worker(Generic[JobT, ResultT]):
    """One process and the job it is at."""

    def __init__(self, work: Callable[[JobT], ResultT]) -> None:
        self.connection, theirs = _spawn.Pipe()
        self.process: SpawnProcess = _spawn.Process(target=_serve, args=(theirs,), daemon=True)
        with _starting_workers():
            self.process.start()
        theirs.close()
        self.job: JobT | None = None
        self._work: Callable[[JobT], ResultT] | None = work

    def give(self, job: JobT) -> None:
        """Hand over the next job."""
        self.job = job
        with contextlib.suppress(OSError):  # its death is noticed when the result is awaited
            if self._work is not None:
                self.connection.send(self._work)
                self._work = None
            self.connection.send(job)

    def take(self) -> ResultT | DiedError:
        """The result that is ready, or how the process died."""
        self.job = None
        try:
            result: ResultT = self.connection.recv()
        except (EOFError, OSError):
            self.process.join()
            return DiedError(_how(self.process.exitcode))
        return result

    def stop(self) -> None:
        """Ask the process to end."""
        self.connection.close()
        if self.job is not None:
            self.process.terminate()

    def join(self) -> None:
        """Wait for the end; make one if it does not come."""
        self.process.join(_PATIENCE_S)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()


def each(
    work: Callable[[JobT], ResultT], jobs: Iterable[JobT], processes: int
) -> Generator[tuple[JobT, ResultT | DiedError], None, None]:
    """Do jobs in processes of their own; yields each when it is finished, in any order.

    Closing the iterator ends the processes; what they were at is undone as by an interrupt.

    Args:
        work: Called with each job; both must be picklable, and it should not raise.
        jobs: Taken one by one as processes become free.
        processes: How many at once.
    """
    queue = iter(jobs)
    workers: list[_Worker[JobT, ResultT]] = []
    try:
        for first in itertools.islice(queue, processes):
            workers.append(_Worker(work))
            workers[-1].give(first)
        while busy := {worker.connection: worker for worker in workers if worker.job is not None}:
            for connection in wait(list(busy)):
                assert isinstance(connection, Connection)
                worker = busy[connection]
                job, result = worker.job, worker.take()
                assert job is not None
                if isinstance(result, DiedError):
                    workers.remove(worker)
                for following in itertools.islice(queue, 1):
                    if isinstance(result, DiedError):
                        worker = _Worker(work)
                        workers.append(worker)
                    worker.give(following)
                yield job, result
    finally:
        for worker in workers:
            worker.stop()
        for worker in workers:
            worker.join()


def _serve(connection: Connection) -> None:
    """A process's life: the work, then jobs until there are no more."""
    # Ctrl-C reaches every process of a terminal; the parent decides what it means.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    with contextlib.suppress(EOFError, OSError):
        work = connection.recv()
        while True:
            connection.send(work(connection.recv()))


@contextlib.contextmanager
def _starting_workers() -> Iterator[None]:
    """What a new process inherits: one thread for matrix products, and deafness to Ctrl-C.

    Deafness, as it would otherwise be interrupted while it still imports; one thread, as every
    core has a process of its own already.
    """
    before = os.environ.get(_THREADS)
    os.environ.setdefault(_THREADS, "1")
    on_main_thread = threading.current_thread() is threading.main_thread()
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN) if on_main_thread else None
    try:
        yield
    finally:
        if on_main_thread:
            signal.signal(signal.SIGINT, handler)
        if before is None:
            del os.environ[_THREADS]


def _how(exit_code: int | None) -> str:
    if exit_code is not None and exit_code < 0:
        try:
            name = signal.Signals(-exit_code).name
        except ValueError:
            name = f"signal {-exit_code}"
        advice = " (out of memory? try fewer --jobs)" if name == "SIGKILL" else ""
        return f"its process was ended by {name}{advice}"
    return f"its process ended with code {exit_code}"
