"""What a slider over the measurements shows: each measurement, and the objects after it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mclass.geometry import opening_angles
from mclass.records import FloatArray, IntArray, LabelMeasurements
from mclass.results import ObjectEstimate
from mclass.text.terminal import Terminal
from mclass.text.values import degrees, in_reading_order

MOST_STEPS = 2000
"""Measurements that the slider stops at; of more only some, evenly chosen."""

NAME_COLUMNS = 120
"""Longer names lose their middle."""

Json = dict[str, Any]


def shown_name(text: str) -> str:
    """A foreign name as it is shown: control characters escaped, of bounded length."""
    return Terminal().clean(text, NAME_COLUMNS)


def number(value: float, digits: int = 6) -> float | None:
    """A number to so many significant digits; None where JSON has none."""
    return float(f"{value:.{digits}g}") if np.isfinite(value) else None


def numbers(values: FloatArray, decimals: int) -> list[float | None]:
    """Numbers to so many decimals; None where JSON has none."""
    rounded = np.round(values.astype(np.float64), decimals)
    return [value if np.isfinite(value) else None for value in rounded.tolist()]


class Steps:
    """The measurements that the slider stops at, and which step an estimate belongs to.

    Args:
        measurements: All of them.
        most: Steps at most.
    """

    def __init__(self, measurements: LabelMeasurements, most: int = MOST_STEPS) -> None:
        self._measurements = measurements
        count = len(measurements)
        shown = min(count, most)
        # Counted from the last, which is always shown.
        self.rows: IntArray = count - 1 - np.arange(shown)[::-1] * count // max(shown, 1)
        self.total = count

    def __len__(self) -> int:
        return len(self.rows)

    def seconds(self, stamps_ns: IntArray) -> FloatArray:
        """Stamps as seconds since the first measurement."""
        return np.asarray((stamps_ns - self.start_ns) / 1e9)

    @property
    def start_ns(self) -> int:
        """Stamp of the first measurement; 0 if there is none."""
        return int(self._measurements.stamps_ns[0]) if self.total else 0

    def document(self, object_names: Mapping[str, int]) -> Json:
        """The steps as JSON can hold them.

        Args:
            object_names: Place of each object's id among the objects of the document.
        """
        found, rows = self._measurements, self.rows
        poses = found.frames.poses_world_sensor[found.frame_index[rows]]
        labels = [", ".join(map(shown_name, found.label_names_of(row))) for row in rows.tolist()]
        distinct = sorted(set(labels))
        places = {text: index for index, text in enumerate(distinct)}
        # One more for the detections without id, whose index is -1.
        owners = np.array([*(object_names.get(name, -1) for name in found.object_ids), -1])
        return {
            "total": self.total,
            "numbers": (rows + 1).tolist(),
            "seconds": numbers(self.seconds(found.stamps_ns[rows]), 3),
            "x": numbers(poses[:, 0], 3),
            "y": numbers(poses[:, 1], 3),
            "heading": numbers(poses[:, 2], 4),
            "right": numbers(found.directions[rows, 0], 4),
            "width": numbers(opening_angles(found.directions[rows]), 4),
            "object": owners[found.object_index[rows]].tolist(),
            "labels": [places[text] for text in labels],
            "label_sets": distinct,
        }

    def of(self, estimates: Sequence[ObjectEstimate]) -> IntArray:
        """The step after which each of an object's estimates is known.

        Args:
            estimates: Of one object, oldest first.
        """
        found = self._measurements
        identity = estimates[0].object_id
        index = found.object_ids.index(identity) if identity in found.object_ids else -1
        rows = np.flatnonzero(found.object_index == index)
        stamps = np.array([estimate.stamp_ns for estimate in estimates], dtype=np.int64)
        # Estimates of one stamp come one after the other, as their measurements do.
        nth = np.arange(len(stamps)) - np.searchsorted(stamps, stamps, side="left")
        at = np.searchsorted(found.stamps_ns[rows], stamps, side="left") + nth
        last = np.searchsorted(found.stamps_ns[rows], stamps, side="right") - 1
        own = rows[np.clip(np.minimum(at, last), 0, len(rows) - 1)] if len(rows) else nth * 0
        return np.minimum(np.searchsorted(self.rows, own, side="left"), max(len(self) - 1, 0))


def object_document(estimates: Sequence[ObjectEstimate], steps: IntArray) -> Json:
    """One object over time as JSON can hold it; of the estimates of one step the last.

    Args:
        estimates: Oldest first.
        steps: The step of each.
    """
    last = np.flatnonzero(np.append(np.diff(steps) > 0, True))
    return {
        "name": shown_name(estimates[0].object_id),
        "measurements": int(estimates[-1].measurements),
        "updates": [_update(estimates[index], int(steps[index])) for index in last.tolist()],
    }


def _update(estimate: ObjectEstimate, step: int) -> Json:
    x, y = estimate.position.tolist()
    x_std, y_std = estimate.position_std.tolist()
    return {
        "step": step,
        "n": int(estimate.measurements),
        "class": int(estimate.class_index),
        "tie": list(estimate.tie),
        "p": [number(value) for value in estimate.class_probabilities.tolist()],
        "place": [number(value) for value in (x, y, x_std, y_std)],
        "modes": [
            [
                number(degrees(mode.orientation)),
                number(mode.mass),
                number(float(np.degrees(mode.std))),
            ]
            for mode in in_reading_order(estimate.modes)
        ],
    }
