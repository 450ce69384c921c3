"""What a YAML scalar means: numbers by YAML 1.2, and text that no reader takes for less.

YAML 1.1, which most Python programs read, and 1.2, which most editors do, differ about
``1e-3``, ``no`` or ``010``. What both read alike is accepted, and ``1e-3`` as a number; for
the rest a message tells how to write it.
"""

from __future__ import annotations

import re
import unicodedata

import yaml
from yaml.resolver import Resolver

MAX_TEXT = 200
"""Longest name, topic or number."""

_MAX_NUMBER = 1e15
_NUMBER = re.compile(r"[-+]?(0|[1-9][0-9]*|[0-9]+\.[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?")
_NOT_FINITE = re.compile(r"[-+]?\.?(inf|infinity|nan)", re.IGNORECASE)
_SLIPS = (
    (_NUMBER, "remove the quotes"),
    (re.compile(r"[-+]?[0-9]+,[0-9]+"), "use a decimal point"),
    (
        re.compile(r"[-+]?([0-9]+(_[0-9]+)+|0[0-9xob].*)"),
        "write plain decimal digits without leading zeros or underscores",
    ),
    (
        re.compile(r"[-+.0-9eE]+ *[a-zA-Z²°%/]+[0-9]?"),
        "leave out the unit: lengths are in length_unit",
    ),
)
_READ_AS = {
    "bool": "true or false",
    "int": "a number",
    "float": "a number",
    "null": "nothing",
    "timestamp": "a date",
    "merge": "a merge key",
    "value": "a default value",
}


def is_null(node: yaml.Node) -> bool:
    """Whether a node is nothing, or an unquoted ``null``."""
    is_plain = isinstance(node, yaml.ScalarNode) and not node.style
    return is_plain and node.value in ("", "~", "null", "Null", "NULL")


def shorten(text: str) -> str:
    """Text as shown in messages: quoted, escaped, at most 60 characters of it."""
    return repr(text if len(text) <= 60 else text[:57] + "...")


def number_problem(node: yaml.Node) -> str:
    """What is wrong with a node as a finite number; nothing if ``float`` may read its text."""
    if is_null(node):
        return "has no value; write a number or remove the key"
    if not isinstance(node, yaml.ScalarNode):
        return f"must be a number, not {describe(node)}"
    given = node.value
    if len(given) > MAX_TEXT:
        return f"must be a number, not {describe(node)}"
    if _NOT_FINITE.fullmatch(given):
        return f"must be a finite number, not {given}"
    if not node.style and _NUMBER.fullmatch(given):
        is_small = abs(float(given)) <= _MAX_NUMBER
        return "" if is_small else f"must be a number of at most {_MAX_NUMBER:g}, not {given}"
    hints = [hint for slip, hint in _SLIPS if slip.fullmatch(given)]
    return "; ".join([f"must be a number, not {describe(node)}", *hints[:1]])


def text_problem(node: yaml.ScalarNode) -> str:
    """What is wrong with a scalar as a name, topic or path; nothing if it can be one."""
    given = node.value
    if len(given) > MAX_TEXT:
        return f"longer than {MAX_TEXT} characters"
    bad = next((c for c in given if unicodedata.category(c) in ("Cc", "Cs", "Zl", "Zp")), None)
    if bad is not None:
        return f"holds the control character U+{ord(bad):04X}; remove it"
    if is_null(node):
        return "has no value; give one, in quotes if it is meant to be that text"
    if not given.strip():
        return "holds nothing but spaces"
    if node.style:
        return ""
    read_as = _READ_AS.get(_yaml_1_1_type(given))
    if read_as is None and _NUMBER.fullmatch(given):
        read_as = "a number"
    return f'YAML reads {given} as {read_as}; write "{given}" in quotes' if read_as else ""


def describe(node: yaml.Node) -> str:
    """A node in words, for messages."""
    if isinstance(node, yaml.SequenceNode):
        return f"a list of {len(node.value)}"
    if isinstance(node, yaml.MappingNode):
        return "a section of keys and values"
    return "nothing" if is_null(node) else f"the text {shorten(node.value)}"


def _yaml_1_1_type(plain: str) -> str:
    """What YAML 1.1 takes an unquoted scalar for: ``str``, ``bool`` and so on."""
    tag: str = Resolver().resolve(yaml.ScalarNode, plain, (True, False))  # type: ignore[no-untyped-call]
    return tag.rsplit(":", 1)[-1]
