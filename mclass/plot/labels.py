"""Places for texts beside points, so that they hide neither each other nor what is drawn."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mclass.records import FloatArray

_LETTER, _LINE = 0.6, 1.25
"""Width of a letter and height of a line, in font sizes, generously."""

_DIRECTIONS = np.array(
    [(1, 1), (1, -1), (-1, 1), (-1, -1), (1, 0), (-1, 0), (0, 1), (0, -1)], dtype=np.float64
)
_DISTANCES = (1.0, 2.5)
_OVER_TEXT, _OVER_BORDER, _OVER_POINT, _FARTHER = 15.0, 40.0, 4.0, 0.15
"""Costs of what a text hides, next to that of one obstacle."""


def text_size(text: str, font_size: float) -> tuple[float, float]:
    """Width and height of a text, as large as it can be [point]."""
    lines = text.split("\n")
    return _LETTER * font_size * max(map(len, lines)), _LINE * font_size * len(lines)


def place_texts(
    anchors: FloatArray,
    sizes: Sequence[tuple[float, float]],
    obstacles: FloatArray,
    room: tuple[float, float],
    gap: float,
) -> FloatArray:
    """Where texts go, one after the other: each to the emptiest of the places around its point.

    Args:
        anchors: Points that are named [point], (n, 2), from the lower left corner of the axes.
        sizes: Width and height of each text [point].
        obstacles: Points that should stay visible [point], (m, 2).
        room: Width and height of the axes [point].
        gap: Between a point and its text [point].

    Returns:
        Lower left corner of each text, from its point [point], (n, 2).
    """
    points = np.concatenate([anchors, obstacles])
    worth = np.repeat([_OVER_POINT, 1.0], [len(anchors), len(obstacles)])
    corners = np.empty((len(anchors), 2))
    placed = np.empty((0, 4))
    for index, (anchor, size) in enumerate(zip(anchors, sizes, strict=True)):
        offsets = np.concatenate(
            [0.5 * (_DIRECTIONS - 1.0) * size + d * gap * _DIRECTIONS for d in _DISTANCES]
        )
        low = anchor + offsets
        high = low + size
        area = size[0] * size[1]
        both = np.minimum(high[:, None], placed[:, 2:]) - np.maximum(low[:, None], placed[:, :2])
        hidden = np.prod(np.clip(both, 0.0, None), axis=-1).sum(axis=1) / area
        inside = np.prod(np.clip(np.minimum(high, room) - np.maximum(low, 0.0), 0.0, None), axis=1)
        within = ((points > low[:, None]) & (points < high[:, None])).all(axis=-1) @ worth
        cost = _OVER_TEXT * hidden + _OVER_BORDER * (1.0 - inside / area) + within
        cost += np.repeat([0.0, _FARTHER], len(_DIRECTIONS))
        best = int(cost.argmin())
        corners[index] = offsets[best]
        placed = np.concatenate([placed, [[*low[best], *high[best]]]])
    return corners
