"""The work of a batch on a Dask cluster."""

from __future__ import annotations

import importlib
import itertools
from collections.abc import Generator, Iterable
from contextlib import closing
from dataclasses import replace
from typing import Any

from mclass.batch.plan import Job
from mclass.batch.record import LogResult
from mclass.batch.run import Executor
from mclass.batch.work import Estimation
from mclass.batch.workers import DiedError
from mclass.errors import UsageError
from mclass.places import Place, Url

_PATIENCE = "10s"
_AHEAD = 2
"""Logs that wait for each thread of the cluster, so that none stands idle."""


def on_cluster(address: str) -> Executor:
    """An executor for `mclass.batch.run.run_batch`.

    Every log is given out once more when the machine that works on it is lost; whichever
    machine finishes it, it counts once. Machines need mclass, and the same paths.

    Args:
        address: Of the scheduler, such as ``tcp://10.0.0.5:8786``.

    Raises:
        UsageError: If Dask is not installed; later, if there is no scheduler.
    """
    try:
        distributed: Any = importlib.import_module("distributed")
    except ImportError as error:
        raise UsageError("--dask needs Dask: pip install 'mclass[dask]'") from error

    def execute(
        work: Estimation, jobs: Iterable[Job]
    ) -> Generator[tuple[Job, LogResult | DiedError], None, None]:
        try:
            client = distributed.Client(address, timeout=_PATIENCE, set_as_default=False)
        except (OSError, ValueError) as error:
            raise UsageError(f"no Dask scheduler answers at {address}: {error}") from error
        with closing(client):
            queue = iter(jobs)
            threads = sum(client.nthreads().values())
            given: dict[str, Job] = {}

            def next_futures(count: int) -> list[Any]:
                futures = []
                for job in itertools.islice(queue, count):
                    future = client.submit(work, _anywhere(job), pure=False)
                    given[future.key] = job
                    futures.append(future)
                return futures

            running = distributed.as_completed(
                next_futures(_AHEAD * max(1, threads)), loop=client.loop
            )
            for future in running:
                job = given.pop(future.key)
                cause = future.exception()
                running.update(next_futures(1))
                yield job, future.result() if cause is None else _failure(cause)
                future.release()

    return execute


def _anywhere(job: Job) -> Job:
    """The job for a process with another working directory."""
    return replace(job, log=_absolute(job.log), folder=_absolute(job.folder))


def _absolute(place: Place) -> Place:
    return place if isinstance(place, Url) else place.absolute()


def _failure(error: BaseException) -> DiedError:
    """What the cluster says of a log that it could not do."""
    return DiedError(f"the cluster gave up: {type(error).__name__}: {str(error)[:500]}")
