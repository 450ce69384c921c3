"""Colours of classes, told apart by the colour-blind (Okabe and Ito)."""

from __future__ import annotations

import numpy as np

from mclass.records import FloatArray

CLASS_COLORS: tuple[tuple[int, int, int], ...] = (
    (0x00, 0x72, 0xB2),
    (0xD5, 0x5E, 0x00),
    (0x00, 0x9E, 0x73),
    (0xCC, 0x79, 0xA7),
    (0xE6, 0x9F, 0x00),
    (0x56, 0xB4, 0xE9),
)
"""Red, green, blue, 0 to 255; used again from the first when there are more classes."""

BACKGROUND_COLOR = (0xBB, 0xBB, 0xBB)


def class_color(index: int) -> tuple[float, float, float]:
    """Colour of a class, each part 0 to 1."""
    red, green, blue = CLASS_COLORS[index % len(CLASS_COLORS)]
    return red / 255.0, green / 255.0, blue / 255.0


def hex_color(color: tuple[int, int, int]) -> str:
    """``#rrggbb`` of red, green, blue, 0 to 255."""
    return "#{:02x}{:02x}{:02x}".format(*color)


def palette(n_classes: int) -> FloatArray:
    """Colours 0 to 255 of the background and the classes, (1 + n, 3)."""
    classes = [CLASS_COLORS[index % len(CLASS_COLORS)] for index in range(n_classes)]
    return np.array([BACKGROUND_COLOR, *classes], dtype=np.float64)
