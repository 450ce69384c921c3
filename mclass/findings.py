"""All that an estimate found, as arrays and as answers to questions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from mclass.cells import grid_history, stored_report, untouched_report
from mclass.errors import UsageError
from mclass.inference import GridEstimate, Problem, cuts_every
from mclass.model import Model
from mclass.places import Place
from mclass.records import FloatArray, LabelMeasurements, PoseTrack
from mclass.results import BeliefBlock, CellReport, ClassMaps, ObjectEstimate


@dataclass(frozen=True, eq=False)
class Estimate:
    """What a log, or measurements from anywhere, say.

    Arrays over objects have one row an object, in the order of ``objects``; class axes with
    the background first are (1 + n,), without it (n,).

    Attributes:
        model: The model in force.
        frame: World frame of all positions.
        objects: Every object's last estimate, by id.
        history: Every object's estimates after each of its measurements, by id.
        object_beliefs: Every object's full belief over place, class and orientation, by id.
        maps: The class maps at the end; None if no measurement points anywhere.
        skipped: Detections that took no part, by reason.
        problem: The measurements as inference took them.
        track: The poses that placed the measurements; None if no log was read.
        notes: What was chosen while reading the log, and why, in sentences.
        damage: Sentences on parts of the log that could not be used.
        idle: Measurements among ``skipped`` that a class explains, but that concern no cell.
        input: The log; None if there is none.
        input_hash: ``sha256:`` and the hash of the log, for a URL ``etag:`` and its store's word
            for the version; empty unless an output was written.
        output: What was written; None if nothing was.
    """

    model: Model
    frame: str
    objects: tuple[ObjectEstimate, ...]
    history: Mapping[str, tuple[ObjectEstimate, ...]]
    object_beliefs: Mapping[str, BeliefBlock]
    maps: ClassMaps | None
    skipped: Mapping[str, int]
    problem: Problem
    track: PoseTrack | None = None
    notes: tuple[str, ...] = ()
    damage: tuple[str, ...] = ()
    idle: int = 0
    input: Place | None = None
    input_hash: str = ""
    output: Place | None = None

    @property
    def measurements(self) -> LabelMeasurements:
        """All measurements, those that took no part included."""
        return self.problem.measurements

    @property
    def used(self) -> int:
        """Number of measurements that took part."""
        return len(self.problem.used) - self.idle

    @property
    def class_names(self) -> tuple[str, ...]:
        """Without the background, (n,)."""
        return self.model.classes.class_names

    @property
    def object_ids(self) -> tuple[str, ...]:
        """Ids as the detector gave them, (o,)."""
        return tuple(estimate.object_id for estimate in self.objects)

    @property
    def class_probabilities(self) -> FloatArray:
        """P(class) of every object, background first, (o, 1 + n)."""
        rows = [estimate.class_probabilities for estimate in self.objects]
        return np.array(rows, dtype=float).reshape(len(rows), 1 + len(self.class_names))

    @property
    def positions(self) -> FloatArray:
        """Position of every object given its most probable class [m], (o, 2)."""
        rows = [estimate.position for estimate in self.objects]
        return np.array(rows, dtype=float).reshape(len(rows), 2)

    @property
    def orientations(self) -> FloatArray:
        """Highest orientation mode of every object given its most probable class [rad], (o,)."""
        rows = [estimate.class_poses[estimate.class_index, 2] for estimate in self.objects]
        return np.array(rows, dtype=float)

    def cell(self, x: float, y: float, object_id: str | None = None) -> CellReport:
        """The belief of the cell that holds a point.

        Args:
            x: In the world frame [m].
            y: In the world frame [m].
            object_id: That object's own belief; None for the grid's.

        Raises:
            UsageError: If the point is not on the grid, or there is no such object.
        """
        if object_id is not None and object_id not in self.object_beliefs:
            known = ", ".join(self.object_beliefs) or "none"
            raise UsageError(f"no object {object_id!r}; objects: {known}")
        block = None if object_id is None else self.object_beliefs[object_id]
        grid = self.problem.grid if block is None else block.grid
        cell = None if grid is None else grid.cell_at(x, y)
        if grid is None or cell is None:
            raise UsageError(f"({x:g}, {y:g}) is not on the grid")
        if block is not None and cell in block.cells:
            return stored_report(block, cell)
        steps = grid_history(self.problem, cell) if block is None else []
        if steps:
            return steps[-1]
        priors, bins = self.model.classes.log_priors, self.model.grid.orientation_bins
        return untouched_report(grid, cell, priors, bins)

    def grid_belief(self) -> Iterator[BeliefBlock]:
        """The full belief of the grid, tile by tile; computed anew, as it can be large."""
        yield from GridEstimate(self.problem, cuts_every(self.measurements, None)).blocks()
