"""Results as message values, the same for every encoding: our own messages.

The fields of ``mclass_msgs/msg/X`` and ``mclass.X`` bear the same names, so one value serves
both; only the header differs, which the encoding's module adds.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from mclass.classes import BACKGROUND
from mclass.errors import LogError, ModelError
from mclass.footprint import Grid
from mclass.records import FloatArray, Frames, IntArray, LabelMeasurements
from mclass.results import BeliefBlock, ObjectEstimate, OrientationMode

ROWS_PER_MESSAGE = 5000
"""Measurements, and frames, in one message."""

_FARTHEST = 1e15
"""Positions of ours are nearer [m]."""
_WIDEST = 10.0
"""Angles of ours are smaller [rad]."""
_ROUNDING = 1e-6
"""By how much a probability can exceed 1."""
_DENSEST = 100.0
"""Logarithms of densities are smaller; without bound below, but not all of them."""


def refuse_nan(what: str, *arrays: npt.NDArray[Any]) -> None:
    """Let no NaN out.

    Raises:
        ModelError: If there is one.
    """
    if any(np.isnan(array).any() for array in arrays):
        raise ModelError(f"{what} holds a value that is not a number; it is not written")


def _refuse_impossible(
    what: str, numbers: npt.ArrayLike, low: float = -_FARTHEST, high: float = _FARTHEST
) -> None:
    """Let no number in that an output of ours cannot hold, NaN least of all.

    Raises:
        LogError: If there is one.
    """
    values = np.asarray(numbers, dtype=np.float64)
    wrong = values[~((values >= low) & (values <= high))]
    if wrong.size:
        raise LogError(f"{what} holds {wrong[0]}, outside [{low:g}, {high:g}]")


def estimate_value(estimate: ObjectEstimate, class_names: Sequence[str]) -> dict[str, Any]:
    """One object as ``Estimate``; ``class_names`` without the background.

    Raises:
        ModelError: If a number is NaN.
    """
    modes = [(mode.orientation, mode.mass, mode.std) for mode in estimate.modes]
    refuse_nan(
        f"the estimate of object {estimate.object_id[:80]!r}",
        estimate.class_probabilities,
        estimate.position,
        estimate.position_std,
        estimate.class_poses,
        np.array([*modes, estimate.joint_map[1:]], dtype=np.float64),
    )
    best, best_x, best_y, best_orientation = estimate.joint_map
    poses = [(0.0, 0.0, 0.0), *estimate.class_poses.tolist()]
    return {
        "id": estimate.object_id,
        "stamp_ns": int(estimate.stamp_ns),
        "log_time_ns": int(estimate.log_time_ns),
        "labels": list(estimate.labels),
        "measurements": int(estimate.measurements),
        "class_name": class_names[estimate.class_index],
        "tie": [class_names[index] for index in estimate.tie],
        "x": float(estimate.position[0]),
        "y": float(estimate.position[1]),
        "x_std": float(estimate.position_std[0]),
        "y_std": float(estimate.position_std[1]),
        "classes": [
            {"name": name, "probability": probability, "x": x, "y": y, "orientation": orientation}
            for name, probability, (x, y, orientation) in zip(
                (BACKGROUND, *class_names),
                estimate.class_probabilities.tolist(),
                poses,
                strict=True,
            )
        ],
        "modes": [
            {"orientation": orientation, "mass": mass, "std": std}
            for orientation, mass, std in modes
        ],
        "joint_maximum": {
            "class_name": class_names[best],
            "x": float(best_x),
            "y": float(best_y),
            "orientation": float(best_orientation),
        },
    }


def estimate_from(value: Mapping[str, Any], class_names: Sequence[str]) -> ObjectEstimate:
    """The object that `estimate_value` described.

    Raises:
        LogError: If it names a class that is not among ``class_names``, or holds an impossible
            number.
    """
    what = f"object {value['id'][:80]!r}"

    def index(name: str) -> int:
        if name not in class_names:
            raise LogError(f"{what} names the unknown class {name!r}")
        return class_names.index(name)

    classes = value["classes"]
    if [entry["name"] for entry in classes] != [BACKGROUND, *class_names]:
        raise LogError(f"{what} has other classes than the log's model")
    joint = value["joint_maximum"]
    modes = value["modes"]
    poses = (*classes, joint)
    shares = [entry["probability"] for entry in classes] + [mode["mass"] for mode in modes]
    _refuse_impossible(what, shares, 0.0, 1.0 + _ROUNDING)
    _refuse_impossible(what, [entry[axis] for entry in (value, *poses) for axis in "xy"])
    _refuse_impossible(
        what, [entry["orientation"] for entry in (*poses, *modes)], -_WIDEST, _WIDEST
    )
    stds = [value["x_std"], value["y_std"], *(mode["std"] for mode in modes)]
    _refuse_impossible(what, stds, 0.0, np.inf)
    return ObjectEstimate(
        object_id=value["id"],
        stamp_ns=value["stamp_ns"],
        log_time_ns=value["log_time_ns"],
        labels=tuple(value["labels"]),
        measurements=value["measurements"],
        class_probabilities=np.array([entry["probability"] for entry in classes]),
        class_index=index(value["class_name"]),
        tie=tuple(index(name) for name in value["tie"]),
        position=np.array([value["x"], value["y"]]),
        position_std=np.array([value["x_std"], value["y_std"]]),
        class_poses=np.array(
            [(entry["x"], entry["y"], entry["orientation"]) for entry in classes[1:]]
        ),
        modes=tuple(
            OrientationMode(mode["orientation"], mode["mass"], mode["std"]) for mode in modes
        ),
        joint_map=(index(joint["class_name"]), joint["x"], joint["y"], joint["orientation"]),
    )


def belief_value(block: BeliefBlock, class_names: Sequence[str]) -> dict[str, Any]:
    """One block as ``Belief``, without its header.

    Raises:
        ModelError: If a number is NaN.
    """
    refuse_nan(
        f"the belief of object {block.object_id[:80]!r}" if block.object_id else "the belief",
        block.log_cell_mass,
        block.log_class_probability,
        block.log_density,
    )
    return {
        "stamp_ns": int(block.stamp_ns),
        "log_time_ns": int(block.log_time_ns),
        "object_id": block.object_id,
        "block": block.block,
        "blocks": block.blocks,
        "origin_x": float(block.grid.origin[0]),
        "origin_y": float(block.grid.origin[1]),
        "cell_size": float(block.grid.cell_size),
        "rows": int(block.grid.rows),
        "columns": int(block.grid.columns),
        "class_names": [BACKGROUND, *class_names],
        "orientation_bins": block.log_density.shape[2],
        "cells": block.cells,
        "log_cell_mass": block.log_cell_mass,
        "log_class_probability": block.log_class_probability,
        "log_density": block.log_density,
        "measurements": block.measurements,
    }


def belief_from(value: Mapping[str, Any], class_names: Sequence[str]) -> BeliefBlock:
    """The block that `belief_value` described; arrays are views where they can be.

    Raises:
        LogError: If the arrays do not fit each other, the grid or the classes, or hold an
            impossible number.
    """
    cells = len(value["cells"])
    classes = len(class_names) + 1
    if list(value["class_names"]) != [BACKGROUND, *class_names]:
        raise LogError("a belief has other classes than the log's model")
    shapes = {
        "log_cell_mass": (cells,),
        "log_class_probability": (cells, classes),
        "log_density": (cells, classes - 1, value["orientation_bins"]),
        "measurements": (cells,),
    }
    arrays = {name: _shaped(value, name, shape) for name, shape in shapes.items()}
    _refuse_impossible("log_cell_mass", arrays["log_cell_mass"], -np.inf, _ROUNDING)
    for name, high in (("log_class_probability", _ROUNDING), ("log_density", _DENSEST)):
        _refuse_impossible(name, arrays[name], -np.inf, high)
        peaks = arrays[name].max(axis=-1, initial=-np.inf)
        _refuse_impossible(f"the greatest {name}", peaks, -_DENSEST, high)
    grid = checked_grid(
        (value["origin_x"], value["origin_y"]), value["cell_size"], value["rows"], value["columns"]
    )
    _check_range(value["cells"], 0, grid.rows * grid.columns - 1, "cells")
    return BeliefBlock(
        object_id=value["object_id"],
        grid=grid,
        stamp_ns=value["stamp_ns"],
        log_time_ns=value["log_time_ns"],
        block=value["block"],
        blocks=value["blocks"],
        cells=value["cells"],
        **arrays,
    )


def checked_grid(origin: tuple[float, float], cell_size: float, rows: int, columns: int) -> Grid:
    """A grid from what a message says.

    Raises:
        LogError: If there is no such grid.
    """
    if not (np.isfinite([*origin, cell_size]).all() and cell_size > 0 and rows > 0 < columns):
        raise LogError(f"a grid of {rows} x {columns} cells of {cell_size} m at {origin}")
    return Grid(origin, cell_size, rows, columns)


def measurement_values(measurements: LabelMeasurements) -> Iterator[dict[str, Any]]:
    """All measurements as ``Measurements``, one value a block, without headers."""
    frames = measurements.frames
    longest = max(len(measurements), len(frames))
    blocks = max(1, -(-longest // ROWS_PER_MESSAGE))
    for block in range(blocks):
        span = slice(block * ROWS_PER_MESSAGE, (block + 1) * ROWS_PER_MESSAGE)
        offsets = measurements.label_offsets[span.start : span.stop + 1]
        labels = slice(offsets[0], offsets[-1]) if len(offsets) else slice(0)
        covariances = frames.covariances
        yield {
            "block": block,
            "blocks": blocks,
            "label_names": measurements.label_names if block == 0 else (),
            "object_ids": measurements.object_ids if block == 0 else (),
            "frame_stamps_ns": frames.stamps_ns[span],
            "frame_log_times_ns": frames.log_times_ns[span],
            "frame_poses": frames.poses_world_sensor[span],
            "frame_covariances": np.zeros(0) if covariances is None else covariances[span],
            "has_covariances": covariances is not None,
            "frame_view_directions": frames.view_directions[span],
            "frame_index": measurements.frame_index[span],
            "directions": measurements.directions[span],
            "object_index": measurements.object_index[span],
            "label_counts": np.diff(offsets),
            "labels": measurements.labels[labels],
            "scores": measurements.scores[labels],
        }


def measurements_from(values: Sequence[Mapping[str, Any]]) -> LabelMeasurements:
    """The measurements that `measurement_values` described, given all blocks in order.

    Raises:
        LogError: If the arrays do not fit each other.
    """
    names = (*_FLOATS, *_INTEGERS)
    joined: dict[str, Any] = {
        name: np.concatenate([value[name] for value in values]) for name in names
    }
    frames = len(joined["frame_stamps_ns"])
    rows = len(joined["frame_index"])
    labels = len(joined["labels"])
    covariances = None
    if values[0]["has_covariances"]:
        covariances = _shaped(joined, "frame_covariances", (frames, 3, 3))
    counts = _shaped(joined, "label_counts", (rows,))
    object_ids = tuple(values[0]["object_ids"])
    label_names = tuple(values[0]["label_names"])
    _check_range(counts, 0, labels, "label_counts")
    _check_range(joined["frame_index"], 0, frames - 1, "frame_index")
    _check_range(joined["object_index"], -1, len(object_ids) - 1, "object_index")
    _check_range(joined["labels"], 0, len(label_names) - 1, "labels")
    if counts.sum() != labels:
        raise LogError(f"{labels} labels, though the measurements count {counts.sum()}")
    return LabelMeasurements(
        frames=Frames(
            stamps_ns=joined["frame_stamps_ns"],
            log_times_ns=_shaped(joined, "frame_log_times_ns", (frames,)),
            poses_world_sensor=_shaped(joined, "frame_poses", (frames, 3)),
            covariances=covariances,
            view_directions=_shaped(joined, "frame_view_directions", (frames, 2)),
        ),
        frame_index=joined["frame_index"],
        directions=_shaped(joined, "directions", (rows, 2)),
        object_index=_shaped(joined, "object_index", (rows,)),
        object_ids=object_ids,
        label_offsets=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        labels=joined["labels"],
        scores=_shaped(joined, "scores", (labels,)),
        label_names=label_names,
    )


_FLOATS = ("frame_poses", "frame_covariances", "frame_view_directions", "directions", "scores")
_INTEGERS = (
    "frame_stamps_ns",
    "frame_log_times_ns",
    "frame_index",
    "object_index",
    "label_counts",
    "labels",
)


def _shaped(value: Mapping[str, Any], name: str, shape: tuple[int, ...]) -> Any:
    """An array in its shape."""
    array: FloatArray = value[name]
    if array.size != np.prod(shape, dtype=np.int64):
        raise LogError(f"{name} has {array.size} numbers, not {shape}")
    return array.reshape(shape)


def _check_range(array: IntArray, low: int, high: int, name: str) -> None:
    if array.size and (array.min() < low or array.max() > high):
        raise LogError(f"{name} holds {array.min()} to {array.max()}, outside [{low}, {high}]")
