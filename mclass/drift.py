"""Poses that err together: beliefs averaged over trajectories that may have been driven.

Odometry does not err anew in every frame: its error grows, and neighbouring poses share it.
Trajectories are drawn from the growth of the poses' covariance; each gives every object a
belief, and the beliefs are averaged by how well each trajectory explains the labels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mclass.logarithms import logsumexp
from mclass.records import FloatArray, Frames, LabelMeasurements
from mclass.results import BeliefBlock
from mclass.summary import Readout

_SEED = 0
"""Fixed: the same log and model give the same result."""


def sample_offsets(covariances: FloatArray, count: int) -> FloatArray:
    """Draw errors of trajectories: random walks with the given covariance at every frame.

    Args:
        covariances: Of x [m], y [m] and heading [rad] at each frame, growing, (f, 3, 3).
        count: Number of trajectories.

    Returns:
        Errors, (count, f, 3). Where a covariance shrinks, the walk rests.
    """
    growth = np.diff(covariances, axis=0, prepend=np.zeros((1, 3, 3)))
    values, vectors = np.linalg.eigh((growth + growth.swapaxes(1, 2)) / 2.0)
    roots = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    normals = np.random.default_rng(_SEED).standard_normal((count, len(covariances), 3))
    return np.asarray(np.cumsum(np.einsum("fij,sfj->sfi", roots, normals), axis=1))


def shifted(measurements: LabelMeasurements, offsets: FloatArray) -> LabelMeasurements:
    """The measurements if the poses were off by so much, their covariance used up, (f, 3)."""
    frames = measurements.frames
    turns = offsets[:, 2:]
    moved = Frames(
        stamps_ns=frames.stamps_ns,
        log_times_ns=frames.log_times_ns,
        poses_world_sensor=frames.poses_world_sensor + offsets,
        covariances=None,
        view_directions=frames.view_directions + turns,
    )
    directions = measurements.directions + turns[measurements.frame_index]
    return replace(measurements, frames=moved, directions=directions)


def averaged(readouts: Sequence[Readout]) -> Readout:
    """One readout of several that are equally likely beforehand."""
    if len(readouts) == 1:
        return readouts[0]
    return Readout(
        log_likelihood=np.concatenate([part.log_likelihood for part in readouts]),
        log_outer=np.concatenate([part.log_outer for part in readouts]),
        log_joint=np.concatenate([part.log_joint for part in readouts]),
        centers=np.concatenate([part.centers for part in readouts]),
    )


def averaged_belief(blocks: Sequence[BeliefBlock], log_evidence: Sequence[float]) -> BeliefBlock:
    """One belief of several over the same grid, each weighed by its evidence."""
    if len(blocks) == 1:
        return blocks[0]
    log_weights = np.asarray(log_evidence) - logsumexp(np.asarray(log_evidence))
    cells = np.unique(np.concatenate([block.cells for block in blocks]))
    _, n_classes, bins = blocks[0].log_density.shape
    log_class = np.full((len(blocks), len(cells), 1 + n_classes), -np.inf)
    log_joint = np.full((len(blocks), len(cells), n_classes, bins), -np.inf)
    for block, weight, into_class, into_joint in zip(
        blocks, log_weights, log_class, log_joint, strict=True
    ):
        at = np.searchsorted(cells, block.cells)
        into_class[at] = block.log_class_probability + block.log_cell_mass[:, None] + weight
        into_joint[at] = into_class[at][:, 1:, None] + block.log_density
    together = np.asarray(logsumexp(np.asarray(log_class), axis=0))
    log_mass = np.asarray(logsumexp(together, axis=1))
    density = np.asarray(logsumexp(np.asarray(log_joint), axis=0)) - together[:, 1:, None]
    possible = np.isfinite(together[:, 1:, None])
    return replace(
        blocks[0],
        cells=cells,
        log_cell_mass=log_mass,
        log_class_probability=together - log_mass[:, None],
        log_density=np.where(possible, density, -np.log(2.0 * np.pi)).astype(np.float32),
        measurements=np.full(len(cells), blocks[0].measurements[0], dtype=np.int64),
    )
