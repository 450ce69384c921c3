"""One cell's belief in a report, and how each look moved it."""

from __future__ import annotations

import numpy as np

from mclass.belief import posterior
from mclass.evidence import Evidence
from mclass.footprint import Grid, Tile, tiles
from mclass.gridmap import Causes, tile_pairs
from mclass.inference import Problem, object_groups
from mclass.looks import object_looks
from mclass.orientation import find_modes, refine, resolution_factors
from mclass.pairs import Pairs
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


def grid_history(problem: Problem, cell: int) -> list[CellReport]:
    """A cell of the grid after each look at it, evaluated exactly.

    A silent frame is a look without labels.

    Args:
        problem: All measurements and the model.
        cell: Flat index in the problem's grid.
    """
    assert problem.grid is not None
    looks, grid = problem.looks, problem.grid
    causes = Causes.found(
        problem.engine,
        looks,
        grid,
        problem.model.classes.log_priors,
        list(tiles(grid, looks.pointing)),
    )
    alone = Tile(np.array([cell]), np.arange(len(looks.frames), dtype=np.int32))
    return _history(problem, grid, cell, tile_pairs(looks, grid, alone, causes))


def object_history(problem: Problem, grid: Grid, cell: int, object_id: str) -> list[CellReport]:
    """A cell after each look at one object, given that it stands there, evaluated exactly."""
    group = next(group for name, group in object_groups(problem) if name == object_id)
    known = object_id in problem.model.objects
    looks = object_looks(problem.looks, group.rows, group.shares, known=known)
    pairs = looks.pairs(grid.centers(np.array([cell])), grid.cell_size)
    return _history(problem, grid, cell, pairs)


def _history(problem: Problem, grid: Grid, cell: int, pairs: Pairs) -> list[CellReport]:
    """Reports of the one row of the pairs, after each frame that looked."""
    looks = problem.looks
    order = np.argsort(looks.frames[pairs.looks], kind="stable")
    frames, first = np.unique(looks.frames[pairs.looks][order], return_index=True)
    each = problem.engine.exact_evidence(
        Pairs(
            starts=np.append(first, len(order)),
            looks=pairs.looks[order],
            ranges=pairs.ranges[order],
            directions=pairs.directions[order],
            scale=None if pairs.scale is None else pairs.scale[order],
        )
    )
    running = Evidence(
        np.cumsum(each.classes, axis=0),
        np.cumsum(each.background),
        np.arange(1, len(frames) + 1),
    )
    belief = posterior(running, problem.model.classes.log_priors, problem.engine.shown_bins)
    stamps = problem.measurements.frames.stamps_ns[frames]
    labels = _labels_by_frame(problem, pairs.looks)
    return [
        _report(
            grid,
            cell,
            np.exp(belief.log_class_probability[i]),
            belief.log_density[i],
            i + 1,
            int(stamps[i]),
            labels.get(int(frame), ()),
        )
        for i, frame in enumerate(frames)
    ]


def _labels_by_frame(problem: Problem, looks: IntArray) -> dict[int, tuple[str, ...]]:
    """The labels that detections among the looks returned, by frame."""
    labels: dict[int, set[str]] = {}
    for look in looks[looks < problem.looks.n_detections]:
        names = problem.measurements.label_names_of(int(look))
        labels.setdefault(int(problem.looks.frames[look]), set()).update(names)
    return {frame: tuple(sorted(names)) for frame, names in labels.items()}


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
