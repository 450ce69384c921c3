"""What `evaluate` finds: figures, confusions, objects."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from mclass.evaluation.scores import LogScore, ObjectScore
from mclass.evaluation.summary import METRICS, Evaluation, Figure
from mclass.text.documents import JsonObject, finite
from mclass.text.junit import JunitCase
from mclass.text.terminal import Terminal, table, wrap
from mclass.text.values import count_text

_LISTED = 50
_NARROWEST_MEANING = 20


def evaluation_text(evaluation: Evaluation, failures: Sequence[str], terminal: Terminal) -> str:
    """Figures with their intervals, confusions, and every object.

    Args:
        evaluation: Of all logs.
        failures: Rules that are missed, in words.
        terminal: What the reader's terminal can show.
    """
    logs = evaluation.logs
    objects = sum(len(log.objects) for log in logs)
    lines = [f"{count_text(len(logs), 'log')}, {count_text(objects, 'object')} matched", ""]
    lines += _figure_lines(evaluation, terminal)
    if evaluation.confusion:
        rows = [
            [terminal.clean(true), terminal.clean(named), str(count)]
            for (true, named), count in sorted(evaluation.confusion.items())
        ]
        lines += ["", *table(["true class", "named", "objects"], rows, "<<>", terminal, (0, 1))]
    if objects:
        lines += ["", *_object_lines(logs, terminal)]
        if objects > _LISTED:
            lines.append(f"+ {objects - _LISTED} more; --format json lists all")
    for log in logs:
        for what, ids in (("missed", log.missed), ("invented", log.invented)):
            if ids:
                named = ", ".join(terminal.clean(key) for key in ids)
                lines += wrap(f"{terminal.clean(log.name)}: {what} {named}", terminal, "  ")
    if failures:
        lines.append("")
        for failure in failures:
            lines += [terminal.paint(line, "warning") for line in wrap(failure, terminal, "  ")]
    return "\n".join(lines)


def _figure_lines(evaluation: Evaluation, terminal: Terminal) -> list[str]:
    """Figures with what they mean beside them, or below where there is no room."""
    interval = "95 %" if len(evaluation.logs) > 1 else ""
    headings = ["figure", "value", interval]
    figures = {
        name: [name, _value(name, figure.value), _interval(name, figure)]
        for name, figure in evaluation.figures.items()
    }
    widths = [max(map(len, column)) for column in zip(headings, *figures.values(), strict=True)]
    room = terminal.width - sum(widths) - 2 * len(widths)
    rows: list[list[str]] = []
    for name, cells in figures.items():
        meaning = METRICS[name].meaning
        if room >= _NARROWEST_MEANING:
            rows.append([*cells, "\n".join(wrap(meaning, replace(terminal, width=room)))])
        else:
            rows += [[*cells, ""], [f"  {meaning}"]]
    return table([*headings, ""], rows, "<><<", terminal)


def _object_lines(logs: Sequence[LogScore], terminal: Terminal) -> list[str]:
    """Objects, under the log that they are of."""
    rows: list[list[str]] = []
    listed = 0
    for log in logs:
        scores = log.objects[: _LISTED - listed]
        if scores:
            rows += [[terminal.clean(log.name, terminal.width)]]
            rows += [_object_row(score, terminal) for score in scores]
        listed += len(scores)
    headings = ["  object", "class", "P", "turned", "off [m]", "in HDR"]
    return table(headings, rows, "<<>>>>", terminal, elastic=(0, 1))


def _value(name: str, value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.0f}" if METRICS[name].kind == "count" else f"{value:.3f}"


def _interval(name: str, figure: Figure) -> str:
    if figure.low is None or figure.high is None:
        return ""
    return f"{_value(name, figure.low)} to {_value(name, figure.high)}"


def _object_row(score: ObjectScore, terminal: Terminal) -> list[str]:
    named = score.named_class
    if score.correct < 1.0:
        sign = "=" if score.correct else "not"
        named = f"{named} ({sign} {score.true_class})"
    return [
        f"  {terminal.clean(score.true_id)}",
        terminal.clean(named),
        f"{score.confidence:.3f}",
        f"{math.degrees(score.orientation_error):.1f}{terminal.sign('°')}",
        f"{score.position_error:.2f}",
        f"{100.0 * score.level:.0f} %",
    ]


def evaluation_json(evaluation: Evaluation, failures: Sequence[str]) -> JsonObject:
    """The document of ``evaluate``; angles in degrees, lengths in metres."""
    return {
        "figures": {
            name: {
                "value": _finite(figure.value),
                "low": _finite(figure.low),
                "high": _finite(figure.high),
            }
            for name, figure in evaluation.figures.items()
        },
        "confusion": [
            {"true": true, "named": named, "objects": count}
            for (true, named), count in sorted(evaluation.confusion.items())
        ],
        "logs": [
            {
                "log": log.name,
                "objects": [_object_json(score) for score in log.objects],
                "missed": list(log.missed),
                "invented": list(log.invented),
            }
            for log in evaluation.logs
        ],
        "failures": list(failures),
    }


def _finite(value: float | None) -> float | None:
    return None if value is None else finite(value)


def _object_json(score: ObjectScore) -> JsonObject:
    return {
        "true_id": score.true_id,
        "id": score.estimate_id,
        "true_class": score.true_class,
        "class": score.named_class,
        "correct": score.correct,
        "confidence": finite(score.confidence),
        "orientation_error_deg": finite(math.degrees(score.orientation_error)),
        "symmetric_error_deg": finite(math.degrees(score.symmetric_error)),
        "mode_error_deg": finite(math.degrees(score.mode_error)),
        "position_error": finite(score.position_error),
        "log_loss": finite(score.log_loss),
        "brier": finite(score.brier),
        "level": finite(score.level),
    }


def junit_cases(
    evaluation: Evaluation, outcomes: Sequence[tuple[str, str | None]]
) -> list[JunitCase]:
    """One test for each rule, or one for the evaluation as a whole where there is none.

    Args:
        evaluation: Of all logs.
        outcomes: Each rule, and how it is missed; None if it is met.
    """
    figures = "\n".join(
        f"{name} {_value(name, figure.value)}" for name, figure in evaluation.figures.items()
    )
    if not outcomes:
        return [JunitCase("evaluation", output=figures)]
    return [
        JunitCase(rule, failures=(miss,) if miss else (), output=figures) for rule, miss in outcomes
    ]
