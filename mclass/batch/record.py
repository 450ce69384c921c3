"""The record of a batch: one entry a log, in ``results.json`` of its folder."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeAlias, overload

import numpy as np

from mclass.errors import UsageError
from mclass.findings import Estimate
from mclass.logs.stores import StoreError, content_of
from mclass.logs.uploads import pending_file
from mclass.places import Place
from mclass.records import FloatArray
from mclass.text.documents import object_json

RESULTS_NAME = "results.json"
_FORMAT = "mclass batch 1"

Status: TypeAlias = Literal["pending", "done", "damaged", "failed"]
"""``pending`` until a log's turn has come and gone; ``damaged`` is done all the same."""

EXIT_CODES_BY_SEVERITY = (0, 3, 4, 2, 1)
"""The worst last: all well; part of a log lost; a threshold missed; no usable model; failed."""


@dataclass(frozen=True, slots=True)
class LogResult:
    """What came of one log.

    Attributes:
        name: Unique in the folder; the stem of the output.
        input: Path of the log, relative to the folder; a URL as it is, but for
            what is secret.
        output: File name in the folder.
        status: How it ended.
        exit_code: That `mclass estimate` would have ended with.
        message: Why it failed; empty when it did not.
        seconds: Time it took.
        input_hash: Of the log.
        output_bytes: Size of the output.
        model: Name of the model file.
        model_hash: Of the model.
        version: Of mclass.
        settings: Options that the results depend on.
        used: Measurements that took part.
        skipped: Detections that did not, by reason.
        objects: Latest estimate of every object, as `mclass.text.documents.object_json`, and
            the ``entropy`` of its class in nats.
        damage: Sentences on parts of the log that could not be used.
        misses: Thresholds that were missed, in words.
        reused: Whether the result is an earlier run's, nothing having changed since.
    """

    name: str
    input: str
    output: str
    status: Status = "pending"
    exit_code: int = 0
    message: str = ""
    seconds: float = 0.0
    input_hash: str = ""
    output_bytes: int = 0
    model: str = ""
    model_hash: str = ""
    version: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict)
    used: int = 0
    skipped: Mapping[str, int] = field(default_factory=dict)
    objects: tuple[Mapping[str, Any], ...] = ()
    damage: tuple[str, ...] = ()
    misses: tuple[str, ...] = ()
    reused: bool = False

    @property
    def has_results(self) -> bool:
        """Whether there is an output."""
        return self.status in ("done", "damaged")


def object_entries(found: Estimate) -> tuple[dict[str, Any], ...]:
    """Objects as a record keeps them."""
    left_out = ("class_poses", "joint_map", "labels")
    entries = []
    for estimate in found.objects:
        entry = object_json(estimate, found.class_names)
        entry["entropy"] = entropy(estimate.class_probabilities)
        entries.append({key: value for key, value in entry.items() if key not in left_out})
    return tuple(entries)


def entropy(probabilities: FloatArray) -> float:
    """Of a distribution, in nats: 0 when it is certain."""
    some = probabilities[probabilities > 0.0]
    return float(-(some * np.log(some)).sum()) + 0.0


def result_json(result: LogResult) -> dict[str, Any]:
    """An entry as JSON can hold it."""
    return {
        "name": result.name,
        "input": result.input,
        "output": result.output,
        "status": result.status,
        "exit_code": result.exit_code,
        "message": result.message,
        "seconds": round(result.seconds, 3),
        "input_hash": result.input_hash,
        "output_bytes": result.output_bytes,
        "model": result.model,
        "model_hash": result.model_hash,
        "version": result.version,
        "settings": dict(result.settings),
        "measurements": {"used": result.used, "skipped": dict(result.skipped)},
        "objects": list(result.objects),
        "damage": list(result.damage),
        "misses": list(result.misses),
        "reused": result.reused,
    }


def result_from(value: Mapping[str, Any]) -> LogResult:
    """The entry that `result_json` wrote.

    Raises:
        ValueError: If it is something else.
    """
    try:
        counts = value["measurements"]
        result = LogResult(
            **{name: value[name] for name in _PLAIN},
            used=counts["used"],
            skipped=dict(counts["skipped"]),
            objects=tuple(value["objects"]),
            damage=tuple(value["damage"]),
            misses=tuple(value["misses"]),
        )
    except (KeyError, TypeError) as error:
        raise ValueError(f"an entry is not as expected ({error})") from error
    texts = (result.name, result.input, result.output)
    if not all(isinstance(text, str) and text for text in texts):
        raise ValueError("an entry has no name, input or output")
    if Path(result.output).name != result.output:
        raise ValueError(f"an output lies outside of the folder ({result.output[:80]!r})")
    return result


_PLAIN = (
    "name",
    "input",
    "output",
    "status",
    "exit_code",
    "message",
    "seconds",
    "input_hash",
    "output_bytes",
    "model",
    "model_hash",
    "version",
    "settings",
    "reused",
)


def entry_line(result: LogResult) -> str:
    """An entry as it stands in the file, on one line: files can be compared line by line."""
    return json.dumps(result_json(result), allow_nan=False)


class Entries(Sequence[LogResult]):
    """Entries kept as lines of text, a few times smaller than what they say."""

    def __init__(self, lines: Sequence[str]) -> None:
        self._lines = lines

    def __len__(self) -> int:
        return len(self._lines)

    @overload
    def __getitem__(self, index: int) -> LogResult: ...
    @overload
    def __getitem__(self, index: slice) -> Entries: ...
    def __getitem__(self, index: int | slice) -> LogResult | Entries:
        if isinstance(index, slice):
            return Entries(self._lines[index])
        return result_from(json.loads(self._lines[index]))


def results_text(lines: Iterable[str]) -> str:
    """The whole file.

    Args:
        lines: From `entry_line`.
    """
    body = ",\n".join(lines)
    return f'{{"format": "{_FORMAT}", "results": [\n{body}\n]}}\n'


def write_whole(path: Place, text: str) -> None:
    """Write a text file that appears complete or not at all.

    Raises:
        LogError: If it cannot be written.
    """
    file = pending_file(path, overwrite=True, source=None)
    try:
        file.open()
        file.write(text.encode("utf-8", "replace"))
        file.publish()
    finally:
        file.discard()


def read_results(path: Place) -> tuple[LogResult, ...]:
    """The entries of a file.

    Raises:
        UsageError: If it cannot be read, or is no such file.
    """
    try:
        document = json.loads(content_of(path), parse_constant=_refuse_constant)
        if not isinstance(document, dict) or document.get("format") != _FORMAT:
            raise ValueError(f"it does not say that its format is {_FORMAT!r}")
        return tuple(result_from(value) for value in document["results"])
    except StoreError as error:
        raise UsageError(str(error)) from error
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise UsageError(f"{path}: not the results of a batch: {error}") from error


def _refuse_constant(text: str) -> float:
    raise ValueError(f"{text} is no number")


def worst_exit_code(results: Iterable[LogResult]) -> int:
    """The worst of all logs' exit codes, a missed threshold being code 4."""
    codes = {0}
    for result in results:
        codes.add(result.exit_code)
        if result.misses:
            codes.add(4)
    return max(codes, key=EXIT_CODES_BY_SEVERITY.index)


def finite(value: Any) -> float:
    """A number out of a record; NaN for what is none."""
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return float(value) if is_number else math.nan
