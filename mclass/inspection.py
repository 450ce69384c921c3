"""Looking into one cell: its belief as stored, and how each measurement moved it."""

from __future__ import annotations

import numpy as np

from mclass.belief import posterior
from mclass.evidence import Evidence, Pairs
from mclass.footprint import Grid, sight
from mclass.inference import Problem
from mclass.orientation import find_modes, refine, resolution_factors
from mclass.records import FloatArray, IntArray
from mclass.results import BeliefBlock, CellReport, OrientationMode

_FINE_BINS = 576


def stored_report(block: BeliefBlock, cell: int) -> CellReport:
    """The belief of one of a block's cells.

    Args:
        block: Holds the cell.
        cell: Flat index.
    """
    at = int(np.searchsorted(block.cells, cell))
    return _report(
        block.grid,
        cell,
        np.exp(block.log_class_probability[at]),
        block.log_density[at].astype(float),
        int(block.measurements[at]),
        block.stamp_ns,
    )


def untouched_report(grid: Grid, cell: int, log_priors: FloatArray, bins: int) -> CellReport:
    """The prior, as it stands in a cell that nothing has touched."""
    density = np.full((len(log_priors) - 1, bins), -np.log(2.0 * np.pi))
    return _report(grid, cell, np.exp(log_priors), density, 0, 0)


def cell_history(
    problem: Problem, grid: Grid, cell: int, object_id: str | None = None
) -> list[CellReport]:
    """A cell's belief after each measurement that concerns it, evaluated exactly.

    Args:
        problem: All measurements and the model.
        grid: The cell's grid.
        cell: Flat index.
        object_id: Only this object's measurements, all of them; None for those of any
            object whose footprint holds the cell.
    """
    rows = _concerning(problem, grid, cell, object_id)
    pointing = problem.engine.pointing.select(rows)
    seen = sight(grid.centers(np.array([cell])), grid.cell_size, pointing)
    each = problem.engine.exact_evidence(
        Pairs(np.arange(len(rows) + 1), rows, seen.ranges[0], seen.directions[0])
    )
    running = Evidence(
        np.cumsum(each.classes, axis=0),
        np.cumsum(each.background),
        np.arange(1, len(rows) + 1),
    )
    belief = posterior(running, problem.model.classes.log_priors)
    stamps = problem.measurements.stamps_ns[rows]
    return [
        _report(
            grid,
            cell,
            np.exp(belief.log_class_probability[i]),
            belief.log_density[i],
            i + 1,
            int(stamps[i]),
            problem.measurements.label_names_of(int(row)),
        )
        for i, row in enumerate(rows)
    ]


def _concerning(problem: Problem, grid: Grid, cell: int, object_id: str | None) -> IntArray:
    """Rows of the measurements that a cell's belief is made of."""
    if object_id is not None:
        index = problem.measurements.object_ids.index(object_id)
        owners = problem.measurements.object_index[problem.used]
        return np.asarray(problem.used[owners == index])
    pointing = problem.engine.pointing.select(problem.used)
    seen = sight(grid.centers(np.array([cell])), grid.cell_size, pointing)
    return np.asarray(problem.used[seen.inside[0]])


def _report(
    grid: Grid,
    cell: int,
    probabilities: FloatArray,
    log_density: FloatArray,
    measurements: int,
    stamp_ns: int,
    labels: tuple[str, ...] = (),
) -> CellReport:
    row, column = divmod(cell, grid.columns)
    return CellReport(
        grid=grid,
        row=row,
        column=column,
        center=grid.centers(np.array(cell)),
        class_probabilities=probabilities / probabilities.sum(),
        density=np.exp(log_density),
        modes=tuple(_modes(values) for values in log_density),
        measurements=measurements,
        stamp_ns=stamp_ns,
        labels=labels,
    )


def _modes(log_density: FloatArray) -> tuple[OrientationMode, ...]:
    """Modes of one class, on a grid finer than the bins and than the narrowest peak."""
    factor = max(int(resolution_factors(log_density)), -(-_FINE_BINS // log_density.shape[-1]))
    fine = refine(log_density, factor)
    return find_modes(np.exp(fine - fine.max()))
