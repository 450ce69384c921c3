"""Typed access to YAML nodes that records every fault instead of stopping at the first.

A *reader* turns a `Value` into something usable, or records a problem and raises
`Rejected`. `fields` reads a section whose keys are fixed, so that one more setting is one
more line in a mapping of key to reader; `entries` reads a section whose keys are names that
the user chose.
"""

from __future__ import annotations

import difflib
import itertools
import math
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NoReturn, TypeVar

import yaml

from mclass.config.scalars import (
    MAX_TEXT,
    describe,
    is_null,
    number_problem,
    shorten,
    text_problem,
)
from mclass.config.yaml_source import Problems

T = TypeVar("T")

_NOTHING: Any = object()
"""Stands for a rejected value until all its neighbours have been looked at."""

MAX_COORDINATE = 1e7
"""Farthest position and longest length [m]; UTM coordinates stay below it."""


class Rejected(Exception):  # noqa: N818 - a signal between readers, not an error for users
    """A value cannot be used; why has already been recorded."""


@dataclass(frozen=True)
class Value:
    """A node and where it stands.

    Attributes:
        node: Its YAML node.
        key: Dotted path from the root of the file.
        mark: Where its key stands; a missing key inside it is reported there.
        problems: Where faults are recorded.
    """

    node: yaml.Node
    key: str
    mark: yaml.Mark
    problems: Problems

    def note(self, message: str) -> None:
        """Record a fault of this value and go on."""
        node = self.node
        is_block = isinstance(node, yaml.CollectionNode) and not node.flow_style
        self.problems.add(self.mark if is_block else node.start_mark, self.key, message)

    def fail(self, message: str) -> NoReturn:
        """Record a fault of this value and give it up."""
        self.note(message)
        raise Rejected

    @property
    def scalar(self) -> str | None:
        """The text of a plain (unquoted, one-line) scalar; None for anything else."""
        node = self.node
        return node.value if isinstance(node, yaml.ScalarNode) and not node.style else None

    @property
    def is_empty(self) -> bool:
        """Whether nothing, or `null`, was given."""
        return is_null(self.node)

    def elements(self) -> list[Value]:
        """The elements of a list; fails on anything else."""
        if not isinstance(self.node, yaml.SequenceNode):
            self.fail(f"must be a list, not {describe(self.node)}")
        return [
            Value(node, f"{self.key}[{index}]", node.start_mark, self.problems)
            for index, node in enumerate(self.node.value)
        ]

    def pairs(self) -> Iterator[tuple[yaml.ScalarNode, Value]]:
        """Scalar keys of a section and their values, unchecked; none for anything else."""
        for key, node in self.node.value if isinstance(self.node, yaml.MappingNode) else ():
            if isinstance(key, yaml.ScalarNode):
                yield key, Value(node, _join(self.key, key.value), key.start_mark, self.problems)

    def at(self, key: str) -> Value:
        """The value under a key, or this value when it has no such key."""
        return next((child for name, child in self.pairs() if name.value == key), self)


Reader = Callable[[Value], T]


def attempt(reader: Reader[T], value: Value | None, default: T) -> T:
    """What a reader makes of a value; the default when it is absent or rejected."""
    if value is None:
        return default
    try:
        return reader(value)
    except Rejected:
        return default


def children(
    value: Value,
    known: Collection[str],
    *,
    required: Collection[str] = (),
    together: Collection[tuple[str, ...]] = (),
    apart: Collection[tuple[str, str]] = (),
) -> dict[str, Value]:
    """The values of a section with fixed keys; faults among its keys are recorded.

    Args:
        value: The section.
        known: All keys it may have.
        required: Keys it must have.
        together: Groups of which all keys must be given, or none.
        apart: Pairs of which only one key may be given.
    """
    found: dict[str, Value] = {}
    for name, child in _pairs(value):
        if name in known:
            found[name] = child
            continue
        advice = suggestion(name, known) or f"Keys here: {', '.join(known)}."
        if ":" in name and child.is_empty:
            advice = "A colon must be followed by a space."
        value.problems.add(child.mark, child.key, f"unknown key. {advice}")
    for name in required:
        if name not in found:
            value.problems.add(value.mark, _join(value.key, name), "missing; this key is required")
    for group in together:
        missing = [name for name in group if name not in found]
        if missing and len(missing) < len(group):
            value.note(f"{', '.join(group)} belong together; add {', '.join(missing)}")
    for one, other in apart:
        if one in found and other in found:
            found[other].note(f"{one} says the same; remove {one} or {other}")
    return found


def fields(
    value: Value,
    readers: Mapping[str, Reader[Any]],
    *,
    required: Collection[str] = (),
    together: Collection[tuple[str, ...]] = (),
    apart: Collection[tuple[str, str]] = (),
) -> dict[str, Any]:
    """What is given in a section with fixed keys, by key; arguments as in `children`.

    Raises:
        Rejected: If anything in it is wrong or missing; all of it has been looked at.
    """
    before = len(value.problems.found)
    given = children(value, readers, required=required, together=together, apart=apart)
    found = {name: attempt(readers[name], child, _NOTHING) for name, child in given.items()}
    if len(value.problems.found) > before or _NOTHING in found.values():
        raise Rejected
    return found


def entries(value: Value) -> dict[str, Value]:
    """The values of a section whose keys are names chosen by the user, in file order."""
    return dict(_pairs(value, user_names=True))


