"""YAML text to nodes that know their line and column, in bounded time and memory.

Nothing is constructed: no tag is acted on, and what a scalar means is decided where it is
read (`mclass.config.checks`), by the rules of YAML 1.2. Size, depth and the number of nodes
*after* following aliases are limited, so that neither a deep file nor an alias bomb costs
more than an ordinary one.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import NoReturn

import yaml
from yaml.composer import Composer
from yaml.parser import Parser
from yaml.reader import Reader, ReaderError
from yaml.resolver import BaseResolver
from yaml.scanner import Scanner

from mclass.errors import ConfigError, ConfigProblem

MAX_BYTES = 1_000_000
"""Twenty times a model of a hundred classes, each mistaken for five others."""
MAX_DEPTH = 32
"""A model file needs eight levels."""
MAX_NODES = 50_000
"""Keys and values, each alias counted as the whole of what it stands for."""
MAX_PROBLEMS = 100
"""More are not worth reading in one go, and finding them could take long."""

_LINE_BREAK = re.compile("\r\n|[\r\n\x85\u2028\u2029]")


class Problems:
    """Faults found so far in one file.

    Attributes:
        path: The file as shown to people.
        found: In the order of discovery.
    """

    def __init__(self, path: str) -> None:
        self.path = path
        self.found: list[ConfigProblem] = []

    def add(self, mark: yaml.Mark | None, key: str, message: str) -> None:
        """Record a fault; raises ConfigError at once when there are too many."""
        line, column = (mark.line + 1, mark.column + 1) if mark else (0, 0)
        self.found.append(ConfigProblem(self.path, line, column, key, message))
        if len(self.found) >= MAX_PROBLEMS:
            text = f"{MAX_PROBLEMS} problems found; the rest of the file was not checked"
            self.found.append(ConfigProblem(self.path, 0, 0, "", text))
            self.raise_any()

    def raise_any(self) -> None:
        """Raise ConfigError with all faults in file order, if there are any."""
        if self.found:
            last = MAX_BYTES + 1
            raise ConfigError(sorted(self.found, key=lambda p: (p.line or last, p.column)))

    def fatal(self, mark: yaml.Mark | None, message: str) -> NoReturn:
        """Record a fault after which nothing more can be read, and raise."""
        self.add(mark, "", message)
        self.raise_any()
        raise AssertionError("unreachable: a problem was just added")


def read_bytes(path: Path) -> bytes:
    """A file's content, at most `MAX_BYTES` of it ever in memory.

    Raises:
        ConfigError: If the file is missing, unreadable, a directory or too large.
    """
    problems = Problems(str(path))
    try:
        if path.is_dir():
            problems.fatal(None, "this is a folder; name the file in it")
        with path.open("rb") as stream:
            data = stream.read(MAX_BYTES + 1)
    except FileNotFoundError:
        problems.fatal(None, "no such file; check the name and the folder it is looked for in")
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        problems.fatal(None, f"cannot be read: {reason}")
    _check_size(len(data), problems)
    return data


def decode(data: bytes, path: str) -> str:
    """UTF-8 text of a file, without its byte order mark.

    Raises:
        ConfigError: If the bytes are too many or not UTF-8, with the place of the first
            wrong one.
    """
    problems = Problems(path)
    _check_size(len(data), problems)
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        problems.fatal(_mark(0, 0), "the file is UTF-16; save it as UTF-8")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        # Offsets count from after a byte order mark, as the exception's own object does.
        before = error.object[: error.start].decode("utf-8")
        byte = error.object[error.start]
        problems.fatal(_mark_after(before), f"byte 0x{byte:02x} is not UTF-8; save as UTF-8")


def compose(text: str, problems: Problems) -> yaml.Node:
    """The root node of the only document in a YAML text.

    Tags are recorded as problems and otherwise ignored; scalars carry their text and style.

    Raises:
        ConfigError: If the text is not one YAML document within the limits.
    """
    _check_size(len(text), problems)
    text = text.removeprefix("\ufeff")
    try:
        loader = _Loader(text, problems)
    except ReaderError as error:
        mark = _mark_after(text[: error.position])
        problems.fatal(mark, f"character U+{ord(text[error.position]):04X} is not allowed in YAML")
    try:
        loader.get_event()  # type: ignore[no-untyped-call]  # the stream's start
        if loader.check_event(yaml.StreamEndEvent):
            problems.fatal(_mark(0, 0), "the file is empty; it must hold keys and values")
        root = loader.compose_document()
        if not loader.check_event(yaml.StreamEndEvent):
            mark = loader.next_mark()
            problems.fatal(
                mark, "a second document starts here; a file may hold only one: remove it"
            )
    except yaml.MarkedYAMLError as error:
        problems.fatal(error.problem_mark or error.context_mark, _syntax_message(error, text))
    except (ValueError, OverflowError):
        # The scanner converts \U escapes and version numbers without checking their range.
        problems.fatal(loader.get_mark(), "a number or escape here is out of range")
    assert root is not None
    return root


class _Loader(Reader, Scanner, Parser, Composer, BaseResolver):
    """PyYAML's pure Python composer, without meaning for scalars, with limits.

    Pure Python, as the C composer cannot be stopped on its way down, and so that positions
    and messages are the same on every machine.
    """

    def __init__(self, text: str, problems: Problems) -> None:
        Reader.__init__(self, text)
        Scanner.__init__(self)
        Parser.__init__(self)
        Composer.__init__(self)
        BaseResolver.__init__(self)
        self._problems = problems
        self._depth = 0
        self._nodes = 0
        self._sizes: dict[int, int] = {}

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        event = self.peek_event()  # type: ignore[no-untyped-call]
        mark = event.start_mark
        if self.check_event(yaml.AliasEvent):
            node = super().compose_node(parent, index)
            if id(node) not in self._sizes:
                self._problems.fatal(mark, f"'*{event.anchor}' stands inside what it stands for")
            self._count(self._sizes[id(node)], mark)
            return node
        if getattr(event, "tag", None) is not None:
            tag = event.tag[:80].replace("tag:yaml.org,2002:", "!!")
            advice = "remove it, and put text in quotes"
            self._problems.add(mark, "", f"tags such as {tag!r} are not read; {advice}")
        self._depth += 1
        if self._depth > MAX_DEPTH:
            self._problems.fatal(
                mark, f"nested deeper than {MAX_DEPTH} levels; no file of ours needs that"
            )
        before = self._nodes
        self._count(1, mark)
        node = super().compose_node(parent, index)
        self._sizes[id(node)] = self._nodes - before
        self._depth -= 1
        return node

    def next_mark(self) -> yaml.Mark:
        """Where the next event starts."""
        mark: yaml.Mark = self.peek_event().start_mark  # type: ignore[no-untyped-call]
        return mark

    def _count(self, nodes: int, mark: yaml.Mark) -> None:
        self._nodes += nodes
        if self._nodes > MAX_NODES:
            text = f"more than {MAX_NODES:,} keys and values up to here, aliases followed"
            self._problems.fatal(mark, f"{text}; the limit protects from files that explode")


def _check_size(size: int, problems: Problems) -> None:
    if size > MAX_BYTES:
        problems.fatal(None, f"larger than {MAX_BYTES:,} bytes; no file of ours needs that")


def _syntax_message(error: yaml.MarkedYAMLError, text: str) -> str:
    mark = error.problem_mark
    if mark is not None and text[mark.index : mark.index + 1] == "\t":
        return "a tab stands where YAML allows only spaces; indent with spaces"
    message = f"not valid YAML: {error.problem or 'cannot be parsed'}"
    if error.context:
        where = error.context_mark
        message += f" ({error.context}" + (f" from line {where.line + 1})" if where else ")")
    if "mapping values" in message:
        message += "; check the indentation, and quote text that holds ': '"
    return message[:400]


def _mark(line: int, column: int) -> yaml.Mark:
    return yaml.Mark("", 0, line, column, None, 0)


def _mark_after(text: str) -> yaml.Mark:
    lines = _LINE_BREAK.split(text)
    return _mark(len(lines) - 1, len(lines[-1]))
