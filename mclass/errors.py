"""Every error a user can meet.

::

    MclassError
    ├── UsageError    the command's arguments contradict each other or the data
    ├── ConfigError   the model file: path, line, column, key; one or many problems
    ├── LogError      a log: path, topic, message index
    └── ModelError    the mathematics cannot go on: shapes, covariances, zero evidence

The attributes carry what the wording says, so programs need not parse it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


class MclassError(Exception):
    """Base of all errors raised on purpose; ``exit_code`` is the command's."""

    exit_code = 1


class UsageError(MclassError):
    """Wrong use of a command or function."""

    exit_code = 2


@dataclass(frozen=True)
class ConfigProblem:
    """One fault in a model file. ``line`` and ``column`` count from 1; 0 when unknown."""

    path: str
    line: int
    column: int
    key: str
    message: str

    def __str__(self) -> str:
        where = f"{self.path}:{self.line}:{self.column}" if self.line else self.path
        return f"{where}: {self.key}: {self.message}" if self.key else f"{where}: {self.message}"


class ConfigError(MclassError):
    """A model file is wrong; ``problems`` holds every fault found in it."""

    exit_code = 2

    def __init__(self, problems: Sequence[ConfigProblem]) -> None:
        self.problems = tuple(problems)
        super().__init__("\n".join(str(problem) for problem in self.problems))


class LogError(MclassError):
    """A log cannot be read or written."""

    def __init__(
        self,
        message: str,
        *,
        path: str | None = None,
        topic: str | None = None,
        message_index: int | None = None,
    ) -> None:
        self.path = path
        self.topic = topic
        self.message_index = message_index
        where = []
        if topic is not None:
            where.append(f"topic {topic}")
        if message_index is not None:
            where.append(f"message {message_index}")
        prefix = f"{path}: " if path else ""
        prefix += f"{', '.join(where)}: " if where else ""
        super().__init__(prefix + message)


class ModelError(MclassError):
    """The model or its evidence is mathematically impossible."""
