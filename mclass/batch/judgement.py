"""What a result is judged by: rules on its figures, and what changed since another batch."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from mclass.batch.record import LogResult, finite
from mclass.classes import BACKGROUND
from mclass.rules import Metric, Quantity, Rule, misses

METRICS: Mapping[str, Metric] = {
    "skipped": Metric("count", "detections that took no part; with % of all detections"),
    "used": Metric("count", "detections that took part; with % of all detections"),
    "objects": Metric("number", "objects"),
    "entropy": Metric("number", "greatest entropy of any object's class, in nats"),
    "mean_entropy": Metric("number", "mean entropy of the objects' classes, in nats"),
    "background": Metric("count", "objects that are most probably nothing; with % of all objects"),
    "ties": Metric("count", "objects with equally probable classes; with % of all objects"),
    "damage": Metric("number", "kinds of damage found in the log"),
    "seconds": Metric("number", "time that the log took"),
}
"""What rules can be about, figures of one log each."""

_CO_LEADING = 0.9
"""A mode with this share of the heaviest one's mass could as well have been named."""


def quantities(result: LogResult) -> dict[str, Quantity]:
    """The figures of a log that has results."""
    skipped = sum(result.skipped.values())
    detections = float(result.used + skipped)
    entropies = [finite(entry.get("entropy")) for entry in result.objects]
    count = len(entropies)
    nothing = sum(_most_probable(entry) == BACKGROUND for entry in result.objects)
    tied = sum("tie" in entry for entry in result.objects)
    return {
        "skipped": Quantity(skipped, detections),
        "used": Quantity(result.used, detections),
        "objects": Quantity(count),
        "entropy": Quantity(max(entropies, default=None)),
        "mean_entropy": Quantity(sum(entropies) / count if count else None),
        "background": Quantity(nothing, count),
        "ties": Quantity(tied, count),
        "damage": Quantity(len(result.damage)),
        "seconds": Quantity(result.seconds),
    }


def judged(result: LogResult, rules: Sequence[Rule]) -> LogResult:
    """The result with what is wrong by the rules; a log that failed is not judged further."""
    if not result.has_results:
        return result
    return replace(result, misses=tuple(misses(rules, quantities(result))))


@dataclass(frozen=True)
class Tolerances:
    """How much may change before it counts.

    Attributes:
        orientation_deg: Angle that an object may turn.
        entropy: Nats by which an object's class may become less certain.
    """

    orientation_deg: float = 5.0
    entropy: float = 0.05


@dataclass(frozen=True)
class Change:
    """A difference from the baseline.

    Attributes:
        name: Of the log.
        sentence: What changed.
        regression: Whether it is for the worse, or might be.
    """

    name: str
    sentence: str
    regression: bool


def compare(
    results: Iterable[LogResult], baseline: Iterable[LogResult], tolerances: Tolerances
) -> list[Change]:
    """What changed since the baseline, log by log.

    Logs are matched by name. A log that failed now but not then, an object that is gone, of
    another class, turned, or less certain than before is a regression.

    Args:
        results: Of this batch.
        baseline: Of the other.
        tolerances: How much may change.
    """
    now = {result.name: result for result in results}
    before = {result.name: result for result in baseline if result.has_results}
    changes = []
    for name in sorted(now.keys() | before.keys()):
        if name not in before:
            if now[name].has_results:
                changes.append(Change(name, "not in the baseline", regression=False))
        elif name not in now:
            changes.append(Change(name, "in the baseline, not in this batch", regression=False))
        elif not now[name].has_results:
            changes.append(Change(name, "failed, though not in the baseline", regression=True))
        else:
            found = _log_changes(now[name], before[name], tolerances)
            changes += [Change(name, sentence, regression) for sentence, regression in found]
    return changes


def with_regressions(
    results: Iterable[LogResult], changes: Iterable[Change]
) -> Iterator[LogResult]:
    """The results that got worse, with the regressions among their misses."""
    worse: dict[str, list[str]] = {}
    for change in changes:
        if change.regression:
            worse.setdefault(change.name, []).append(f"since the baseline: {change.sentence}")
    for result in results:
        if result.has_results and result.name in worse:
            yield replace(result, misses=(*result.misses, *worse[result.name]))


def _log_changes(
    result: LogResult, baseline: LogResult, tolerances: Tolerances
) -> list[tuple[str, bool]]:
    now = {str(entry.get("id")): entry for entry in result.objects}
    before = {str(entry.get("id")): entry for entry in baseline.objects}
    changes: list[tuple[str, bool]] = []
    for key in sorted(now.keys() | before.keys()):
        if key not in before:
            changes.append((f"object {key!r} is new", False))
        elif key not in now:
            changes.append((f"object {key!r} is missing", True))
        else:
            changes += _object_changes(key, now[key], before[key], tolerances)
    return changes


def _object_changes(
    key: str, now: Mapping[str, Any], before: Mapping[str, Any], tolerances: Tolerances
) -> list[tuple[str, bool]]:
    changes = []
    if now["class"] != before["class"]:
        tied = now["class"] in before.get("tie", ()) or before["class"] in now.get("tie", ())
        sentence = f"object {key!r} is {now['class']}, was {before['class']}"
        changes.append((sentence + (" (a tie)" if tied else ""), not tied))
    else:
        turned = _turned_by(now, before)
        if turned > tolerances.orientation_deg:
            changes.append(
                (
                    f"object {key!r} turned by {turned:.1f} deg, to "
                    f"{finite(now['orientation_deg']):.1f} deg",
                    True,
                )
            )
    rise = finite(now.get("entropy")) - finite(before.get("entropy"))
    if rise > tolerances.entropy:
        sentence = f"object {key!r} is less certain: entropy {finite(now['entropy']):.3f}, "
        changes.append((sentence + f"was {finite(before['entropy']):.3f}", True))
    return changes


def _turned_by(now: Mapping[str, Any], before: Mapping[str, Any]) -> float:
    """Degrees from the orientation named now to the nearest one that could be named before."""
    modes = before.get("modes", ())
    heaviest = max((finite(mode["mass"]) for mode in modes), default=0.0)
    candidates = [finite(before["orientation_deg"])] + [
        finite(mode["orientation_deg"])
        for mode in modes
        if finite(mode["mass"]) >= _CO_LEADING * heaviest
    ]
    named = finite(now["orientation_deg"])
    return min(abs((named - angle + 180.0) % 360.0 - 180.0) for angle in candidates)


def _most_probable(entry: Mapping[str, Any]) -> str:
    probabilities: Mapping[str, float] = entry.get("class_probabilities", {})
    return max(probabilities, key=lambda name: finite(probabilities[name]), default="")
