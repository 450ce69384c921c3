"""Locks that end with the process that holds them."""

from __future__ import annotations

try:
    import fcntl
except ImportError:  # a system without such locks
    fcntl = None  # type: ignore[assignment]


def take_lock(file: int, *, wait: bool) -> bool:
    """Take the only lock of an open file; False if another has it, or the system has no locks."""
    if fcntl is None:
        return False
    try:
        fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except OSError:
        return False
    return True
