"""The ``mclass`` program: finds commands, catches errors once, decides exit codes."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Iterator, Mapping
from importlib import import_module
from types import FrameType
from typing import Any

import click

from mclass import __version__
from mclass.commands.console import add_verbosity
from mclass.commands.manual import GROUPS, add_manual, write_commands
from mclass.errors import MclassError

_COMMANDS: Mapping[str, str] = {
    "estimate": "mclass.commands.estimate:estimate",
    "init": "mclass.commands.init:init",
    "check": "mclass.commands.check:check",
    "inspect": "mclass.commands.inspect:inspect",
    "simulate": "mclass.commands.simulate:simulate",
    "batch": "mclass.commands.batch:batch",
    "report": "mclass.commands.report:report",
    "view": "mclass.commands.view:view",
    "fuse": "mclass.commands.fuse:fuse",
    "evaluate": "mclass.commands.evaluate:evaluate",
}
_DEBUG = "MCLASS_DEBUG"


class MclassGroup(click.Group):
    """Loads a command's module when it is named, and turns errors into sentences."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Names in the order of their use."""
        return [name for members in GROUPS.values() for name in members]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import one command."""
        if cmd_name not in _COMMANDS:
            return None
        module, name = _COMMANDS[cmd_name].split(":")
        command: click.Command = getattr(import_module(module), name)
        return add_manual(add_verbosity(command), cmd_name)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the commands under what they are for."""
        write_commands(self, ctx, formatter)

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command; every error ends as one message and its exit code."""
        # Small matrix products are slower on several threads; set before numpy is loaded.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        try:
            with _told_to_stop():
                return super().invoke(ctx)
        except (click.ClickException, click.exceptions.Exit, click.Abort):
            raise
        except KeyboardInterrupt:
            _fail("interrupted; no half-written file is left", 130)
        except StoppedError as stop:
            _fail(f"stopped by {stop.signal.name}; no half-written file is left", stop.exit_code)
        except BrokenPipeError:
            # The reader of our output has gone: nobody is left to tell.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            sys.exit(1)
        except MclassError as error:
            _fail(str(error), error.exit_code)
        except MemoryError:
            _fail("not enough memory; use a coarser grid or fewer orientation bins", 1)
        except OSError as error:
            where = f"{error.filename}: " if error.filename else ""
            _fail(f"{where}{(error.strerror or str(error)).lower()}", 1)
        except Exception as error:
            if os.environ.get(_DEBUG):
                raise
            kind = type(error).__name__
            _fail(f"unexpected {kind}: {error}. This is a bug; {_DEBUG}=1 shows where", 1)


class StoppedError(BaseException):
    """The process was told to stop by a signal; not an `Exception`, so that all cleans up."""

    def __init__(self, number: int) -> None:
        self.signal = signal.Signals(number)
        self.exit_code = 128 + number
        super().__init__(self.signal.name)


@contextlib.contextmanager
def _told_to_stop() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end the command in order, as an interrupt does."""

    def stop(number: int, _: FrameType | None) -> None:
        # Asked once is enough: a second signal must not disturb the cleaning up.
        signal.signal(number, signal.SIG_IGN)
        raise StoppedError(number)

    names = ("SIGTERM", "SIGHUP") if threading.current_thread() is threading.main_thread() else ()
    numbers = [getattr(signal, name) for name in names if hasattr(signal, name)]
    # What is ignored (nohup) or handled already stays so.
    changed = [number for number in numbers if signal.getsignal(number) is signal.SIG_DFL]
    try:
        for number in changed:
            signal.signal(number, stop)
        yield
    finally:
        for number in changed:
            signal.signal(number, signal.SIG_DFL)


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

    `mclass COMMAND --help` explains each command, with examples and exit codes.

    \b
    Examples:
      mclass init drive.mcap                   write a model file for a log
      mclass estimate drive.mcap               estimate, write drive.mclass.mcap
      mclass inspect objects drive.mclass.mcap
    """
