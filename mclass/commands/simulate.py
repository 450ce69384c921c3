"""``mclass simulate``: a log of a drive past known objects."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from mclass.commands.completion import FileType
from mclass.commands.console import console
from mclass.commands.options import overwrite_option

if TYPE_CHECKING:
    from mclass.simulation.write import Encoding


@click.command(short_help="Make a log from a scenario, with the truth attached.")
@click.argument("scenario", type=FileType(".yaml", ".yml", exists=True, dir_okay=False))
@click.option(
    "-o",
    "--output",
    type=FileType(".mcap"),
    metavar="LOG.mcap",
    help="Log to write; without it SCENARIO.mcap in the working directory.",
)
@click.option(
    "--encoding",
    type=click.Choice(["ros2", "protobuf", "json"]),
    default="ros2",
    show_default=True,
    help="Of all messages: ROS 2 (cdr), Foxglove protobuf or Foxglove JSON. "
    "The numbers are the same in each.",
)
@click.option(
    "--seed",
    type=click.IntRange(0, 2**31),
    metavar="N",
    help="For all that is drawn, instead of the scenario's own seed.",
)
@click.option(
    "--truth",
    "truth_path",
    type=FileType(".json"),
    metavar="FILE.json",
    help="Also write the truth (class, position and orientation of every object) to FILE.json; "
    "the log has it as the attachment truth.json.",
)
@overwrite_option
def simulate(
    *,
    scenario: Path,
    output: Path | None,
    encoding: Encoding,
    seed: int | None,
    truth_path: Path | None,
    overwrite: bool,
) -> None:
    """Drive a simulated robot past the objects of SCENARIO and write its log.

    The scenario says what stands where, how the robot drives, how odometry errs and what the
    detector returns. The same scenario and seed give the same log. A model file that the
    scenario names is attached, so that `mclass estimate` finds it.

    \b
    Examples:
      mclass simulate configs/scenarios/office.yaml -o office.mcap
      mclass simulate office.yaml -o office.mcap --seed 7 --truth truth.json
      mclass simulate office.yaml -o office_json.mcap --encoding json
    """
    from mclass.simulation.scenario_file import load_scenario
    from mclass.simulation.world import simulate as play
    from mclass.simulation.write import write_log, write_truth_and_log
    from mclass.text.terminal import Terminal

    log = output if output is not None else Path(scenario.stem + ".mcap")
    if truth_path is not None and truth_path.resolve() == log.resolve():
        raise click.UsageError("--truth and --output name the same file; give it another name")
    with console() as tell:
        tell.progress("driving", 0, 0, "")
        drive = play(load_scenario(scenario), seed)
        if truth_path is None:
            write_log(drive, log, encoding, overwrite=overwrite, progress=tell.progress)
        else:
            write_truth_and_log(
                drive, truth_path, log, encoding, overwrite=overwrite, progress=tell.progress
            )
    frames, detections = len(drive.frames), len(drive.detections)
    shown = Terminal.of(sys.stdout).clean(str(log), 1000)
    click.echo(
        f"{shown}: {len(drive.truth.object_ids)} objects, {frames} camera frames, "
        f"{detections} detections, {encoding}"
    )
