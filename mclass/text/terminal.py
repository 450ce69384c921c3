"""Text that fits a terminal: escaping, shortening, tables and bars.

Ids and labels come from logs, so nothing of them reaches a terminal unescaped: an id may
hold an escape sequence, a line break or a megabyte.
"""

from __future__ import annotations

import os
import shutil
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TextIO

import numpy as np

from mclass.records import FloatArray

Style = Literal["bold", "dim", "warning"]

_STYLE_CODES: Mapping[Style, str] = {"bold": "1", "dim": "2", "warning": "33"}
_NARROWEST_COLUMN = 8
_BLOCKS = " ▁▂▃▄▅▆▇█"
_ASCII_BLOCKS = " .:-=+*#@"
_ASCII_SIGNS = {"±": "+/-", "…": "...", "°": " deg", "█": "#", "²": "^2"}


@dataclass(frozen=True)
class Terminal:
    """What the reader's terminal can show; the default is a pipe that takes UTF-8."""

    width: int = 80
    unicode: bool = True
    color: bool = False

    @classmethod
    def of(cls, stream: TextIO, environment: Mapping[str, str] | None = None) -> Terminal:
        """What a stream can show.

        Colour only on a terminal, and neither when ``NO_COLOR`` is set to anything nor when
        ``TERM`` is ``dumb``; other streams are 80 columns wide.
        """
        variables = os.environ if environment is None else environment
        is_terminal = stream.isatty()
        encoding = (getattr(stream, "encoding", None) or "ascii").lower().replace("_", "-")
        return cls(
            width=max(shutil.get_terminal_size((80, 24)).columns, 40) if is_terminal else 80,
            unicode=encoding in ("utf-8", "utf8", "utf-8-sig"),
            color=is_terminal and not variables.get("NO_COLOR") and variables.get("TERM") != "dumb",
        )

    def sign(self, character: str) -> str:
        """A typographic character, or its ASCII stand-in."""
        return character if self.unicode else _ASCII_SIGNS[character]

    def paint(self, text: str, style: Style) -> str:
        """Text in a style, where colour is wanted."""
        return f"\x1b[{_STYLE_CODES[style]}m{text}\x1b[0m" if self.color else text

    def clean(self, text: str, limit: int = 200) -> str:
        r"""Foreign text made harmless: no control characters, at most ``limit`` columns.

        Whatever cannot be printed (and, on an ASCII terminal, all beyond ASCII) becomes
        ``\n``, ``\x1b`` or ``\u202e`` as in Python, a backslash doubles, and an empty text
        shows as ``""``. Long text loses its middle.
        """
        if not text:
            return '""'
        # Beyond twice the limit nothing can be shown: do not escape a megabyte for nothing.
        if len(text) > 2 * limit:
            head = "".join(self._escape(character) for character in text[:limit])
            tail = "".join(self._escape(character) for character in text[-limit:])
            return self.shorten(head + self.sign("…") + tail, limit)
        return self.shorten("".join(self._escape(character) for character in text), limit)

    def _escape(self, character: str) -> str:
        """One character as it may be shown."""
        if character == "\\":
            return "\\\\"
        if character.isprintable() and (self.unicode or character.isascii()):
            return character
        return character.encode("unicode_escape").decode("ascii")

    def shorten(self, text: str, limit: int) -> str:
        """Text of at most ``limit`` columns: the middle of a longer one is left out."""
        if display_width(text) <= limit:
            return text
        mark = self.sign("…")
        room = limit - len(mark)
        tail = _take(text[::-1], room // 3)[::-1]
        head = _take(text, room - display_width(tail))
        return head + mark + tail

    def bar(self, fraction: float, columns: int) -> str:
        """A bar that fills a fraction of so many columns."""
        return self.sign("█") * round(min(max(fraction, 0.0), 1.0) * columns)

    def profile(self, values: FloatArray, rows: int) -> list[str]:
        """Bars side by side, one column a value, as text lines from the top down.

        Args:
            values: Not negative, (columns,); the greatest fills all rows.
            rows: Number of lines.
        """
        blocks = _BLOCKS if self.unicode else _ASCII_BLOCKS
        peak = float(values.max(initial=0.0))
        steps = len(blocks) - 1
        filled = np.rint(values / peak * rows * steps) if peak > 0.0 else np.zeros_like(values)
        lines = []
        for row in reversed(range(rows)):
            levels = np.clip(filled - row * steps, 0, steps).astype(int)
            lines.append("".join(blocks[level] for level in levels).rstrip())
        return lines


def display_width(text: str) -> int:
    """Columns that a text takes: wide characters count twice, combining ones not at all."""
    if text.isascii():
        return len(text)
    width = 0
    for character in text:
        if not unicodedata.combining(character):
            width += 2 if unicodedata.east_asian_width(character) in "WF" else 1
    return width


def _take(text: str, columns: int) -> str:
    """The longest beginning that fits."""
    used = 0
    for index, character in enumerate(text):
        used += display_width(character)
        if used > columns:
            return text[:index]
    return text


def table(
    headings: Sequence[str],
    rows: Sequence[Sequence[str]],
    align: str,
    terminal: Terminal,
    elastic: Sequence[int] = (),
) -> list[str]:
    """Lines of an aligned table.

    Args:
        headings: One a column.
        rows: Cells by row; a cell may hold several lines. A row of one cell spans the table.
        align: ``<`` or ``>`` for each column.
        terminal: Gives the width to keep to.
        elastic: Columns that may be shortened to keep to it. Others hold numbers, which are
            never cut: a number that lost digits reads as another number.
    """
    cells = [[cell.split("\n") for cell in row] for row in rows]
    full = [row for row in cells if len(row) > 1]
    widths = [
        max([display_width(heading), *(display_width(line) for row in full for line in row[i])])
        for i, heading in enumerate(headings)
    ]
    excess = sum(widths) + 2 * (len(widths) - 1) - terminal.width
    for _ in range(excess):
        widest = max(elastic, key=lambda i: widths[i], default=None)
        if widest is None or widths[widest] <= _NARROWEST_COLUMN:
            break
        widths[widest] -= 1

    def line(texts: Sequence[str]) -> str:
        parts = []
        for i, text in enumerate(texts):
            fitted = terminal.shorten(text, widths[i]) if i in elastic else text
            space = " " * (widths[i] - display_width(fitted))
            parts.append(space + fitted if align[i] == ">" else fitted + space)
        return "  ".join(parts).rstrip()

    lines = [terminal.paint(line(headings), "bold")]
    for row in cells:
        if len(row) == 1:
            lines += [terminal.shorten(text, terminal.width) for text in row[0]]
            continue
        height = max(len(cell) for cell in row)
        lines += [line([cell[i] if i < len(cell) else "" for cell in row]) for i in range(height)]
    return lines


def wrap(text: str, terminal: Terminal, indent: str = "") -> list[str]:
    """Lines of words that keep to the width; ``indent`` starts every line but the first."""
    words = text.lstrip(" ").split(" ")
    lines = [" " * (len(text) - len(text.lstrip(" "))) + words[0]]
    for word in words[1:]:
        if display_width(lines[-1]) + 1 + display_width(word) > terminal.width:
            lines.append(indent + word)
        else:
            lines[-1] += " " + word
    return [line.rstrip() for line in lines]
