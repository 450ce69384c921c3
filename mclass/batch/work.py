"""The work on one log of a batch, wherever it is done."""

from __future__ import annotations

import contextlib
import time
from dataclasses import dataclass, replace
from typing import Any

import mclass
from mclass.batch.plan import Job
from mclass.batch.record import LogResult, object_entries
from mclass.config.find import MODEL_FILE_NAME, find_model
from mclass.errors import MclassError
from mclass.logs.reader import LogReader, open_log_source
from mclass.logs.stores import size_of
from mclass.model import Model
from mclass.pipeline import estimate
from mclass.places import Place


@dataclass(frozen=True)
class Estimation:
    """Estimates one log after the other; can be sent to other processes.

    Attributes:
        model: For all logs; None finds one for each.
        start: As for `mclass.pipeline.estimate`, like the others.
        end: Messages logged after are ignored.
        every_s: Maps and full beliefs are also written every so many seconds.
        prefix: Of the new topics.
        anew: Do logs again that are done.
    """

    model: Model | None
    start: str | None = None
    end: str | None = None
    every_s: float | None = None
    prefix: str = "/mclass"
    anew: bool = False

    @property
    def settings(self) -> dict[str, Any]:
        """What results depend on, the log, the model and the version apart."""
        return {
            "start": self.start,
            "end": self.end,
            "every_s": self.every_s,
            "prefix": self.prefix,
        }

    def __call__(self, job: Job) -> LogResult:
        """Do one log; whatever is wrong with it is told in the result, not raised."""
        began = time.monotonic()
        entry = job.entry
        blank = LogResult(
            entry.name,
            entry.input,
            entry.output,
            version=mclass.__version__,
            settings=self.settings,
        )
        try:
            if not self.anew and self._is_current(job):
                return replace(entry, reused=True, misses=())
            done = self._estimate(job, blank)
        except MclassError as error:
            done = replace(blank, status="failed", exit_code=error.exit_code, message=str(error))
        except MemoryError:
            message = f"{job.log}: not enough memory; use a coarser grid, or fewer --jobs"
            done = replace(blank, status="failed", exit_code=1, message=message)
        except Exception as error:  # one log's failure must not stop the others
            message = f"{job.log}: unexpected {type(error).__name__}: {error}. This is a bug"
            done = replace(blank, status="failed", exit_code=1, message=message)
        return replace(done, seconds=time.monotonic() - began)

    def _estimate(self, job: Job, blank: LogResult) -> LogResult:
        output = job.folder / job.entry.output
        found = estimate(
            job.log,
            self.model,
            output=output,
            start=self.start,
            end=self.end,
            every_s=self.every_s,
            prefix=self.prefix,
            overwrite=True,
        )
        return replace(
            blank,
            status="damaged" if found.damage else "done",
            exit_code=3 if found.damage else 0,
            input_hash=found.input_hash,
            output_bytes=size_of(output) or 0,
            model=found.model.name,
            model_hash=found.model.hash,
            used=found.used,
            skipped=found.skipped,
            objects=object_entries(found),
            damage=found.damage,
        )

    def _is_current(self, job: Job) -> bool:
        """Whether an earlier result holds: same log, model, settings and version, output there."""
        entry = job.entry
        if not entry.has_results or entry.version != mclass.__version__:
            return False
        if dict(entry.settings) != self.settings:
            return False
        if size_of(job.folder / entry.output) != entry.output_bytes:
            return False
        return self._model_hash(job.log) == entry.model_hash and _hash(job.log) == entry.input_hash

    def _model_hash(self, log: Place) -> str:
        if self.model is not None:
            return self.model.hash
        with LogReader.open(log) as reader:
            attached = reader.attachment(MODEL_FILE_NAME)
            return find_model(reader.path, attached, reader.damage.losses).hash


def _hash(log: Place) -> str:
    """As outputs record it."""
    with contextlib.closing(open_log_source(log)) as source:
        # A store that tells no versions leaves it open whether the log is the same.
        return source.hash() or "unknown"
