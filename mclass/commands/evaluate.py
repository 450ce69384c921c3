"""``mclass evaluate``."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import click

from mclass.commands.completion import FileType, figures
from mclass.commands.console import console
from mclass.commands.options import LOG, echo_json, format_option, plot_option

if TYPE_CHECKING:
    from typing import Literal

    from mclass.places import Place


def _figures() -> Iterable[str]:
    from mclass.evaluation.summary import METRICS

    return METRICS


@click.command(short_help="Compare results with the truth.")
@click.argument("outs", nargs=-1, required=True, type=LOG, metavar="OUT...")
@click.option(
    "--truth",
    "truth_path",
    type=FileType(".json", ".yaml", ".yml"),
    metavar="TRUTH.json|.yaml",
    help="What really stood where, in all of OUT. Without it the truth that each carries, if "
    "its log was simulated.",
)
@click.option(
    "--match",
    type=click.Choice(["position", "id"]),
    default="position",
    show_default=True,
    help="Which estimate is of which object: the nearest, or the one of the same id.",
)
@click.option(
    "--gate",
    type=click.FloatRange(min=0, min_open=True),
    default=1.0,
    show_default=True,
    metavar="METRES",
    help="Farthest that a match by position may be off.",
)
@click.option(
    "--fail-on",
    "rule_texts",
    multiple=True,
    metavar="RULE",
    shell_complete=figures(_figures),
    help="Exit 4 if a figure fulfils RULE, such as 'class_accuracy < 90 %'. Can be given often.",
)
@click.option(
    "--junit",
    "junit_path",
    type=FileType(".xml", dir_okay=False),
    metavar="FILE.xml",
    help="Also write each RULE's outcome as a JUnit test.",
)
@format_option
@plot_option
@click.pass_context
def evaluate(
    ctx: click.Context,
    *,
    outs: tuple[Place, ...],
    truth_path: Path | None,
    match: Literal["position", "id"],
    gate: float,
    rule_texts: tuple[str, ...],
    junit_path: Path | None,
    output_format: str,
    plot_path: Path | None,
) -> None:
    """Score the objects in the outputs OUT against what really stood there.

    Told are errors of class, orientation and position, and whether the stated probabilities
    can be trusted: log loss, calibration, and how often highest-density regions of the
    orientation hold the true one. Intervals are 95 % bootstrap intervals over logs.

    A truth file is JSON or YAML: `objects`, a list of `{id, class, x, y, phi}` in metres and
    degrees (or in the `units` it gives), and `symmetry`, for a class the number of its
    orientations that look alike. `mclass simulate --truth` writes one.

    \b
    Figures for --fail-on: class_accuracy, orientation_error_deg,
    orientation_error_90_deg, symmetric_error_deg, symmetric_error_90_deg,
    mode_error_deg, position_error, log_loss, brier, calibration_error,
    coverage_50, coverage_90, coverage_99, matched, missed, invented.

    \b
    Examples:
      mclass evaluate drive.mclass.mcap --truth truth.yaml
      mclass evaluate results/*.mclass.mcap --fail-on 'coverage_90 < 85 %'
      mclass evaluate drive.mclass.mcap --fail-on 'missed > 0' --junit out.xml
      mclass evaluate results/*.mclass.mcap --plot calibration.png
    """
    from mclass.batch.record import write_whole
    from mclass.evaluation.outputs import evaluate as evaluate_outputs
    from mclass.evaluation.summary import METRICS, quantities
    from mclass.rules import parse_rule
    from mclass.text.evaluations import evaluation_json, evaluation_text, junit_cases
    from mclass.text.junit import junit_xml
    from mclass.text.terminal import Terminal

    rules = [parse_rule(text, METRICS) for text in rule_texts]
    with console() as tell:
        evaluation = evaluate_outputs(
            outs, truth_path, match=match, gate=gate, progress=tell.progress
        )
    values = quantities(evaluation)
    outcomes = [(str(rule), rule.miss(values[rule.metric])) for rule in rules]
    failures = [miss for _, miss in outcomes if miss is not None]
    if plot_path is not None:
        from mclass.plot.evaluation import evaluation_figure
        from mclass.plot.style import save_figure

        save_figure(evaluation_figure(evaluation), plot_path)
    if junit_path is not None:
        cases = junit_cases(evaluation, outcomes)
        write_whole(junit_path, junit_xml("mclass evaluate", cases))
    if output_format == "json":
        echo_json(evaluation_json(evaluation, failures))
    else:
        click.echo(evaluation_text(evaluation, failures, Terminal.of(sys.stdout)))
    for sentence in evaluation.damage:
        tell.warn(sentence)
    if failures:
        ctx.exit(4)
    if evaluation.damage:
        ctx.exit(3)
