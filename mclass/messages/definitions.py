"""ROS message definitions, read from the text that logs embed as schemas.

A schema is the ``.msg`` text of its root type, followed by that of every type it uses,
each behind a line of ``=`` and a line ``MSG: package/Type``. Only what the layout of a
message depends on is kept: constants, default values, bounds and comments are not.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, TypeAlias

from mclass.errors import LogError

Dialect: TypeAlias = Literal["ros2msg", "ros1msg"]

TIME_TYPES = ("builtin_interfaces/Time", "time")
DURATION_TYPES = ("builtin_interfaces/Duration", "duration")
STRING_TYPES = ("string", "wstring")

PRIMITIVE_SIZES: Mapping[str, int] = {
    "bool": 1,
    "int8": 1,
    "uint8": 1,
    "int16": 2,
    "uint16": 2,
    "int32": 4,
    "uint32": 4,
    "int64": 8,
    "uint64": 8,
    "float32": 4,
    "float64": 8,
}
"""Size [bytes] of every primitive of fixed size; ``byte`` and ``char`` are renamed to these."""

# IDL has no empty structure, so ROS 2 puts this one byte into messages without fields.
DUMMY_FIELD_NAME = "structure_needs_at_least_one_member"

MAX_NESTING = 64

_ALIASES: Mapping[str, Mapping[str, str]] = {
    "ros2msg": {"byte": "uint8", "char": "uint8"},
    "ros1msg": {"byte": "int8", "char": "uint8"},
}
_SEPARATOR = re.compile(r"^={3,}[ \t\r]*$", re.MULTILINE)
_TITLE = re.compile(r"\s*MSG:[ \t]*(?P<name>[\w/]+)[ \t\r]*(?:\n|\Z)")
_LINE = re.compile(
    r"(?P<type>[A-Za-z]\w*(?:/[A-Za-z]\w*){0,2})(?:<=(?P<bound>\d{1,9}))?"
    r"(?:\[(?:(?P<limit><=)?(?P<size>\d{1,9}))?(?P<bracket>\]))?"
    r"[ \t]+(?P<name>[A-Za-z]\w*)(?P<rest>(?:[\s=#].*)?)"
)


@dataclass(frozen=True)
class Field:
    """One field of a message.

    Attributes:
        name: As in the definition.
        type: A key of ``PRIMITIVE_SIZES``, ``string``, ``wstring``, ROS 1's ``time`` or
            ``duration``, or the full name ``package/Type`` of another definition.
        array: None for a single value, -1 for a sequence (bounded or not), else the number
            of elements of a fixed array.
    """

    name: str
    type: str
    array: int | None


@dataclass(frozen=True)
class Definition:
    """The fields of one message type, in the order of the wire."""

    name: str
    fields: tuple[Field, ...]


_STAMP_FIELDS = (Field("sec", "int32", None), Field("nanosec", "uint32", None))
_BUILTIN = {
    name: Definition(name, _STAMP_FIELDS)
    for name in ("builtin_interfaces/Time", "builtin_interfaces/Duration")
}


def normalise_name(name: str) -> str:
    """``package/Type`` for ``package/msg/Type``; other names are returned as they are."""
    parts = name.strip().split("/")
    return f"{parts[0]}/{parts[2]}" if len(parts) == 3 else "/".join(parts)


def parse_definitions(schema_name: str, text: str, dialect: Dialect) -> Mapping[str, Definition]:
    """Read a schema: its root message and all types that come with it.

    Args:
        schema_name: Name of the root, ``package/Type`` or ``package/msg/Type``.
        text: Concatenated ``.msg`` texts.
        dialect: ``ros2msg``, or ``ros1msg`` with its ``Header``, ``time`` and ``duration``.

    Returns:
        Definitions by ``package/Type``, the root's first. Every type that a field of theirs
        names is among them or primitive, and none contains itself.

    Raises:
        LogError: If the text is empty or no definition, if a type is missing or contains
            itself, or if types are nested more than ``MAX_NESTING`` deep.
    """
    root = normalise_name(schema_name)
    if not text.strip():
        raise LogError(f"schema {schema_name!r} is empty, its messages cannot be decoded.")
    first, *others = _SEPARATOR.split(text)
    title = _TITLE.match(first)
    bodies = {root: first[title.end() :] if title else first}
    for section in others:
        title = _TITLE.match(section)
        if title is None:
            raise LogError(
                f"schema {schema_name!r}: no line 'MSG: package/Type' after a line of '='."
            )
        bodies.setdefault(normalise_name(title["name"]), section[title.end() :])

    raw = {name: _parse_body(schema_name, name, body, dialect) for name, body in bodies.items()}
    if not raw[root]:
        raise LogError(f"schema {schema_name!r} defines no fields, there is nothing to decode.")
    known = dict(raw)
    if dialect == "ros2msg":
        known.update({name: list(_STAMP_FIELDS) for name in _BUILTIN if name not in raw})
    definitions = {
        name: Definition(
            name,
            tuple(
                Field(
                    field.name, _resolve(schema_name, field.type, name, known, dialect), field.array
                )
                for field in fields
            ),
        )
        for name, fields in known.items()
    }
    _check_nesting(schema_name, root, definitions)
    return definitions


def _parse_body(schema_name: str, name: str, body: str, dialect: Dialect) -> list[Field]:
    """Fields of one message, types as written."""
    fields: list[Field] = []
    for number, line in enumerate(body.splitlines(), start=1):
        content = line.strip()
        if not content or content.startswith("#"):
            continue
        match = _LINE.fullmatch(content)
        if match is None or (match["bound"] and match["type"] not in STRING_TYPES):
            raise LogError(
                f"schema {schema_name!r}: line {number} of {name} is not a message field: "
                f"{content[:80]!r}."
            )
        if match["rest"].lstrip().startswith("="):
            continue
        array = None
        if match["bracket"]:
            array = -1 if match["limit"] or match["size"] is None else int(match["size"])
        if any(field.name == match["name"] for field in fields):
            raise LogError(f"schema {schema_name!r}: {name} has two fields {match['name']!r}.")
        fields.append(Field(match["name"], match["type"], array))
    if not fields and dialect == "ros2msg" and name != normalise_name(schema_name):
        fields.append(Field(DUMMY_FIELD_NAME, "uint8", None))
    return fields


def _resolve(
    schema_name: str, type_name: str, owner: str, known: Mapping[str, object], dialect: Dialect
) -> str:
    """Full name of a type as written in the definition of ``owner``."""
    type_name = _ALIASES[dialect].get(type_name, type_name)
    if type_name in PRIMITIVE_SIZES or type_name in STRING_TYPES:
        return type_name
    if dialect == "ros1msg" and type_name in ("time", "duration"):
        return type_name
    if "/" in type_name:
        full = normalise_name(type_name)
        if full in known:
            return full
    else:
        package = owner.rpartition("/")[0]
        named = [f"{package}/{type_name}"] if package else [type_name]
        if type_name == "Header":
            # Headers are the one type that definitions name without its package.
            named.insert(0 if dialect == "ros1msg" else len(named), "std_msgs/Header")
        elsewhere = [name for name in known if name.endswith(f"/{type_name}")]
        for candidate in named + (elsewhere if len(elsewhere) == 1 else []):
            if candidate in known:
                return candidate
    raise LogError(f"schema {schema_name!r}: {owner} uses {type_name!r}, which it does not define.")


def _check_nesting(schema_name: str, root: str, definitions: Mapping[str, Definition]) -> None:
    """Refuse types that contain themselves, wherever they are in the schema."""
    finished: dict[str, int] = {}

    def depth(name: str, path: tuple[str, ...]) -> int:
        if name in path:
            chain = " in ".join((name, *reversed(path[path.index(name) :])))
            raise LogError(f"schema {schema_name!r}: a type contains itself: {chain}.")
        if len(path) > MAX_NESTING:
            raise LogError(f"schema {schema_name!r}: nested more than {MAX_NESTING} types deep.")
        if name not in finished:
            inner = {field.type for field in definitions[name].fields} & definitions.keys()
            finished[name] = 1 + max(
                (depth(type_name, (*path, name)) for type_name in sorted(inner)), default=0
            )
        return finished[name]

    deepest = max(depth(name, ()) for name in (root, *definitions))
    if deepest > MAX_NESTING:
        raise LogError(f"schema {schema_name!r}: nested more than {MAX_NESTING} types deep.")
