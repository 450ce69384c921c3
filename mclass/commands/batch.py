"""``mclass batch``."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import click

from mclass.commands.completion import FileType, figures
from mclass.commands.console import console
from mclass.commands.options import FILE, LOG, PlaceType, echo_json, format_option, time_options

if TYPE_CHECKING:
    from mclass.batch.record import LogResult
    from mclass.places import Place


def _figures() -> Iterable[str]:
    from mclass.batch.judgement import METRICS

    return METRICS


@click.command(short_help="Estimate many logs at once, for CI and fleets.")
@click.argument(
    "sources",
    nargs=-1,
    required=True,
    shell_complete=LOG.shell_complete,
    metavar="LOG_OR_FOLDER_OR_GLOB...",
)
@click.option(
    "-c",
    "--model",
    "model_path",
    type=FILE,
    metavar="MODEL.yaml",
    help="Model file for all logs. Without it each log's own is found, as `estimate` does.",
)
@click.option(
    "-o",
    "--output",
    "folder",
    type=PlaceType(file_okay=False),
    metavar="DIR",
    required=True,
    help="Folder or URL for the outputs and results.json.",
)
@click.option(
    "-j", "--jobs", type=click.IntRange(min=1), metavar="N", help="Logs at once.  [default: cores]"
)
@click.option(
    "--dask",
    "dask_address",
    metavar="ADDRESS",
    help="Work on the Dask cluster with this scheduler; needs the extra mclass[dask].",
)
@time_options
@click.option(
    "--every",
    "every_s",
    type=click.FloatRange(min=0, min_open=True),
    metavar="SECONDS",
    help="Write maps and the full belief every SECONDS too, not only at the end.",
)
@click.option(
    "--prefix",
    default="/mclass",
    show_default=True,
    metavar="TOPIC",
    help="Prefix of the new topics.",
)
@click.option(
    "--fail-on",
    "rule_texts",
    multiple=True,
    metavar="RULE",
    shell_complete=figures(_figures),
    help="Exit 4 if a log's figures fulfil RULE, such as 'skipped > 5 %'. Can be given often.",
)
@click.option(
    "--baseline",
    "baseline_path",
    type=PlaceType(".json"),
    metavar="RESULTS.json",
    help="results.json of another batch: say what changed, exit 4 if it is for the worse.",
)
@click.option(
    "--orientation-tolerance",
    "orientation_deg",
    type=click.FloatRange(min=0),
    default=5.0,
    show_default=True,
    metavar="DEG",
    help="Angle by which objects may turn against the baseline.",
)
@click.option(
    "--entropy-tolerance",
    "entropy",
    type=click.FloatRange(min=0),
    default=0.05,
    show_default=True,
    metavar="NATS",
    help="Rise of an object's class entropy that is allowed against the baseline.",
)
@click.option(
    "--junit",
    "junit_path",
    type=FileType(".xml", dir_okay=False),
    metavar="FILE.xml",
    help="Also write the outcome of each log as a JUnit test.",
)
@click.option("--redo", is_flag=True, help="Do logs again that are done and have not changed.")
@click.option(
    "--overwrite", is_flag=True, help="Replace files in DIR that are not from this batch."
)
@format_option
@click.pass_context
def batch(
    ctx: click.Context,
    *,
    sources: tuple[str, ...],
    model_path: Path | None,
    folder: Place,
    jobs: int | None,
    dask_address: str | None,
    start: str | None,
    end: str | None,
    every_s: float | None,
    prefix: str,
    rule_texts: tuple[str, ...],
    baseline_path: Place | None,
    orientation_deg: float,
    entropy: float,
    junit_path: Path | None,
    redo: bool,
    overwrite: bool,
    output_format: str,
) -> None:
    """Estimate every log, on all cores; one that fails does not stop the others.

    Outputs go to DIR, the outcome, counts, objects and time of each log to DIR/results.json.
    Started again, it skips logs that are done with the same content, model, options and
    version; so an interrupted batch goes on where it stopped. The exit code is the worst of
    all logs': 1 failed, then 2 no usable model, 4 a threshold missed, 3 damaged, 0 all well.

    Figures for --fail-on: skipped and used (detections; with % of all), objects, entropy and
    mean_entropy (of the objects' classes, in nats), background (objects most probably
    nothing), ties (both with % of all objects), damage (kinds found), seconds.

    \b
    Examples:
      mclass batch logs/ -c boxes.yaml -o results
      mclass batch 'fleet/**/*.mcap' -o results -j 2 --junit results.xml
      mclass batch logs/ -o out --fail-on 'skipped > 5 %' --fail-on 'objects < 3'
      mclass batch logs/ -o new --baseline old/results.json
      mclass batch s3://bucket/logs/ -o s3://bucket/results
    """
    from mclass.batch.judgement import METRICS, Tolerances
    from mclass.batch.record import read_results, write_whole
    from mclass.batch.report import batch_json, batch_text, junit_cases
    from mclass.batch.run import Criteria, run_batch
    from mclass.batch.work import Estimation
    from mclass.config.model_file import load_model
    from mclass.rules import parse_rule
    from mclass.text.junit import junit_xml
    from mclass.text.terminal import Terminal

    executor = None
    if dask_address is not None:
        from mclass.batch.cluster import on_cluster

        if jobs is not None:
            raise click.UsageError("--jobs is for this machine; the cluster has its own number")
        executor = on_cluster(dask_address)
    criteria = Criteria(
        rules=[parse_rule(text, METRICS) for text in rule_texts],
        baseline=None if baseline_path is None else read_results(baseline_path),
        tolerances=Tolerances(orientation_deg, entropy),
    )
    model = None if model_path is None else load_model(model_path)
    work = Estimation(model, start, end, every_s, prefix, anew=redo)
    progress = _Progress()
    # CI servers cancel with SIGTERM: as with Ctrl-C, what is half done is cleaned up.
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        report = run_batch(
            sources,
            folder,
            work,
            processes=jobs,
            executor=executor,
            criteria=criteria,
            overwrite=overwrite,
            progress=progress,
        )
    except KeyboardInterrupt:
        progress.clear()
        message = f"interrupted; {progress.done} of {progress.total} logs are done and recorded."
        click.echo(f"Error: {message} The same command goes on from there.", err=True)
        ctx.exit(130)
    finally:
        signal.signal(signal.SIGTERM, before)
        progress.clear()
    if junit_path is not None:
        write_whole(junit_path, junit_xml("mclass batch", junit_cases(report.results)))
    if output_format == "json":
        echo_json(batch_json(report.results, report.changes, report.seconds, report.exit_code))
    else:
        terminal = Terminal.of(sys.stdout)
        click.echo(batch_text(report.results, report.changes, report.seconds, terminal))
    ctx.exit(report.exit_code)


class _Progress:
    """One line on stderr that says how far the batch is, on terminals only."""

    def __init__(self) -> None:
        import time

        self.done = self.total = self._failed = 0
        self._now = time.monotonic
        self._began = self._now()
        self._console = console()

    def __call__(self, done: int, total: int, result: LogResult | None) -> None:
        self.done, self.total = done, total
        self._failed += result is not None and result.status == "failed"
        text = f"{done} of {total} logs"
        if self._failed:
            text += f", {self._failed} failed"
        if done:
            left = (self._now() - self._began) / done * (total - done)
            text += f", {left:.0f} s left"
        self._console.line(text)

    def clear(self) -> None:
        """Remove the line."""
        self._console.clear()
