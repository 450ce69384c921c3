"""Outputs of `estimate` to scores."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from mclass.errors import LogError, UsageError
from mclass.evaluation.density import joint_density
from mclass.evaluation.scores import LogScore, score_log
from mclass.evaluation.summary import Evaluation
from mclass.evaluation.summary import evaluate as evaluate_scores
from mclass.evaluation.truth import Truth, load_truth, parse_truth
from mclass.outputs.readback import OutputLog
from mclass.places import Place, PlaceLike, place_of
from mclass.progress import Progress, unheard
from mclass.simulation.write import TRUTH_NAME


@dataclass(frozen=True)
class ScoredOutput:
    """An output's score, and sentences on what of the file could not be read."""

    score: LogScore
    damage: tuple[str, ...]


def evaluate(
    outputs: Sequence[PlaceLike],
    truth: Truth | str | os.PathLike[str] | None = None,
    *,
    match: Literal["position", "id"] = "position",
    gate: float = 1.0,
    progress: Progress = unheard,
) -> Evaluation:
    """Score the objects in outputs against what really stood there.

    Args:
        outputs: At least one, by path or URL.
        truth: Of all outputs: what `load_truth` gives, or the file; None for the one that each
            carries, if its log was simulated.
        match: Which estimate is of which object: the nearest, or the one of the same id.
        gate: Farthest that a match by position may be off [m].
        progress: Told how far the work is.

    Raises:
        UsageError: If there are no outputs.
        LogError: If an output holds no results, or no truth where none was given.
        ConfigError: If the truth is wrong.
    """
    if not outputs:
        raise UsageError("nothing to evaluate: name at least one output")
    if truth is not None and not isinstance(truth, Truth):
        truth = load_truth(Path(truth))
    places = [place_of(output) for output in outputs]
    scored = []
    for count, place in enumerate(places):
        progress("scoring", count, len(places), "outputs")
        scored.append(score_output(place, truth, match=match, gate=gate))
    progress("scoring", len(places), len(places), "outputs")
    damage = [
        f"{place}: {sentence}"
        for place, one in zip(places, scored, strict=True)
        for sentence in one.damage
    ]
    return replace(evaluate_scores([one.score for one in scored]), damage=tuple(damage))


def score_output(
    path: Place,
    truth: Truth | None,
    *,
    match: Literal["position", "id"] = "position",
    gate: float = 1.0,
) -> ScoredOutput:
    """Score the objects in one output.

    Args:
        path: Of the output.
        truth: None for the one that a simulated log carries.
        match: See `score_log`.
        gate: See `score_log` [m].

    Raises:
        LogError: If the file holds no results, or no truth where none was given.
        ConfigError: If the truth in the file is wrong.
    """
    with OutputLog.open(path) as output:
        if truth is None:
            data = output.reader.attachment(TRUTH_NAME)
            if data is None:
                problem = f"no attachment {TRUTH_NAME!r}; name a truth file with --truth"
                raise LogError(problem, path=str(path))
            truth = parse_truth(data, f"{path}: {TRUTH_NAME}")
        estimates = output.objects()
        densities = {
            estimate.object_id: joint_density(output.belief(estimate.object_id))
            for estimate in estimates
        }
        score = score_log(
            path.name, estimates, densities, output.class_names, truth, match=match, gate=gate
        )
        return ScoredOutput(score, tuple(output.reader.damage.sentences))
