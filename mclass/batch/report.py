"""A batch in the terminal, as JSON and for CI servers."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from mclass.batch.judgement import Change
from mclass.batch.record import LogResult, result_json
from mclass.text.documents import JsonObject
from mclass.text.junit import JunitCase
from mclass.text.terminal import Terminal, table, wrap
from mclass.text.values import count_text

_MOST_ROWS = 200
_LONGEST_SENTENCE = 1000


def batch_text(
    results: Sequence[LogResult], changes: Iterable[Change], seconds: float, terminal: Terminal
) -> str:
    """Table of logs, then what went wrong, what changed, and a summary.

    Args:
        results: One a log.
        changes: Since the baseline.
        seconds: Time that the batch took.
        terminal: What the reader's terminal can show.
    """
    listed = results
    if len(results) > _MOST_ROWS:
        listed = [result for result in results if _is_remarkable(result)][:_MOST_ROWS]
    rows = [_row(result, terminal) for result in listed]
    headings = ["log", "outcome", "used", "skipped", "objects", "seconds"]
    lines = table(headings, rows, "<<>>>>", terminal, elastic=(0,)) if rows else []
    if len(listed) < len(results):
        lines.append(f"and {count_text(len(results) - len(listed), 'more log')}")
    lines += [""] if lines else []
    for result in listed:
        who = terminal.clean(result.name)
        for sentence in _sentences(result):
            text = f"{who}: {terminal.clean(sentence, _LONGEST_SENTENCE)}"
            lines += [terminal.paint(line, "warning") for line in wrap(text, terminal, "  ")]
    for change in changes:
        if not change.regression:
            text = f"{terminal.clean(change.name)}: {terminal.clean(change.sentence)}"
            lines += wrap(text, terminal, "  ")
    return "\n".join([*lines, summary_text(results, seconds)])


def summary_text(results: Sequence[LogResult], seconds: float) -> str:
    """``20 logs: 18 done (5 of them before), 1 damaged, 1 failed; 12.3 s``."""
    done = [result for result in results if result.status == "done"]
    before = sum(result.reused for result in results if result.has_results)
    parts = [f"{len(done)} done"]
    for status in ("damaged", "failed", "pending"):
        count = sum(result.status == status for result in results)
        parts += [f"{count} {status}"] if count else []
    missed = sum(bool(result.misses) for result in results)
    parts += [f"{missed} missed a threshold"] if missed else []
    parts += [f"{before} kept from before"] if before else []
    return f"{count_text(len(results), 'log')}: {', '.join(parts)}; {seconds:.1f} s"


def batch_json(
    results: Iterable[LogResult], changes: Iterable[Change], seconds: float, exit_code: int
) -> JsonObject:
    """The document of ``batch``."""
    return {
        "results": [result_json(result) for result in results],
        "changes": [
            {"name": change.name, "change": change.sentence, "regression": change.regression}
            for change in changes
        ],
        "seconds": round(seconds, 3),
        "exit_code": exit_code,
    }


def junit_cases(results: Iterable[LogResult]) -> list[JunitCase]:
    """One test a log: an error when it failed, a failure when it missed a threshold."""
    return [
        JunitCase(
            name=result.name,
            seconds=result.seconds,
            failures=result.misses,
            error=result.message,
            output="\n".join([f"input: {result.input}", *result.damage]),
        )
        for result in results
    ]


def _row(result: LogResult, terminal: Terminal) -> list[str]:
    outcome: str = result.status
    marks = ["missed"] if result.misses else []
    marks += ["kept"] if result.reused else []
    if marks:
        outcome += f" ({', '.join(marks)})"
    figures = ["-"] * 3
    if result.has_results:
        skipped = sum(result.skipped.values())
        figures = [str(result.used), str(skipped), str(len(result.objects))]
    return [terminal.clean(result.name), outcome, *figures, f"{result.seconds:.1f}"]


def _is_remarkable(result: LogResult) -> bool:
    return result.status != "done" or bool(result.misses)


def _sentences(result: LogResult) -> list[str]:
    """What is to be said of a log beside its figures."""
    return [*([result.message] if result.message else []), *result.damage, *result.misses]
