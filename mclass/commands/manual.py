"""What every command's help says besides its own description: exit codes, related commands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import click

_WHOLE = 200

GROUPS: Mapping[str, Sequence[str]] = {
    "From a log to its objects": ("init", "check", "estimate", "inspect"),
    "Results": ("report", "view", "evaluate", "fuse"),
    "Many logs, made-up logs": ("batch", "simulate"),
}
"""Commands by what they are for, each in the order of their use."""

_EXITS = {
    0: "done",
    1: "failed; nothing is left under the output's name",
    2: "wrong usage, or a wrong or missing model file",
    3: "done, but what was read is damaged; what was lost is said",
    4: "done, but a threshold that you set was missed",
    130: "interrupted; nothing is left under the output's name",
}
_READS_LOGS, _READS_MODELS = (0, 1, 2, 3, 130), (0, 1, 2, 130)
_MANUALS: Mapping[str, tuple[Sequence[int], str]] = {
    "estimate": (_READS_LOGS, "init, inspect, report, view, evaluate, batch"),
    "init": (_READS_MODELS, "check, inspect log, estimate"),
    "check": (_READS_MODELS, "inspect model, init"),
    "inspect log": (_READS_LOGS, "init, estimate"),
    "inspect objects": (_READS_LOGS, "inspect cell, report, view"),
    "inspect cell": (_READS_LOGS, "inspect objects, inspect model"),
    "inspect model": (_READS_MODELS, "check, init"),
    "simulate": (_READS_MODELS, "estimate, evaluate"),
    "batch": ((*_READS_LOGS[:4], 4, 130), "estimate, evaluate"),
    "fuse": (_READS_LOGS, "estimate, inspect, report"),
    "evaluate": ((*_READS_LOGS[:4], 4, 130), "simulate, batch"),
    "report": (_READS_LOGS, "view, inspect objects"),
    "view": (_READS_LOGS, "report, inspect objects"),
}


class OrderedGroup(click.Group):
    """Lists its commands in the order in which they were made, not by their letters."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """See `click.Group.list_commands`."""
        return list(self.commands)


def add_manual(command: click.Command, name: str) -> click.Command:
    """Give a command, and those in it, the end of their help."""
    if isinstance(command, click.Group):
        for child_name, child in command.commands.items():
            add_manual(child, f"{name} {child_name}")
    elif name in _MANUALS and command.epilog is None:
        codes, related = _MANUALS[name]
        lines = [f"  {code:<4} {_EXITS[code]}" for code in codes]
        others = ", ".join(f"mclass {other}" for other in related.split(", "))
        command.epilog = "\n".join(["\b", "Exit codes:", *lines, "", f"See also: {others}"])
    return command


def write_commands(group: click.Group, ctx: click.Context, formatter: click.HelpFormatter) -> None:
    """List the commands of the program under what they are for."""
    names = group.list_commands(ctx)
    for title, members in GROUPS.items():
        with formatter.section(title):
            formatter.write_dl(
                [
                    (name, command.get_short_help_str(_WHOLE))
                    for name in members
                    if name in names and (command := group.get_command(ctx, name)) is not None
                ]
            )
