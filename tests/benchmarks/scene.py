"""Sensors around a field of cells, in the paper's proportions: views at 1 m, variance 0.1 m²."""

from __future__ import annotations

import numpy as np

from mclass.classes import ClassModel, LabelLikelihood
from mclass.model import PAPER, GridSettings, Model
from mclass.records import FloatArray, Frames, LabelMeasurements
from mclass.viewpoints import ViewpointMixture

MIN_RANGE, MAX_RANGE = 0.2, 4.0


def boxes(classes: int, bins: int, size: tuple[float, float], cell_size: float) -> Model:
    """Each class has a front and a back of its own; its front is also taken for every other."""
    likelihoods = {}
    for true in range(classes):
        front = np.pi * true / classes
        for label in range(classes):
            own = label == true
            angles = np.array([front, front + np.pi] if own else [front])
            likelihoods[true, label] = LabelLikelihood(
                0.6 if own else 0.4 / classes, _views(angles, 0.1 if own else 0.2)
            )
    names = tuple(f"c{number}" for number in range(classes))
    return Model(
        name="benchmark",
        source="",
        length_unit="m",
        classes=ClassModel(
            names,
            names,
            np.log(np.full(classes + 1, 1.0 / (classes + 1))),
            np.log(np.full(classes, 0.1)),
            likelihoods,
        ),
        grid=GridSettings(
            cell_size=cell_size,
            orientation_bins=bins,
            min_range=MIN_RANGE,
            max_range=MAX_RANGE,
            origin=(0.0, 0.0),
            size=size,
        ),
        inference=PAPER,
    )


def _views(angles: FloatArray, variance: float) -> ViewpointMixture:
    count = len(angles)
    return ViewpointMixture(
        np.full(count, 1.0 / count),
        np.stack([np.cos(angles), np.sin(angles)], axis=-1),
        np.tile(np.eye(2) * variance, (count, 1, 1)),
        np.zeros(count),
        np.full(count, np.inf),
    )


def measurements(
    model: Model, positions: FloatArray, targets: FloatArray, opening: float
) -> LabelMeasurements:
    """One detection of a random class from each position, its box towards the target."""
    count = len(positions)
    labels = model.classes.label_names
    to_target = targets - positions
    axis = np.arctan2(to_target[:, 1], to_target[:, 0])
    stamps = np.arange(count) * 10**8
    no_view = np.full((count, 2), np.nan)
    return LabelMeasurements(
        frames=Frames(stamps, stamps, np.column_stack([positions, axis]), None, no_view),
        frame_index=np.arange(count),
        directions=np.stack([axis - opening / 2.0, axis + opening / 2.0], axis=-1),
        object_index=np.full(count, -1),
        object_ids=(),
        label_offsets=np.arange(count + 1),
        labels=np.random.default_rng(2).integers(0, len(labels), count),
        scores=np.ones(count),
        label_names=labels,
    )


def field(classes: int, bins: int, count: int) -> tuple[Model, LabelMeasurements]:
    """5,000 cells of 3 cm, every one of which every measurement points at."""
    model = boxes(classes, bins, (3.0, 1.5), 0.03)
    generator = np.random.default_rng(1)
    angle = generator.uniform(0.0, 2.0 * np.pi, count)
    center = np.array([1.5, 0.75])
    around = np.stack([2.0 * np.cos(angle), 1.7 * np.sin(angle)], axis=-1)
    positions = center + around * generator.uniform(1.0, 1.15, count)[:, None]
    return model, measurements(model, positions, center, 3.0)


def hall(cells: int, count: int, opening: float = 0.6) -> tuple[Model, LabelMeasurements]:
    """A square hall with cells of 10 cm, a robot anywhere in it looking anywhere."""
    side = 0.1 * round(cells**0.5)
    model = boxes(3, 72, (side, side), 0.1)
    generator = np.random.default_rng(1)
    positions = generator.uniform(0.0, side, (count, 2))
    targets = positions + generator.normal(size=(count, 2))
    return model, measurements(model, positions, targets, opening)
