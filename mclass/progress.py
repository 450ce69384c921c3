"""How work that takes long tells how far it is, without knowing who listens."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

Progress: TypeAlias = Callable[[str, int, int, str], None]
"""Called with what is being done, how much of it is done, of how much, and in which unit.

A total of 0 is not known yet. Calls for one piece of work follow one another; ``done`` may start
anew when it takes several passes.
"""


def unheard(stage: str, done: int, total: int, unit: str) -> None:
    """Nobody listens."""


def in_bytes(progress: Progress, stage: str) -> Callable[[int, int], None]:
    """The same for work that only counts bytes: called with bytes done and bytes in all."""
    return lambda done, total: progress(stage, done, total, "bytes")
