"""The examples of README.md and docs/: find them, run them, compare them.

Run as a program it puts the present outputs into them: ``python tests/documents.py``.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
README = ROOT / "README.md"
DOCUMENTS = [README, *sorted((ROOT / "docs").glob("*.md"))]

_FENCE = re.compile(r"^```([^\n]*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
_ZERO = 1e-9
"""Numbers closer to each other than this are equal: what is left of a rounded zero."""
_NOISE = 1e-5
"""And so are those whose ratio is this close to 1: beliefs are tabulated, all digits are not."""


@dataclass(frozen=True)
class Block:
    """One fenced block: what stands behind the fence, its text and where that is."""

    kind: str
    text: str
    start: int
    end: int


def blocks(document: str) -> list[Block]:
    """The fenced blocks, in order."""
    return [
        Block(found[1], found[2], found.start(2), found.end(2))
        for found in _FENCE.finditer(document)
    ]


def commands(block: Block) -> list[tuple[str, str]]:
    """Each command of a console block with the output shown below it."""
    parts = re.split(r"^\$ (.*)\n", block.text, flags=re.MULTILINE)
    assert not parts[0], f"a console block begins with a command: {parts[0]!r}"
    return list(zip(parts[1::2], parts[2::2], strict=True))


def lay_out(folder: Path) -> None:
    """What the examples find in their folder: the sample logs and the configs."""
    shutil.copytree(ROOT / "sample_logs", folder / "sample_logs")
    shutil.copytree(ROOT / "configs", folder / "configs")
    for left in folder.glob("sample_logs/*.mclass.mcap"):
        left.unlink()


def run(command: str, folder: Path) -> str:
    """What a command prints, errors included, with this interpreter's programs first."""
    found = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    environment = {**os.environ, "PATH": found, "PYTHONUTF8": "1", "NO_COLOR": "1"}
    done = subprocess.run(
        ["bash", "-c", command],
        cwd=folder,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        encoding="utf-8",
        check=False,
    )
    return done.stdout


def same_output(command: str, shown: str, printed: str) -> bool:
    """Whether two outputs agree: texts exactly, numbers to one unit of the last digit shown.

    Processors and libraries round the last bit differently, and a printed digit may turn on
    it; spaces that make room for a number may change with it. ``mclass batch`` prints how
    long it took: there, any number goes.
    """
    if _words(shown) != _words(printed):
        return False
    if command.startswith("mclass batch"):
        return True
    pairs = zip(_NUMBER.findall(shown), _NUMBER.findall(printed), strict=True)
    return all(_same_number(a, b) for a, b in pairs)


def _words(text: str) -> str:
    return " ".join(_NUMBER.sub("0", text).split())


def _same_number(a: str, b: str) -> bool:
    step = max(_last_digit(a), _last_digit(b), _ZERO)
    noise = _NOISE * abs(float(a)) if "." in a else 0.0
    return abs(float(a) - float(b)) <= max(1.01 * step, noise)


def _last_digit(number: str) -> float:
    mantissa, _, exponent = number.partition("e")
    decimals = len(mantissa.partition(".")[2])
    if not decimals and not exponent:
        return 0.0  # counts are exact
    return float(10.0 ** (int(exponent or 0) - decimals))


def examples(document: str) -> Iterator[tuple[str, str, Block]]:
    """What is run, what stands below it, and the block of the latter, in order.

    Commands of console blocks stand above their outputs; a program in a python block prints
    what the text block after it shows.
    """
    program = None
    for block in blocks(document):
        if block.kind == "console":
            start = block.start
            for line, output in commands(block):
                start += len(f"$ {line}\n")
                yield line, output, Block("console", output, start, start + len(output))
                start += len(output)
        elif block.kind == "python":
            program = block.text
        elif block.kind == "text" and program is not None:
            yield f"python -c {shlex.quote(program)}", block.text, block
            program = None


def refreshed(document: str) -> str:
    """A document with the present outputs of its examples."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        lay_out(folder)
        parts, end = [], 0
        for line, _, block in examples(document):
            parts += [document[end : block.start], run(line, folder)]
            end = block.end
        return "".join([*parts, document[end:]])


if __name__ == "__main__":
    for path in DOCUMENTS:
        path.write_text(refreshed(path.read_text(encoding="utf-8")), encoding="utf-8")
