"""Where the fields of a ROS message lie: definitions compiled to runs of fixed size.

A message is a list of runs. A run is a stretch of fields whose places follow from where it
starts; it ends behind a length, whose string or sequence follows. CDR aligns every number to
its own size, counted from the start of the payload, so all sizes are tabulated over the eight
phases (position modulo 8) that a run can start in. ROS 1 packs: its tables are constant.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np

from mclass.errors import LogError
from mclass.logs.decode.base import MAX_LEAVES
from mclass.messages.definitions import (
    DUMMY_FIELD_NAME,
    DURATION_TYPES,
    PRIMITIVE_SIZES,
    STRING_TYPES,
    TIME_TYPES,
    Definition,
    Field,
)
from mclass.records import IntArray

PHASES = range(8)

MAX_SIZE = 1 << 40
"""No message is as large [bytes]; what may be larger is clipped, so that it fits an integer."""


@dataclass(frozen=True)
class Scalar:
    """A value of fixed size: a number, or a stamp of two words (seconds, nanoseconds)."""

    kind: str
    dtype: np.dtype[Any]
    words: int = 1

    @property
    def size(self) -> int:
        """Size [bytes]."""
        return self.dtype.itemsize * self.words


@dataclass(frozen=True)
class Leaf:
    """A value, or fixed array of values, in a run; ``offsets`` from its start, by phase."""

    path: str
    scalar: Scalar
    count: int | None
    offsets: IntArray


@dataclass(frozen=True)
class Text:
    """A string behind its length, which in CDR counts a final zero."""

    path: str
    terminated: bool
    wanted: bool = True


@dataclass(frozen=True)
class Numbers:
    """A sequence of scalars behind its length, aligned unless it is empty."""

    path: str
    scalar: Scalar
    align: int
    wanted: bool = True


@dataclass(frozen=True)
class Elements:
    """A sequence of structures behind its length, or ``count`` of them without one."""

    struct: Struct
    count: int | None


Tail: TypeAlias = Text | Numbers | Elements


@dataclass(frozen=True)
class Run:
    """Fields of fixed size, then at most one of varying size.

    Attributes:
        sizes: Bytes from the run's start to its tail, padding and length included, by phase.
        leaves: The wanted ones among its fields.
        tail: What follows.
        counted: Whether the run's last word is the tail's length.
    """

    sizes: IntArray
    leaves: tuple[Leaf, ...]
    tail: Tail | None
    counted: bool

    @cached_property
    def size_list(self) -> list[int]:
        """``sizes`` as plain integers."""
        sizes: list[int] = self.sizes.tolist()
        return sizes


@dataclass(frozen=True)
class Struct:
    """The runs of a message, ``min_size`` bytes or more."""

    runs: tuple[Run, ...]
    min_size: int

    @property
    def is_fixed(self) -> bool:
        """Whether its size follows from its phase alone."""
        return len(self.runs) == 1 and self.runs[0].tail is None

    @cached_property
    def bare(self) -> Struct:
        """The same layout with nothing wanted."""
        return self.select(frozenset())

    @cached_property
    def wants_any(self) -> bool:
        """Whether a leaf is wanted, at any depth."""
        return any(
            run.leaves
            or (run.tail.struct.wants_any if isinstance(run.tail, Elements) else False)
            or (isinstance(run.tail, Text | Numbers) and run.tail.wanted)
            for run in self.runs
        )

    def select(self, wanted: frozenset[str]) -> Struct:
        """The same layout with these leaves wanted only."""
        runs = []
        for run in self.runs:
            tail = run.tail
            if isinstance(tail, Elements):
                tail = replace(tail, struct=tail.struct.select(wanted))
            elif tail is not None:
                tail = replace(tail, wanted=tail.path in wanted)
            leaves = tuple(leaf for leaf in run.leaves if leaf.path in wanted)
            runs.append(replace(run, leaves=leaves, tail=tail))
        return Struct(tuple(runs), self.min_size)


def _scalars(*, aligned: bool) -> dict[str, Scalar]:
    codes = {"bool": "u1", "float": "f", "int": "i", "uint": "u"}
    scalars = {}
    for name, size in PRIMITIVE_SIZES.items():
        letters = name.rstrip("0123456789")
        kind = letters.removeprefix("u")
        code = codes[letters] if letters == "bool" else f"<{codes[letters]}{size}"
        scalars[name] = Scalar(kind, np.dtype(code))
    seconds = np.dtype("<i4" if aligned else "<u4")
    scalars.update({name: Scalar("time", seconds, 2) for name in TIME_TYPES})
    scalars.update({name: Scalar("int", np.dtype("<i4"), 2) for name in DURATION_TYPES})
    return scalars


@dataclass
class _Builder:
    """Collects the runs of one structure."""

    definitions: Mapping[str, Definition]
    scalars: Mapping[str, Scalar]
    aligned: bool
    kinds: dict[str, str]
    visits: Iterator[int]
    runs: list[Run] = field(default_factory=list)
    sizes: list[int] = field(default_factory=lambda: [0] * len(PHASES))
    leaves: list[Leaf] = field(default_factory=list)
    tail_min_size: int = 0

    def add_definition(self, name: str, prefix: str) -> None:
        for item in self.definitions[name].fields:
            if item.name != DUMMY_FIELD_NAME:
                self.add_field(item, f"{prefix}{item.name}")
            else:
                self.place(1, 1)

    def add_field(self, item: Field, path: str) -> None:
        if next(self.visits) > MAX_LEAVES:
            raise LogError(f"the schema has more than {MAX_LEAVES} fields.")
        scalar = self.scalar_of(item.type)
        is_array = item.array is not None
        if item.type == "wstring":
            raise LogError(
                f"the schema's field {path!r} is a wstring, which ROS 2 releases encode in "
                "different ways."
            )
        if scalar is None and item.type not in STRING_TYPES and not is_array:
            self.add_definition(item.type, f"{path}.")
        elif scalar is not None and item.array != -1 and (scalar.words == 1 or not is_array):
            self.kinds[path] = scalar.kind
            offsets = self.place(
                scalar.dtype.itemsize, scalar.size * (1 if item.array is None else item.array)
            )
            self.leaves.append(Leaf(path, scalar, item.array, offsets))
        elif not is_array:
            self.kinds[path] = "string"
            self.finish(Text(path, self.aligned), 0, counted=True)
        elif scalar is not None and item.array == -1:
            self.kinds[f"{path}[]"] = scalar.kind
            align = scalar.dtype.itemsize if self.aligned else 1
            self.finish(Numbers(f"{path}[]", scalar, align), 0, counted=True)
        else:
            self.add_elements(item, f"{path}[]")

    def add_elements(self, item: Field, path: str) -> None:
        inner = _Builder(self.definitions, self.scalars, self.aligned, self.kinds, self.visits)
        if item.type in self.definitions and self.scalar_of(item.type) is None:
            inner.add_definition(item.type, f"{path}.")
        else:
            inner.add_field(Field("", item.type, None), path)
        struct = inner.build()
        count = None if item.array == -1 else item.array
        self.finish(Elements(struct, count), struct.min_size * (count or 0), counted=count is None)

    def scalar_of(self, type_name: str) -> Scalar | None:
        definition = self.definitions.get(type_name)
        if definition is not None and [item.type for item in definition.fields] != [
            "int32",
            "uint32",
        ]:
            return None
        return self.scalars.get(type_name)

    def place(self, align: int, size: int) -> IntArray:
        """Put a value of this size behind the others; its offsets by phase."""
        if not self.aligned or not size:
            align = 1
        offsets = [taken + -(phase + taken) % align for phase, taken in enumerate(self.sizes)]
        self.sizes = [offset + size for offset in offsets]
        return np.array(offsets, dtype=np.int64)

    def finish(self, tail: Tail | None, tail_min_size: int, *, counted: bool) -> None:
        """End the run with what follows it."""
        if counted:
            self.place(4, 4)
        sizes = np.array(self.sizes, dtype=np.int64)
        self.runs.append(Run(sizes, tuple(self.leaves), tail, counted))
        self.tail_min_size += min(self.sizes) + tail_min_size
        self.sizes = [0] * len(PHASES)
        self.leaves = []

    def build(self) -> Struct:
        # A last field can be an array of nothing: it takes no bytes, but is there.
        if any(self.sizes) or self.leaves or not self.runs:
            self.finish(None, 0, counted=False)
        # Elements that take no bytes at all could be claimed without end, so they count as one.
        return Struct(tuple(self.runs), min(max(self.tail_min_size, 1), MAX_SIZE))


def compile_layout(
    definitions: Mapping[str, Definition], root: str, *, aligned: bool
) -> tuple[Struct, dict[str, str]]:
    """Layout of a root message, and the kind of each of its leaves by path.

    Args:
        definitions: As parsed from the schema.
        root: Key of the root message.
        aligned: Whether numbers are aligned (CDR) or packed (ROS 1).

    Raises:
        LogError: If the schema expands to more than ``MAX_LEAVES`` fields or holds a
            ``wstring``.
    """
    kinds: dict[str, str] = {}
    builder = _Builder(definitions, _scalars(aligned=aligned), aligned, kinds, itertools.count())
    builder.add_definition(root, "")
    return builder.build(), kinds
