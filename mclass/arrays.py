"""Measurements from plain arrays, for programs that bring their own."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from mclass.errors import UsageError
from mclass.records import FloatArray, Frames, IntArray, LabelMeasurements

_STEP_NS = 100_000_000


def measurements_from_arrays(
    poses: npt.ArrayLike,
    labels: Sequence[Sequence[str]],
    label_names: Sequence[str],
    *,
    directions: npt.ArrayLike | None = None,
    object_ids: Sequence[str | None] | None = None,
    stamps_ns: npt.ArrayLike | None = None,
    view_directions: npt.ArrayLike | None = None,
    covariances: npt.ArrayLike | None = None,
) -> LabelMeasurements:
    """Measurements, one a row: where the sensor was, and what it returned for one object.

    Rows with one stamp and one pose are one frame. A row without labels is a frame in which
    nothing was detected; only models that count silence use it.

    Args:
        poses: Sensor in the world: x [m], y [m], heading of its optical axis [rad], (m, 3).
        labels: Names of the labels returned, m of them.
        label_names: All that the model knows, in its order: ``model.classes.label_names``.
        directions: World azimuths [rad] of the right and the left edge of the box,
            counter-clockwise from right to left, (m, 2), equal for a ray; NaN, or None for
            all, when the measurement points nowhere: it then says nothing about the grid.
        object_ids: Of each row; None for a detection of no known object.
        stamps_ns: When [ns], not decreasing, (m,); a tenth of a second apart when None.
        view_directions: Azimuths of the right and the left border of the view, (m, 2).
        covariances: Of the poses, (m, 3, 3).

    Raises:
        UsageError: If shapes, labels or values contradict each other.
    """
    rows = len(labels)
    pose = _array("poses", poses, (rows, 3))
    nowhere = np.full((rows, 2), np.nan)
    edges = nowhere if directions is None else _array("directions", directions, (rows, 2), True)
    views = (
        nowhere
        if view_directions is None
        else _array("view_directions", view_directions, (rows, 2), True)
    )
    spread = None if covariances is None else _array("covariances", covariances, (rows, 3, 3))
    stamps = (
        _STEP_NS * np.arange(rows, dtype=np.int64)
        if stamps_ns is None
        else _stamps(stamps_ns, rows)
    )
    ids = [None] * rows if object_ids is None else list(object_ids)
    if len(ids) != rows:
        raise UsageError(f"object_ids has {len(ids)} entries for {rows} rows of labels")

    known = {name: index for index, name in enumerate(label_names)}
    unknown = sorted({name for names in labels for name in names} - known.keys())
    if unknown:
        raise UsageError(
            f"labels {', '.join(unknown)} are not among {', '.join(label_names)}; "
            "leave them out, or give the model a likelihood for them"
        )
    same = (np.diff(stamps) == 0) & (np.diff(pose, axis=0) == 0.0).all(axis=1)
    starts = np.flatnonzero(np.concatenate([[rows > 0], ~same[: max(rows - 1, 0)]]))
    frame_index = np.searchsorted(starts, np.arange(rows), side="right") - 1
    sets = [sorted({known[name] for name in names}) for names in labels]
    detected = np.array([len(found) > 0 for found in sets], dtype=bool)
    names = sorted({name for name in ids if name is not None})
    object_index = np.array([-1 if name is None else names.index(name) for name in ids], np.int64)
    _refuse_repeats(frame_index[detected], object_index[detected], names)
    found = [label for indices in sets for label in indices]
    return LabelMeasurements(
        frames=Frames(
            stamps_ns=stamps[starts],
            log_times_ns=stamps[starts],
            poses_world_sensor=pose[starts],
            covariances=None if spread is None else spread[starts],
            view_directions=views[starts],
        ),
        frame_index=frame_index[detected].astype(np.int64),
        directions=edges[detected],
        object_index=object_index[detected],
        object_ids=tuple(names),
        label_offsets=np.cumsum(
            [0, *(len(indices) for indices in sets if indices)], dtype=np.int64
        ),
        labels=np.array(found, dtype=np.int64),
        scores=np.ones(len(found)),
        label_names=tuple(label_names),
    )


def _array(
    name: str, values: npt.ArrayLike, shape: tuple[int, ...], nan_allowed: bool = False
) -> FloatArray:
    """Floats of a shape, finite unless NaN may stand for "unknown"."""
    try:
        array = np.array(values, dtype=float)
    except (TypeError, ValueError) as error:
        raise UsageError(f"{name} is no array of numbers: {error}") from error
    if array.size == 0 == np.prod(shape):
        array = array.reshape(shape)
    if array.shape != shape:
        raise UsageError(f"{name} has the shape {array.shape}, not {shape}")
    if np.isinf(array).any() or (np.isnan(array).any() and not nan_allowed):
        raise UsageError(f"{name} holds values that are not finite")
    return array


def _stamps(stamps_ns: npt.ArrayLike, rows: int) -> IntArray:
    """Integer stamps that do not go back."""
    stamps = np.array(stamps_ns)
    if stamps.shape != (rows,) or (rows and stamps.dtype.kind not in "iu"):
        raise UsageError(f"stamps_ns must be {rows} integers (nanoseconds; floats lose digits)")
    stamps = stamps.astype(np.int64)
    if (np.diff(stamps) < 0).any() or (stamps < 0).any():
        raise UsageError("stamps_ns must be positive and not decrease; sort the rows by time")
    return stamps


def _refuse_repeats(frames: IntArray, objects: IntArray, names: Sequence[str]) -> None:
    """One object is one row in a frame."""
    pairs, counts = np.unique(
        np.stack([frames, objects])[:, objects >= 0], axis=1, return_counts=True
    )
    if (counts > 1).any():
        name = names[int(pairs[1, np.argmax(counts > 1)])]
        raise UsageError(f"object {name!r} has two rows in one frame; join their labels in one row")
