"""Times as people type them."""

from __future__ import annotations

import re
from datetime import datetime, timedelta, timezone
from decimal import Decimal

from mclass.errors import LogError, UsageError
from mclass.logs.reader import LogReader

_UNITS = {
    "ns": 1,
    "us": 10**3,
    "ms": 10**6,
    "s": 10**9,
    "m": 60 * 10**9,
    "min": 60 * 10**9,
    "h": 3600 * 10**9,
}
_OFFSET = re.compile(r"\+(\d{1,18}(?:\.\d{1,18})?)(ns|us|ms|s|m|min|h)", re.ASCII)
_NANOSECONDS = re.compile(r"\d{1,19}", re.ASCII)
_RFC_3339 = re.compile(
    r"(\d{4}-\d{2}-\d{2})[Tt ](\d{2}:\d{2}:\d{2})(?:\.(\d{1,9}))?([Zz]|[+-]\d{2}:\d{2})",
    re.ASCII,
)
_EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)
_LATEST_NS = 2**63 - 1


def find_window(
    reader: LogReader, start: str | None, end: str | None
) -> tuple[int | None, int | None]:
    """The log times between which messages are wanted.

    Args:
        reader: The open log.
        start: Where to begin, as for `find_time_bound`; None for the beginning.
        end: Before what to stop; None for the end.

    Returns:
        Log times [ns]: the first, and the one that the last must be before.

    Raises:
        UsageError: If a bound is no time, or the end is not after the start.
        LogError: If the log holds no message between them.
    """
    first, last = reader.start_ns or 0, reader.end_ns or 0
    start_ns = None if start is None else find_time_bound(start, first)
    end_ns = None if end is None else find_time_bound(end, first)
    if start_ns is not None and end_ns is not None and end_ns <= start_ns:
        raise UsageError(f"the end {end!r} is not after the start {start!r}: nothing lies between")
    if (start_ns is not None and start_ns > last) or (end_ns is not None and end_ns <= first):
        wanted = (
            f"from {start}" if start is not None and (start_ns or 0) > last else f"before {end}"
        )
        raise LogError(
            f"no detection can be used: nothing is logged {wanted}. The log holds "
            f"{(last - first) * 1e-9:.3f} s, from {first} to {last} ns.",
            path=str(reader.path),
        )
    return start_ns, end_ns


def find_time_bound(text: str, start_ns: int) -> int:
    """The log time that a bound means.

    Args:
        text: Nanoseconds since 1970, an RFC 3339 date and time with offset, or ``+10s`` (``ns``,
            ``us``, ``ms``, ``s``, ``m``, ``h``) from the log's start.
        start_ns: The log's start [ns].

    Returns:
        Log time [ns].

    Raises:
        UsageError: If it is none of these, or beyond what a log can hold.
    """
    text = text.strip()
    if found := _OFFSET.fullmatch(text):
        time_ns = start_ns + int(Decimal(found[1]) * _UNITS[found[2]])
    elif _NANOSECONDS.fullmatch(text):
        time_ns = int(text)
    elif found := _RFC_3339.fullmatch(text):
        time_ns = _date_time_ns(text, *found.groups())
    else:
        raise UsageError(
            f"{text!r} is no time. Give nanoseconds (1700000000000000000), a date and time with "
            "offset (2023-11-14T22:13:20Z), or a time from the log's start (+10s)."
        )
    if not 0 <= time_ns <= _LATEST_NS:
        raise UsageError(f"{text!r} is outside the times that a log can hold (1970 to 2262).")
    return time_ns


def _date_time_ns(text: str, day: str, clock: str, fraction: str | None, zone: str) -> int:
    """Nanoseconds since 1970; a leap second counts as the second after it."""
    leap = clock.endswith(":60")
    if leap:
        clock = clock[:-2] + "59"
    offset = "+00:00" if zone in "Zz" else zone
    try:
        moment = datetime.fromisoformat(f"{day}T{clock}{offset}")
    except ValueError as error:
        raise UsageError(f"{text!r} is no date and time: {error}.") from error
    seconds = (moment - _EPOCH) // timedelta(seconds=1) + leap
    return seconds * 10**9 + int((fraction or "").ljust(9, "0"))
