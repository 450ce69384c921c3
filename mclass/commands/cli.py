"""The ``mclass`` program: finds commands, catches errors once, decides exit codes."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from importlib import import_module
from typing import Any

import click

from mclass import __version__
from mclass.errors import MclassError

_COMMANDS: Mapping[str, str] = {
    "estimate": "mclass.commands.estimate:estimate",
    "init": "mclass.commands.init:init",
    "check": "mclass.commands.check:check",
    "inspect": "mclass.commands.inspect:inspect",
    "simulate": "mclass.commands.simulate:simulate",
    "batch": "mclass.commands.batch:batch",
}
_DEBUG = "MCLASS_DEBUG"


class MclassGroup(click.Group):
    """Loads a command's module when it is named, and turns errors into sentences."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Names in the order of a first session."""
        return list(_COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import one command."""
        if cmd_name not in _COMMANDS:
            return None
        module, name = _COMMANDS[cmd_name].split(":")
        command: click.Command = getattr(import_module(module), name)
        return command

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command; every error ends as one message and its exit code."""
        # Small matrix products are slower on several threads; set before numpy is loaded.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        try:
            return super().invoke(ctx)
        except (click.ClickException, click.exceptions.Exit, click.Abort):
            raise
        except KeyboardInterrupt:
            _fail("interrupted; nothing was written", 130)
        except BrokenPipeError:
            # The reader of our output has gone: nobody is left to tell.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            sys.exit(1)
        except MclassError as error:
            _fail(str(error), error.exit_code)
        except MemoryError:
            _fail("not enough memory; use a coarser grid or fewer orientation bins", 1)
        except Exception as error:
            if os.environ.get(_DEBUG):
                raise
            kind = type(error).__name__
            _fail(f"unexpected {kind}: {error}. This is a bug; {_DEBUG}=1 shows where", 1)


def _fail(message: str, code: int) -> None:
    click.echo(f"Error: {message}", err=True)
    sys.exit(code)


@click.group(
    cls=MclassGroup,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.version_option(__version__, prog_name="mclass")
def main() -> None:
    """Object class, orientation and position from class labels in MCAP logs.

    \b
    Examples:
      mclass init drive.mcap                   write a model file for a log
      mclass estimate drive.mcap               estimate, write drive.mclass.mcap
      mclass inspect objects drive.mclass.mcap
    """
