"""How single values read: probabilities, angles, lengths, instants."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from datetime import datetime, timezone

from mclass.results import OrientationMode
from mclass.text.terminal import Terminal

_CALENDAR_FROM_NS = 10**17  # Early 1973: stamps before it count from a start, not from 1970.


def natural(name: str) -> tuple[tuple[int, int, str, str], ...]:
    """Key that sorts names as people number them: ``o2`` before ``o10``."""
    parts = re.findall(r"[0-9]+|[^0-9]+", name)
    return tuple(
        # Numbers compare by their lengths, then digits: an id may have thousands of them.
        (0, len(part.lstrip("0")), part.lstrip("0"), part)
        if part[0] in "0123456789"
        else (1, 0, part, "")
        for part in parts
    )


def degrees(angle: float) -> float:
    """Radians to degrees in [0, 360)."""
    value = math.degrees(angle) % 360.0
    # The remainder of a tiny negative angle rounds to 360 itself.
    return 0.0 if value >= 360.0 else value


def degrees_text(angle: float) -> str:
    """Degrees to one digit, 0.0 to 359.9."""
    text = f"{degrees(angle):.1f}"
    return "0.0" if text == "360.0" else text


def probability_text(probability: float) -> str:
    """Four digits, or an exponent for what four digits would call nothing."""
    if probability == 0.0 or probability >= 0.00005:
        return f"{probability:.4f}"
    return f"{probability:.1e}"


def share_text(fraction: float) -> str:
    """Whole per cent; never 0 % for something, never 100 % when something is missing."""
    percent = round(100.0 * fraction)
    if percent == 0 and fraction > 0.0:
        return "<1 %"
    if percent == 100 and fraction < 0.9995:
        return ">99 %"
    return f"{percent} %"


def spread_text(value: float, std: float, digits: int, terminal: Terminal) -> str:
    """Value ± standard deviation; alone when the deviation is zero or unknown."""
    if std == 0.0 or not math.isfinite(std):
        return f"{value:.{digits}f}"
    return f"{value:.{digits}f} {terminal.sign('±')} {std:.{digits}f}"


def mode_text(mode: OrientationMode, terminal: Terminal) -> str:
    """``45.0 ± 9.1 (99 %)``: angle and deviation in degrees, mass."""
    angle = degrees_text(mode.orientation)
    if math.isfinite(mode.std):
        angle += f" {terminal.sign('±')} {math.degrees(mode.std):.1f}"
    return f"{angle} ({share_text(mode.mass)})"


def in_reading_order(modes: Sequence[OrientationMode]) -> list[OrientationMode]:
    """Modes heaviest first, equally heavy ones by angle: rounding must not order them."""
    return sorted(modes, key=lambda mode: (-round(mode.mass, 6), mode.orientation))


def stamp_text(stamp_ns: int) -> str:
    """A stamp as UTC, or as seconds when it does not count from 1970."""
    if stamp_ns < _CALENDAR_FROM_NS:
        return f"{seconds_text(stamp_ns)} s"
    seconds, rest = divmod(stamp_ns, 10**9)
    try:
        instant = datetime.fromtimestamp(seconds, tz=timezone.utc)
    except (OverflowError, OSError, ValueError):
        return f"{seconds_text(stamp_ns)} s"
    return f"{instant:%Y-%m-%dT%H:%M:%S}.{rest // 10**6:03d}Z"


def seconds_text(duration_ns: int) -> str:
    """Nanoseconds as seconds to the millisecond, exact for any size."""
    sign = "-" if duration_ns < 0 else ""
    milliseconds = (abs(duration_ns) + 500_000) // 10**6
    return f"{sign}{milliseconds // 1000}.{milliseconds % 1000:03d}"


def list_text(words: Sequence[str], last: str = "and") -> str:
    """``a``, ``a and b``, ``a, b and c``."""
    if len(words) < 2:
        return "".join(words)
    return f"{', '.join(words[:-1])} {last} {words[-1]}"


def count_text(count: int, noun: str) -> str:
    """``1 measurement``, ``2 measurements``."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"
