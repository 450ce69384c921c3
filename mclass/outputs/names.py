"""Topic names and texts for object ids and class names, which may be any string."""

from __future__ import annotations

import hashlib
import re

_TOKEN = re.compile(r"[A-Za-z](?:_?[A-Za-z0-9])*")
_NUMBER = re.compile(r"[0-9](?:_?[A-Za-z0-9])*")
_UNUSABLE = re.compile(r"[^A-Za-z0-9]+")
_LONGEST = 48
_SHORT_HASH = 8


class TopicTokens:
    """One distinct topic name part for each name.

    ROS allows letters, digits and single underscores, none at the begin or end and no digit
    first. A name that is so already is its own token, a number gets ``id_`` in front, and
    from any other what can be kept is kept, with a hash that tells it from its like. A token
    depends on its name alone, unless an earlier name was made to collide with it.
    """

    def __init__(self) -> None:
        self._tokens: dict[str, str] = {}
        self._owners: dict[str, str] = {}

    def token(self, name: str) -> str:
        """The token of a name: the same for the same name, different for different names."""
        known = self._tokens.get(name)
        if known is not None:
            return known
        token = _readable_token(name)
        digest = _digest(name)
        length = _SHORT_HASH
        while token in self._owners:
            token = _with_hash(name, digest[:length])
            length += 1
        self._tokens[name] = token
        self._owners[token] = name
        return token


def display_text(name: str, longest: int = 40) -> str:
    """A name on one line, short enough to stand beside an arrow."""
    # Only the head is looked at: ids of megabytes exist.
    head = "".join(c if c.isprintable() else " " for c in name[: longest + 1])
    return head if len(head) <= longest else head[: longest - 1] + "…"


def _readable_token(name: str) -> str:
    if len(name) <= _LONGEST:
        if _TOKEN.fullmatch(name):
            return name
        if _NUMBER.fullmatch(name):
            return f"id_{name}"
    return _with_hash(name, _digest(name)[:_SHORT_HASH])


def _with_hash(name: str, digest: str) -> str:
    kept = _UNUSABLE.sub("_", name[:_LONGEST]).strip("_")
    if not kept[:1].isalpha():
        kept = f"id_{kept}".rstrip("_")
    return f"{kept}_{digest}"


def _digest(name: str) -> str:
    return hashlib.sha256(name.encode("utf-8", "surrogatepass")).hexdigest()
