"""Detections as a detector publishes them: real ones, clutter, ids right and wrong."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mclass.errors import ModelError
from mclass.geometry import wrap_angle
from mclass.logs.directions import hull
from mclass.records import BoolArray, FloatArray, Frames, IntArray, LabelMeasurements
from mclass.simulation.camera import azimuths, clip_boxes, planar_mount
from mclass.simulation.scenario import Camera, Errors, LookAt, Scenario

_CLUTTER_SIZES = (30.0, 200.0)
"""Smallest and largest edge of a clutter box [pixel]."""


@dataclass(frozen=True)
class Detections:
    """Detections of all frames, in the order of the frames.

    Attributes:
        frame_index: (n,).
        boxes: Left, top, right, bottom [pixel], (n, 4).
        id_index: Index of the object whose id is given, -1 for none, (n,).
        true_index: Index of the object really seen, -1 for clutter, (n,).
        scores: Score of each label, 0 where it is not returned, (n, labels).
    """

    frame_index: IntArray
    boxes: FloatArray
    id_index: IntArray
    true_index: IntArray
    scores: FloatArray

    def __len__(self) -> int:
        return len(self.frame_index)


def scripted_detections(
    scenario: Scenario, look_stops: tuple[int, ...], boxes: FloatArray, visible: BoolArray
) -> Detections:
    """One detection a frame, as the stops say.

    Args:
        scenario: With its stops.
        look_stops: Index of the stop of every frame, (f).
        boxes: Of all objects in all frames [pixel], (f, o, 4).
        visible: Whether they are in the image, (f, o).

    Raises:
        ModelError: If the object looked at is not in the image.
    """
    ids = [item.object_id for item in scenario.objects]
    rows = np.zeros(len(look_stops), dtype=np.int64)
    scores = np.zeros((len(look_stops), len(scenario.label_names)))
    for frame, stop_index in enumerate(look_stops):
        stop = scenario.trajectory.stops[stop_index]
        assert isinstance(stop, LookAt)
        rows[frame] = ids.index(stop.object_id)
        if not visible[frame, rows[frame]]:
            raise ModelError(
                f"{scenario.name}: stop {stop_index + 1} looks at {stop.object_id}, but less than "
                "half of it is in the image. Move the stop away, or change the camera's mount."
            )
        scores[frame, [scenario.label_names.index(label) for label in stop.labels]] = 1.0
    frames = np.arange(len(rows))
    return Detections(frames, boxes[frames, rows], rows, rows, scores)


def real_detections(
    returned: BoolArray,
    probabilities: FloatArray,
    boxes: FloatArray,
    camera: Camera,
    errors: Errors,
    *,
    rng: np.random.Generator,
) -> Detections:
    """Detections of objects, with errors of boxes and ids.

    Args:
        returned: Labels returned for each object in each frame, (f, o, labels).
        probabilities: Of these labels; scores follow them, (f, o, labels).
        boxes: Of the objects [pixel], (f, o, 4).
        camera: Gives the size and the noise of boxes.
        errors: Of ids.
        rng: Source of it all.
    """
    frame, true_index = np.nonzero(returned.any(axis=2))
    present = returned[frame, true_index]
    edges = boxes[frame, true_index]
    edges = edges + camera.box_noise * rng.standard_normal(edges.shape)
    # (left, top), (right, bottom): noise may have swapped the edges of a narrow box.
    edges = np.sort(edges.reshape(-1, 2, 2), axis=1).reshape(-1, 4)
    # Wrong labels score lower as a rule, not always.
    trust = np.maximum(probabilities[frame, true_index], 0.5)
    confidence = rng.uniform(0.2, 1.0, present.shape) * trust
    n_objects = returned.shape[1]
    others = rng.integers(1, max(n_objects, 2), len(frame))
    swapped = rng.random(len(frame)) < errors.wrong_id
    return Detections(
        frame_index=frame,
        boxes=clip_boxes(camera, edges),
        id_index=np.where(swapped, (true_index + others) % n_objects, true_index),
        true_index=true_index,
        scores=np.where(present, 0.5 + 0.5 * confidence, 0.0),
    )


def clutter_detections(
    n_frames: int,
    n_labels: int,
    n_objects: int,
    camera: Camera,
    errors: Errors,
    *,
    rng: np.random.Generator,
) -> Detections:
    """Detections that lie on no object: one label each, anywhere in the image."""
    frame = np.repeat(np.arange(n_frames), rng.poisson(errors.clutter, n_frames))
    count = len(frame)
    centers = rng.uniform(0.0, camera.image_size, (count, 2))
    halves = rng.uniform(*_CLUTTER_SIZES, (count, 2)) / 2.0
    with_id = rng.random(count) < errors.clutter_with_id
    scores = np.zeros((count, n_labels))
    scores[np.arange(count), rng.integers(0, n_labels, count)] = rng.uniform(0.5, 0.8, count)
    return Detections(
        frame_index=frame,
        boxes=clip_boxes(camera, np.concatenate([centers - halves, centers + halves], axis=1)),
        id_index=np.where(with_id, rng.integers(0, n_objects, count), -1),
        true_index=np.full(count, -1),
        scores=scores,
    )


def joined(first: Detections, second: Detections) -> Detections:
    """Detections of both, frame by frame, the first's before the second's."""
    frame_index = np.concatenate([first.frame_index, second.frame_index])
    order = np.argsort(frame_index, kind="stable")
    return Detections(
        frame_index=frame_index[order],
        boxes=np.concatenate([first.boxes, second.boxes])[order],
        id_index=np.concatenate([first.id_index, second.id_index])[order],
        true_index=np.concatenate([first.true_index, second.true_index])[order],
        scores=np.concatenate([first.scores, second.scores])[order],
    )


def to_measurements(
    detections: Detections, scenario: Scenario, frames: Frames
) -> LabelMeasurements:
    """Label measurements of detections: what reading their log gives.

    Detections of one frame that share an id are one row. ``object_ids`` are those of the
    scenario in its order, while a log only knows the ids that it met.
    """
    count = len(detections)
    key = np.where(
        detections.id_index >= 0, detections.id_index, len(scenario.objects) + np.arange(count)
    )
    pairs = np.stack([detections.frame_index, key], axis=1)
    _, first, group = np.unique(pairs, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    row = np.argsort(order)[group.ravel()]
    rows = first[order]
    scores = np.zeros((len(rows), detections.scores.shape[1]))
    np.maximum.at(scores, row, detections.scores)
    present = scores > 0.0

    camera, boxes = scenario.camera, detections.boxes
    middle = 0.5 * (boxes[:, 1] + boxes[:, 3])
    from_heading = [azimuths(camera, boxes[:, edge], middle) for edge in (2, 0)]
    headings = frames.poses_world_sensor[detections.frame_index, 2] - planar_mount(camera)[2]
    directions = wrap_angle(headings[:, None] + np.stack(from_heading, axis=1))
    return LabelMeasurements(
        frames=frames,
        frame_index=detections.frame_index[rows],
        directions=hull(directions, row, len(rows)),
        object_index=detections.id_index[rows],
        object_ids=tuple(item.object_id for item in scenario.objects),
        label_offsets=np.concatenate([[0], np.cumsum(present.sum(axis=1))]),
        labels=np.nonzero(present)[1],
        scores=scores[present],
        label_names=scenario.label_names,
    )
