"""What a command tells besides its results: warnings, progress, details; all on stderr.

``-q`` leaves only errors, ``-v`` adds how long each stage took and what was chosen. Progress
is one line that is written over, on terminals alone; it shows once the work has taken a while.
"""

from __future__ import annotations

import os
import shutil
import sys
import time
from types import TracebackType

import click

_KEY = "mclass.console"
_PATIENCE_S = 0.5
_REFRESH_S = 0.1
_SETTLED_S = 1.0
"""Before that a rate says more about starting than about the work."""

_LONGEST_BAR, _SHORTEST_BAR, _BESIDE_BAR = 20, 4, 62
_PREFIXES = ((10**9, "G"), (10**6, "M"), (10**3, "k"))


class Console:
    """Tells people at a terminal what goes on; a context manager that ends its progress line."""

    def __init__(self) -> None:
        self.quiet = self.verbose = False
        self._began = self._drawn = self._stage_began = 0.0
        self._stage, self._unit = "", ""
        self._first = self._done = 0
        self._on_screen = False

    def __enter__(self) -> Console:
        self._began = time.monotonic()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self._end_stage()
        self.clear()

    @property
    def shows_progress(self) -> bool:
        """Whether somebody watches."""
        return not self.quiet and sys.stderr.isatty() and os.environ.get("TERM") != "dumb"

    def warn(self, sentence: str) -> None:
        """Tell what may be wrong, unless quiet."""
        if not self.quiet:
            self._say(f"Warning: {sentence}")

    def detail(self, sentence: str) -> None:
        """Tell what only those want to know who asked for it."""
        if self.verbose:
            self._say(sentence)

    def progress(self, stage: str, done: int, total: int, unit: str) -> None:
        """See `mclass.progress.Progress`."""
        now = time.monotonic()
        if stage != self._stage:
            self._end_stage()
            self._stage, self._unit, self._stage_began = stage, unit, now
            self._first = done
        elif done < self._done:
            # Another pass: its own rate counts.
            self._first = done
        self._done = done
        if not self.shows_progress or now - self._began < _PATIENCE_S:
            return
        if now - self._drawn < _REFRESH_S and done != total:
            return
        self._drawn = now
        settled = now - self._stage_began > _SETTLED_S
        rate = self._rate(now) if settled else 0.0
        bar = min(max(_columns() - _BESIDE_BAR, _SHORTEST_BAR), _LONGEST_BAR)
        self.line(_progress_text(stage, done, total, rate, unit, bar))

    def line(self, text: str) -> None:
        """Show a line in place of the last one that was shown so."""
        if self.shows_progress:
            self._on_screen = True
            click.echo(f"\r\x1b[K{text[: _columns() - 1]}", err=True, nl=False)

    def clear(self) -> None:
        """Take that line away."""
        if self._on_screen:
            self._on_screen = False
            click.echo("\r\x1b[K", err=True, nl=False)

    def _say(self, sentence: str) -> None:
        self.clear()
        click.echo(sentence, err=True)

    def _rate(self, now: float) -> float:
        """Units a second in this stage, 0 while unknown."""
        elapsed = now - self._stage_began
        return (self._done - self._first) / elapsed if elapsed > 0.0 else 0.0

    def _end_stage(self) -> None:
        if self._stage:
            now = time.monotonic()
            amount = f", {_amount(self._done, self._unit)}" if self._done else ""
            self.detail(f"{self._stage}: {now - self._stage_began:.2f} s{amount}")
        self._stage, self._done = "", 0


def console() -> Console:
    """The console of the command that runs."""
    context = click.get_current_context(silent=True)
    if context is None:
        return Console()
    found: Console = context.find_root().meta.setdefault(_KEY, Console())
    return found


def add_verbosity(command: click.Command) -> click.Command:
    """Give a command, and those in it, the options ``-q`` and ``-v``."""
    if isinstance(command, click.Group):
        for child in command.commands.values():
            add_verbosity(child)
    elif all(parameter.name != "quiet" for parameter in command.params):
        command.params += [
            click.Option(
                ["-q", "--quiet"],
                is_flag=True,
                expose_value=False,
                callback=_set_quiet,
                help="No notes, warnings or progress; errors are still told.",
            ),
            click.Option(
                ["-v", "--verbose"],
                is_flag=True,
                expose_value=False,
                callback=_set_verbose,
                help="Also tell what was chosen and how long each stage took, on stderr.",
            ),
        ]
    return command


def _set_quiet(context: click.Context, _: click.Parameter, value: bool) -> None:
    if value:
        console().quiet = True
        _refuse_both()


def _set_verbose(context: click.Context, _: click.Parameter, value: bool) -> None:
    if value:
        console().verbose = True
        _refuse_both()


def _refuse_both() -> None:
    if console().quiet and console().verbose:
        raise click.UsageError("-q asks for less and -v for more: choose one")


def _columns() -> int:
    """Width of the terminal."""
    return max(shutil.get_terminal_size((80, 24)).columns, 20)


def _progress_text(stage: str, done: int, total: int, rate: float, unit: str, bar: int) -> str:
    """``reading  ########------------  41 %  12.3 MB/s  3 s left``."""
    parts = [stage]
    if total > 0:
        share = min(done / total, 1.0)
        filled = round(share * bar)
        parts += ["#" * filled + "-" * (bar - filled), f"{share:4.0%}".replace("%", " %")]
    elif done:
        parts.append(_amount(done, unit))
    if rate > 0.0:
        parts.append(f"{_amount(rate, unit)}/s")
        if total > 0:
            parts.append(f"{_duration((total - done) / rate)} left")
    return "  ".join(parts)


def _amount(number: float, unit: str) -> str:
    """``12.3 MB``, ``1,234 tiles``, ``0.5 logs``."""
    if unit == "bytes":
        for size, prefix in _PREFIXES:
            if number >= size:
                return f"{number / size:.1f} {prefix}B"
        return f"{number:.0f} B"
    return (
        f"{number:,.0f} {unit}" if number >= 10 or number == int(number) else f"{number:.1f} {unit}"
    )


def _duration(seconds: float) -> str:
    """``5 s``, ``3 min 20 s``, ``2 h 5 min``."""
    whole = max(round(seconds), 0)
    if whole < 100:
        return f"{whole} s"
    minutes, rest = divmod(whole, 60)
    if minutes < 100:
        return f"{minutes} min {rest} s"
    return f"{minutes // 60} h {minutes % 60} min"
