"""An output of `estimate` to scores."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from mclass.errors import LogError
from mclass.evaluation.density import joint_density
from mclass.evaluation.scores import LogScore, score_log
from mclass.evaluation.truth import Truth, parse_truth
from mclass.outputs.readback import OutputLog
from mclass.places import Place
from mclass.simulation.write import TRUTH_NAME


@dataclass(frozen=True)
class ScoredOutput:
    """An output's score, and sentences on what of the file could not be read."""

    score: LogScore
    damage: tuple[str, ...]


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