def suggestion(name: str, known: Collection[str]) -> str:
    """``Did you mean ...?``, or nothing when no known name is close."""
    if len(name) > MAX_TEXT or len(known) > 1000:
        return ""  # comparing would take long
    close = difflib.get_close_matches(name, known, n=1)
    return f"Did you mean '{close[0]}'?" if close else ""


def unknown_name(name: str, kind: str, known: Collection[str]) -> str:
    """Message for a name that stands for nothing: what there is, what was probably meant."""
    if not known:
        return f"unknown {kind} {shorten(name)}. There are none."
    shown = ", ".join(shorten(other)[1:-1] for other in itertools.islice(known, 10))
    there_are = f"There are: {shown}{', ...' if len(known) > 10 else ''}."
    return f"unknown {kind} {shorten(name)}. {suggestion(name, known) or there_are}"


# Readers of single values.


def text(value: Value) -> str:
    """A name, topic or path: non-empty text that YAML cannot take for something else."""
    if not isinstance(value.node, yaml.ScalarNode):
        value.fail(f"must be text, not {describe(value.node)}")
    problem = text_problem(value.node)
    if problem:
        value.fail(problem)
    return str(value.node.value)


def choice(*options: str) -> Reader[Any]:
    """One of a few words."""

    def read(value: Value) -> str:
        given = value.node.value
        if not isinstance(given, str) or given not in options:
            close = suggestion(given, options) if isinstance(given, str) else ""
            problem = f"must be one of {', '.join(options)}, not {describe(value.node)}"
            value.fail(f"{problem}. {close}" if close else problem)
        return given

    return read


def switch(value: Value) -> bool:
    """``true`` or ``false``; no other word, as readers of YAML differ about the rest."""
    if value.scalar not in ("true", "false"):
        value.fail(f"must be true or false, not {describe(value.node)}")
    return value.scalar == "true"


def number(
    *,
    minimum: float = -math.inf,
    maximum: float = math.inf,
    above: float = -math.inf,
    scale: float = 1.0,
) -> Reader[float]:
    """A finite number times ``scale``; bounds are of the product, ``above`` is exclusive."""

    def read(value: Value) -> float:
        given = _finite(value)
        scaled = given * scale
        if scaled <= above:
            value.fail(f"must be greater than {above / scale:g}, not {given:g}")
        if scaled < minimum:
            value.fail(f"must be at least {minimum / scale:g}, not {given:g}")
        if scaled > maximum:
            value.fail(f"must be at most {maximum / scale:g}, not {given:g}")
        return scaled

    return read


def integer(minimum: int, maximum: int) -> Reader[int]:
    """A whole number between two inclusive bounds."""

    def read(value: Value) -> int:
        given = _finite(value)
        if given != int(given) or not minimum <= given <= maximum:
            value.fail(f"must be a whole number from {minimum} to {maximum}, not {given:g}")
        return int(given)

    return read


def _finite(value: Value) -> float:
    problem = number_problem(value.node)
    if problem:
        value.fail(problem)
    return float(value.node.value)


def coordinate(unit: float) -> Reader[float]:
    """A signed length in units to metres."""
    return number(minimum=-MAX_COORDINATE, maximum=MAX_COORDINATE, scale=unit)


def angle(scale: float = 1.0) -> Reader[float]:
    """An angle of at most one turn either way, in radians after scaling."""
    turn = 2.0 * math.pi * (1.0 + 1e-12)  # 360 degrees, rounded, must pass
    return number(minimum=-turn, maximum=turn, scale=scale)


def vector(reader: Reader[T], *meaning: str) -> Reader[tuple[T, ...]]:
    """A list with one element for each meaning."""

    def read(value: Value) -> tuple[T, ...]:
        elements = value.elements()
        if len(elements) != len(meaning):
            value.fail(f"must be [{', '.join(meaning)}], not a list of {len(elements)}")
        return several(reader, elements)

    return read


def several(reader: Reader[T], values: Collection[Value]) -> tuple[T, ...]:
    """All values read; rejected as a whole, after all have been looked at, if any is wrong."""
    read: list[Any] = [attempt(reader, value, _NOTHING) for value in values]
    if _NOTHING in read:
        raise Rejected
    return tuple(read)


def _pairs(value: Value, *, user_names: bool = False) -> Iterator[tuple[str, Value]]:
    """Key and value of a mapping in file order; keys that are wrong or repeated are recorded."""
    if value.is_empty:
        return
    if not isinstance(value.node, yaml.MappingNode):
        value.fail(f"must be a section of keys and values, not {describe(value.node)}")
    for key_node, _ in value.node.value:
        if not isinstance(key_node, yaml.ScalarNode):
            problem = "a key must be text, not a list or section"
            value.problems.add(key_node.start_mark, value.key, problem)
    first_lines: dict[str, int] = {}
    for key_node, child in value.pairs():
        name = key_node.value
        problem = text_problem(key_node) if user_names else ""
        is_merge = name == "<<" and not key_node.style
        if is_merge:
            advice = "repeat the entries, or use *name for a whole value"
            problem = f"merge keys are not read; {advice}"
        elif name in first_lines:
            problem = f"given twice, first in line {first_lines[name]}; remove one"
        if problem:
            value.problems.add(child.mark, child.key, problem)
        if not is_merge and name not in first_lines:
            first_lines[name] = child.mark.line + 1
            yield name, child


def _join(key: str, name: str) -> str:
    shown = name if len(name) <= 60 and name.isprintable() else shorten(name)[1:-1]
    return f"{key}.{shown}" if key else shown
