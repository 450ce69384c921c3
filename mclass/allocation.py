"""How memory that is freed is used again."""

from __future__ import annotations

import numpy as np

_GREATEST = 2**25 - 2**16
"""Bytes; glibc's greatest threshold, less what it adds to a block."""


def keep_freed_memory() -> None:
    """Have memory that is freed kept for the next array, not given back to the system.

    Arrays of some megabytes that are made and freed in a loop would otherwise be cleared by the
    system, page by page, each time: half of the loop's time. glibc keeps blocks up to the
    size of the greatest that it has seen freed (mallopt(3), M_MMAP_THRESHOLD); one that is never
    written to costs nothing. Under other allocators this does nothing.
    """
    np.empty(_GREATEST, dtype=np.uint8)
